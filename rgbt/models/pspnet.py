"""The network PSPNet of HeatNet: a residual encoder per image, pyramid pooling, a decoder."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.inputs import Images, Inputs, Network
from rgbt.models.parts import DropRates, bottleneck_stage, enlarge, up_block
from rgbt.ranges import BaseWidth, Channels, Depths, NumClasses
from rgbt.requirements import NetworkRecord
from rgbt.types import Output, View

BINS = (1, 2, 3, 6)  # cells per side of the pooled maps (PSPNet, Sec. 3.2)

Modalities = Literal["late_fusion", "early_fusion", "rgb", "thermal"]

BRANCHES = ("", "_2")  # what the released names of the first and second branch end with


class PSPNet(Network):
    """Predicts from one image or both, as HeatNet does, by ResNet-50 and pyramid pooling.

    Two branches are concatenated at 1/8 of the size, before the third stage. Weights are drawn as
    released: convolutions N(0, 0.02), normalisations N(1, 0.02) and 0; biases of convolutions and
    slopes keep torch's initialisation.

    Source: HeatNet, Sec. III; PSPNet.   Released: JohanVer/heatnet, jzuern/heatnet-pub
    (architecture "pspnet"; the names of the weights are theirs without "trgb_segnet.").

    The arguments are the keys of ``conf/model/heatnet.yaml``.
    """

    multiple = 8  # stride of the encoder; the decoder doubles the size three times

    def __init__(  # noqa: PLR0913 - each is a key of conf/model/*.yaml
        self,
        *,
        num_classes: NumClasses,
        depths: Depths,
        base_width: BaseWidth,
        decoder_width: Channels,
        modalities: Modalities,
        dropout: DropRates,
        align_corners: bool,
        inputs: Inputs,
    ) -> None:
        super().__init__()
        self.num_classes = num_classes
        fused = modalities in ("late_fusion", "early_fusion")
        self.record = NetworkRecord(
            views=("rgbt",) if fused else ("rgb",) if modalities == "rgb" else ("thermal",),
            features=True,
            pretrained_parts=("feats.",),
            recomputed=("feats.layer*.*", "up_*"),
        )
        self.modalities = modalities
        self.dropout = dropout
        thermal = inputs.thermal_channels
        channels = {"late_fusion": (3, thermal), "early_fusion": (3 + thermal,), "rgb": (3,)}
        self.feats = PSPNetEncoder(channels.get(modalities, (thermal,)), depths, base_width)
        pooled, narrow = 16 * base_width, decoder_width
        self.psp = PyramidPooling(32 * base_width, pooled, align_corners=align_corners)
        self.up_1 = up_block(pooled, 4 * narrow, align_corners=align_corners)
        self.up_2 = up_block(4 * narrow, narrow, align_corners=align_corners)
        self.up_3 = up_block(narrow, narrow, align_corners=align_corners)
        self.final = nn.Sequential(nn.Conv2d(narrow, num_classes, 1))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.normal_(module.weight, 0.0, 0.02)
            elif isinstance(module, nn.BatchNorm2d):
                nn.init.normal_(module.weight, 1.0, 0.02)
                nn.init.zeros_(module.bias)
        self.inputs = inputs

    def predict(self, images: Images, view: View, generator: torch.Generator | None) -> Output:
        """Predict class scores of one image or both.

        In aux: maps of the encoder. With w = base_width, branches concatenated, sides H and W
        rounded up to multiples of 8 and then divided by s: "features" (32 w, s = 8), "layer3"
        (16 w, s = 8), "layer2" (8 w per branch, s = 8), "layer1" (4 w per branch, s = 4), "stem"
        (w per branch, s = 4).
        """
        seen: tuple[Tensor, ...] = images
        if self.modalities == "early_fusion":
            seen = (torch.cat(images, 1),)
        elif view != "rgbt":
            seen = (images.rgb if view == "rgb" else images.thermal,)
        features = self.feats(seen)
        rates = self.dropout if self.training else (0.0, 0.0)
        x = self.psp(features["features"])
        x = enlarge(x, (self.up_1, self.up_2, self.up_3), rates, generator)
        return Output(self.final(x), features)


class PSPNetEncoder(nn.Module):
    """Computes features of the images by a ResNet whose last two stages are dilated.

    Stem and first two stages exist once per image. The first block of a dilated stage is not
    dilated; after two branches the third stage keeps its width and has no projection.
    """

    def __init__(
        self, channels: tuple[int, ...], depths: tuple[int, int, int, int], width: int
    ) -> None:
        super().__init__()
        self.branches = BRANCHES[: len(channels)]
        for end, count in zip(self.branches, channels, strict=True):
            stem = nn.Conv2d(count, width, 7, stride=2, padding=3, bias=False)
            self.add_module(f"conv1{end}", stem)
            self.add_module(f"bn1{end}", nn.BatchNorm2d(width))
            self.add_module(f"layer1{end}", bottleneck_stage(width, width, depths[0]))
            layer2 = bottleneck_stage(4 * width, 2 * width, depths[1], stride=2)
            self.add_module(f"layer2{end}", layer2)
        fused = len(channels) * 8 * width
        self.layer3 = bottleneck_stage(fused, 4 * width, depths[2], dilations=(1, 2))
        self.layer4 = bottleneck_stage(16 * width, 8 * width, depths[3], dilations=(1, 4))

    def forward(self, images: tuple[Tensor, ...]) -> dict[str, Tensor]:
        """Return features by the name of their stage, see `PSPNet.predict`."""
        branches = []
        for end, image in zip(self.branches, images, strict=True):
            conv1, bn1, layer1, layer2 = (
                self.get_submodule(f"{name}{end}") for name in ("conv1", "bn1", "layer1", "layer2")
            )
            stem = F.max_pool2d(F.relu(bn1(conv1(image))), 3, stride=2, padding=1)
            first = layer1(stem)
            branches.append((stem, first, layer2(first)))
        stem, first, second = (
            torch.cat(maps, 1) if len(maps) > 1 else maps[0] for maps in zip(*branches, strict=True)
        )
        third = self.layer3(second)
        maps = {"layer3": third, "layer2": second, "layer1": first, "stem": stem}
        return {"features": self.layer4(third), **maps}


class PyramidPooling(nn.Module):
    """Joins a map with its means over 1, 4, 9 and 36 cells, projected and enlarged.

    Source: PSPNet, Fig. 3.   Released: HeatNet, whose four branches keep all channels and have
    neither normalisation nor activation.
    """

    def __init__(self, channels: int, out_channels: int, *, align_corners: bool) -> None:
        super().__init__()
        self.align_corners = align_corners
        self.stages = nn.ModuleList(
            nn.Sequential(nn.AdaptiveAvgPool2d(bins), nn.Conv2d(channels, channels, 1, bias=False))
            for bins in BINS
        )
        joined = (len(BINS) + 1) * channels
        self.bottleneck = nn.Conv2d(joined, out_channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, h, w) -> (N, out, h, w), >= 0."""
        # The convolution of the joined maps is a sum with one term for each of them. The term of a
        # small map is computed at its own size and enlarged afterwards.
        *shares, own = torch.split(self.bottleneck.weight, x.shape[1], dim=1)
        result = F.conv2d(x, own, self.bottleneck.bias)
        for stage, share in zip(self.stages, shares, strict=True):
            small = F.conv2d(stage(x), share)
            result = result + F.interpolate(
                small, size=x.shape[2:], mode="bilinear", align_corners=self.align_corners
            )
        return F.relu(result)
