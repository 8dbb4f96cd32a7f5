"""The network PSPNet of semseg: three stem convolutions, narrow pyramid pooling, auxiliary head."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.inputs import Images, Inputs, Network, as_rgb
from rgbt.models.parts import bottleneck_stage, drop_channels
from rgbt.models.pspnet import BINS
from rgbt.ranges import BaseWidth, Depths, NumClasses, ShareBelowOne
from rgbt.requirements import NetworkRecord
from rgbt.types import Output, View


class SemsegPSPNet(Network):
    """Predicts from one image by PSPNet with ResNet-50 as semseg has it: teachers of the thesis.

    It sees the RGB image or the thermal image. Scores are enlarged to the image with aligned
    corners; with sides of 8 n + 1 pixels, as semseg requires, that is exactly 8 times. Convolutions
    of the backbone are drawn as in semseg (He et al., fan out), the others as in torch.

    Source: PSPNet, Fig. 3; thesis (J. Sun), Sec. V-C.   Released: hszhao/semseg; the names of the
    weights are its own.

    The arguments are the keys of ``conf/model/semseg.yaml``.
    """

    def __init__(
        self,
        *,
        num_classes: NumClasses,
        depths: Depths,
        base_width: BaseWidth,
        modalities: Literal["rgb", "thermal"],
        dropout: ShareBelowOne,
        inputs: Inputs,
    ) -> None:
        super().__init__()
        self.num_classes = num_classes
        self.record = NetworkRecord(
            views=(modalities,),
            auxiliary=True,
            features=True,
            pretrained_parts=("layer",),
            recomputed=("layer1.*", "layer2.*", "layer3.*", "layer4.*"),
        )
        self.drop_rate = dropout
        width = base_width
        self.layer0 = nn.Sequential(
            *_conv_norm(3, width, stride=2),
            *_conv_norm(width, width),
            *_conv_norm(width, 2 * width),
        )
        self.layer1 = bottleneck_stage(2 * width, width, depths[0])
        self.layer2 = bottleneck_stage(4 * width, 2 * width, depths[1], stride=2)
        self.layer3 = bottleneck_stage(8 * width, 4 * width, depths[2], dilations=(2, 2))
        self.layer4 = bottleneck_stage(16 * width, 8 * width, depths[3], dilations=(4, 4))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        branches = nn.ModuleList()
        for bins in BINS:
            branch = nn.Sequential(
                nn.AdaptiveAvgPool2d(bins),
                nn.Conv2d(32 * width, 8 * width, 1, bias=False),
                nn.BatchNorm2d(8 * width),
                nn.ReLU(),
            )
            branches.append(branch)
        self.ppm = nn.ModuleDict({"features": branches})
        self.cls = _head(64 * width, 8 * width, num_classes)
        self.aux = _head(16 * width, 4 * width, num_classes)
        self.inputs = inputs

    def predict(self, images: Images, view: View, generator: torch.Generator | None) -> Output:
        """Predict class scores of one image.

        In aux: "features" (N, 32 w, h, w) of the fourth stage, with w = base_width; "aux_logits"
        (N, K, H, W) of the third stage.
        """
        image = images.rgb if view == "rgb" else as_rgb(images.thermal)
        x = F.max_pool2d(self.layer0(image), 3, stride=2, padding=1)
        layer3 = self.layer3(self.layer2(self.layer1(x)))
        layer4 = self.layer4(layer3)
        # Pyramid pooling joins the map with its means over 1, 4, 9 and 36 cells.
        pooled = [layer4]
        for branch in self.ppm["features"].children():
            pooled.append(_enlarged(branch(layer4), layer4.shape[2:]))
        rate = self.drop_rate if self.training else 0.0
        found = []
        for head, features in ((self.cls, torch.cat(pooled, 1)), (self.aux, layer3)):
            narrow = drop_channels(head[:-1](features), rate, generator)
            found.append(_enlarged(head[-1](narrow), image.shape[2:]))
        return Output(found[0], {"features": layer4, "aux_logits": found[1]})


def _enlarged(x: Tensor, hw: Sequence[int]) -> Tensor:
    return F.interpolate(x, size=tuple(hw), mode="bilinear", align_corners=True)


def _conv_norm(before: int, after: int, *, stride: int = 1) -> tuple[nn.Module, ...]:
    """Make a 3x3 convolution, normalisation and ReLU."""
    conv = nn.Conv2d(before, after, 3, stride=stride, padding=1, bias=False)
    return conv, nn.BatchNorm2d(after), nn.ReLU()


def _head(channels: int, narrow: int, num_classes: int) -> nn.Sequential:
    """Make layers with semseg's numbers; number 3 is its dropout, which `predict` draws."""
    return nn.Sequential(
        *_conv_norm(channels, narrow), nn.Identity(), nn.Conv2d(narrow, num_classes, 1)
    )
