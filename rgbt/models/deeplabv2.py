"""The network DeepLab v2, which predicts class scores of one image with one of its heads."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal

import torch
from annotated_types import Interval, Len
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError, check_choice
from rgbt.models.inputs import Images, Inputs, Network, as_rgb
from rgbt.models.parts import DropRates, StrideAt, bottleneck_stage, enlarge, up_block
from rgbt.ranges import BaseWidth, Depths, Names, NumClasses
from rgbt.requirements import NetworkRecord, Requirement
from rgbt.types import Output, View

TrainNorm = Literal["all", "statistics"]
Decoder = Literal["basic", "modified_heatnet", "modified_thesis"]
Rates = Annotated[tuple[Annotated[int, Interval(ge=1, le=1024)], ...], Len(1, 64)]


class Backbone(nn.Module):
    """Computes features of an image by a ResNet whose last two stages are dilated throughout.

    The stride of a block is on its first 1x1 convolution. Parameters have torchvision's names, so
    that its ImageNet files fit, although there the stride is on the 3x3 convolution.

    Source: DeepLab v2, Sec. 3.1.   Released: AdaptSegNet, ADVENT, MaxSquareLoss, thesis.
    """

    def __init__(
        self, depths: tuple[int, int, int, int], width: int, *, ceil_mode: bool, train_norm: str
    ) -> None:
        super().__init__()
        self.pool = nn.MaxPool2d(3, stride=2, padding=1, ceil_mode=ceil_mode)
        self.conv1 = nn.Conv2d(3, width, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        at: StrideAt = "1x1"
        self.layer1 = bottleneck_stage(width, width, depths[0], stride_at=at)
        self.layer2 = bottleneck_stage(4 * width, 2 * width, depths[1], stride=2, stride_at=at)
        self.layer3 = bottleneck_stage(
            8 * width, 4 * width, depths[2], dilations=(2, 2), stride_at=at
        )
        self.layer4 = bottleneck_stage(
            16 * width, 8 * width, depths[3], dilations=(4, 4), stride_at=at
        )
        for module in self.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.requires_grad_(train_norm == "all")

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 3, H, W) -> layer3 (N, 16 w, h, w) and layer4 (N, 32 w, h, w), h = H / 8 or more."""
        x = self.pool(F.relu(self.bn1(self.conv1(image))))
        layer3 = self.layer3(self.layer2(self.layer1(x)))
        return layer3, self.layer4(layer3)


class AtrousPyramid(nn.Module):
    """Adds parallel dilated 3x3 convolutions (ASPP).

    Source: DeepLab v2, Sec. 3.2 and Fig. 7: all four count.   Released: AdaptSegNet,
    MaxSquareLoss and the thesis leave their loop early, so that only the first two (`summed_rates`)
    count, while the others still belong to the parameters; ADVENT sums all.
    """

    def __init__(
        self, in_channels: int, out_channels: int, *, rates: Rates, summed_rates: Rates
    ) -> None:
        super().__init__()
        self.conv2d_list = nn.ModuleList(
            nn.Conv2d(in_channels, out_channels, 3, padding=rate, dilation=rate) for rate in rates
        )
        self.summed = [rates.index(rate) for rate in summed_rates]

    def forward(self, x: Tensor) -> Tensor:
        """(N, in, h, w) -> (N, out, h, w)."""
        first, *others = self.summed
        total = self.conv2d_list[first](x)
        for index in others:
            total = total + self.conv2d_list[index](x)
        return total


class DeepLabV2(Network):
    """Predicts from RGB or thermal by a backbone that all domains share and a head, or several.

    A head is a pyramid, and in the modified decoders three up blocks. Weights of convolutions are
    drawn from N(0, 0.01), as released; biases and slopes keep torch's initialisation.

    Source: DeepLab v2; thesis (J. Sun, Multi-head), Sec. III.   Released: AdaptSegNet, ADVENT and
    MaxSquareLoss (one head, with or without the auxiliary one); the thesis' code (two heads).
    Paper: a modified decoder keeps the number of channels (thesis, Sec. III-B and Fig. 5).
    Released: the training scripts import the network without up blocks. A file that no script
    imports has a modified decoder of HeatNet's widths, which ends with a 1x1 convolution (`final`).

    The arguments are the keys of ``conf/model/deeplabv2.yaml``.
    """

    def __init__(  # noqa: PLR0913 - each is a key of conf/model/*.yaml
        self,
        *,
        num_classes: NumClasses,
        depths: Depths,
        base_width: BaseWidth,
        ceil_mode: bool,
        train_norm: TrainNorm,
        heads: Annotated[Names, Len(1, 100)],
        auxiliary: bool,
        decoder: Decoder,
        rates: Rates,
        summed_rates: Rates,
        dropout: DropRates,
        align_corners: bool,
        inputs: Inputs,
    ) -> None:
        super().__init__()
        if not set(summed_rates) <= set(rates):
            raise InputError(f"model.summed_rates must be some of {rates}, got {summed_rates}.")
        if ceil_mode and decoder != "basic":
            raise InputError(f"model.ceil_mode must be false with model.decoder={decoder}.")
        self.record = NetworkRecord(
            requires=(Requirement("domains", "heads", heads),) if len(heads) > 1 else (),
            views=("rgb", "thermal"),
            heads=heads,
            auxiliary=auxiliary,
            features=True,
            pretrained_parts=("backbone.",),
            recomputed=("backbone.layer*.*",),
        )
        self.num_classes = num_classes
        self.align_corners = align_corners
        # The modified decoders double the size three times; scores of the basic one are enlarged.
        self.multiple = 1 if decoder == "basic" else 8
        self.backbone = Backbone(depths, base_width, ceil_mode=ceil_mode, train_norm=train_norm)
        channels = 32 * base_width
        sizes = {
            "basic": (num_classes,),
            "modified_heatnet": (channels // 2, channels // 8, channels // 32, channels // 32),
            "modified_thesis": (num_classes,) * 4,
        }[decoder]
        self.dropout = dropout
        self.heads = nn.ModuleDict()
        for name in heads:
            head = nn.ModuleDict()
            head["aspp"] = AtrousPyramid(channels, sizes[0], rates=rates, summed_rates=summed_rates)
            head["ups"] = nn.ModuleList(
                up_block(before, after, align_corners=align_corners)
                for before, after in pairwise(sizes)
            )
            is_wide = decoder == "modified_heatnet"
            head["final"] = nn.Conv2d(sizes[-1], num_classes, 1) if is_wide else nn.Identity()
            self.heads[name] = head
        self.auxiliary = None
        if auxiliary:
            self.auxiliary = AtrousPyramid(
                16 * base_width, num_classes, rates=rates, summed_rates=summed_rates
            )
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.normal_(module.weight, 0.0, 0.01)
        self.inputs = inputs

    def predict(
        self, images: Images, view: View, generator: torch.Generator | None, head: str | None = None
    ) -> Output:
        """Predict class scores from one image by one head.

        Of several heads, `head` names the one (InputError: there is none); None: the first.
        In aux: "features" (N, 32 w, h, w) of the fourth stage; "aux_logits" (N, K, H, W) of the
        auxiliary head, where there is one.
        """
        name = next(iter(self.heads)) if head is None else head
        check_choice("head", name, self.heads)
        layer3, layer4 = self.backbone(images.rgb if view == "rgb" else as_rgb(images.thermal))
        aspp, ups, final = self.heads[name].children()
        drop_rates = self.dropout if self.training else (0.0, 0.0)
        scores = final(enlarge(aspp(layer4), ups.children(), drop_rates, generator))
        logits = self._at_size(scores, images.rgb)
        aux = {"features": layer4}
        if self.auxiliary is not None:
            aux["aux_logits"] = self._at_size(self.auxiliary(layer3), images.rgb)
        return Output(logits, aux)

    def _at_size(self, scores: Tensor, image: Tensor) -> Tensor:
        """Enlarge scores (N, K, h, w) to the size of an image (N, C, H, W)."""
        size = image.shape[2:]
        if scores.shape[2:] == size:
            return scores
        return F.interpolate(scores, size, mode="bilinear", align_corners=self.align_corners)
