"""The network DeepLab v2, which predicts class scores of one image with one of its heads."""

from __future__ import annotations

from functools import partial, reduce
from itertools import pairwise
from typing import Annotated, Literal

import torch
from annotated_types import Interval, Len
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError, check_choice
from rgbt.models.inputs import Images, Inputs, Network, as_rgb
from rgbt.models.parts import DropRates, UpBlock, bottleneck_stage, enlarge
from rgbt.ranges import BaseWidth, Depths, Names, NumClasses
from rgbt.requirements import NetworkRecord, Requirement
from rgbt.types import Output, View

TrainNorm = Literal["all", "statistics"]
Decoder = Literal["basic", "modified_heatnet", "modified_thesis"]
Rates = Annotated[tuple[Annotated[int, Interval(ge=1, le=1024)], ...], Len(1, 64)]


class Backbone(nn.Module):
    """ResNet with the stride on the first 1x1 convolution and both last stages dilated throughout.

    Parameters have torchvision's names, so that its ImageNet files fit, although there the stride
    sits on the 3x3 convolution.

    Source: DeepLab v2, Sec. 3.1.   Released: AdaptSegNet, ADVENT, MaxSquareLoss, thesis.
    """

    def __init__(
        self, depths: tuple[int, int, int, int], width: int, *, ceil_mode: bool, train_norm: str
    ) -> None:
        super().__init__()
        stage = partial(bottleneck_stage, stride_at="1x1")
        self.pool = nn.MaxPool2d(3, stride=2, padding=1, ceil_mode=ceil_mode)
        self.conv1 = nn.Conv2d(3, width, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.layer1 = stage(width, width, depths[0])
        self.layer2 = stage(4 * width, 2 * width, depths[1], stride=2)
        self.layer3 = stage(8 * width, 4 * width, depths[2], dilations=(2, 2))
        self.layer4 = stage(16 * width, 8 * width, depths[3], dilations=(4, 4))
        for module in self.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.requires_grad_(train_norm == "all")

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 3, H, W) -> layer3 (N, 16 w, h, w) and layer4 (N, 32 w, h, w), h = H / 8 or more."""
        x = self.pool(F.relu(self.bn1(self.conv1(image))))
        layer3 = self.layer3(self.layer2(self.layer1(x)))
        return layer3, self.layer4(layer3)


class AtrousPyramid(nn.Module):
    """Sum of parallel dilated 3x3 convolutions, nothing else (ASPP).

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
        return reduce(torch.add, (self.conv2d_list[index](x) for index in self.summed))


class DeepLabHead(nn.Module):
    """A pyramid, and in the modified decoders three up blocks.

    Source: thesis, Sec. III-B and Fig. 5: a modified decoder keeps the number of channels.
    Released: the training scripts import the network without up blocks. A file that no script
    imports has a modified decoder of HeatNet's widths, which ends with a 1x1 convolution (`final`).
    """

    def __init__(
        self, aspp: AtrousPyramid, ups: list[UpBlock], final: nn.Module, dropout: DropRates
    ) -> None:
        super().__init__()
        self.dropout = dropout
        self.aspp = aspp
        self.ups = nn.ModuleList(ups)
        self.final = final

    def forward(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        """(N, in, h, w) -> (N, K, h, w), or (N, K, 8 h, 8 w) from a modified decoder."""
        rates = self.dropout if self.training else (0.0, 0.0)
        return self.final(enlarge(self.aspp(x), self.ups, rates, generator))


class DeepLabV2(Network):
    """DeepLab v2 with a backbone that all domains share and one head, or one per domain.

    Sees the RGB image or the thermal image, never both. Weights of convolutions are drawn from
    N(0, 0.01), as released; biases and slopes keep torch's initialisation.

    Source: DeepLab v2; thesis (J. Sun, Multi-head), Sec. III.   Released: AdaptSegNet, ADVENT and
    MaxSquareLoss (one head, with or without the auxiliary one); the thesis' code (two heads).

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
            "modified_heatnet": tuple(channels // each for each in (2, 8, 32, 32)),
            "modified_thesis": (num_classes,) * 4,
        }[decoder]
        pyramid = partial(AtrousPyramid, rates=rates, summed_rates=summed_rates)
        self.heads = nn.ModuleDict()
        for name in heads:
            aspp = pyramid(channels, sizes[0])
            ups = [UpBlock(*pair, align_corners=align_corners) for pair in pairwise(sizes)]
            is_wide = decoder == "modified_heatnet"
            final = nn.Conv2d(sizes[-1], num_classes, 1) if is_wide else nn.Identity()
            self.heads[name] = DeepLabHead(aspp, ups, final, dropout)
        self.auxiliary = pyramid(16 * base_width, num_classes) if auxiliary else None
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.normal_(module.weight, 0.0, 0.01)
        self.inputs = inputs

    def predict(
        self, images: Images, view: View, generator: torch.Generator | None, head: str | None = None
    ) -> Output:
        """Class scores from one image by one head.

        Of several heads, `head` names the one (InputError: there is none); None: the first.
        In aux: "features" (N, 32 w, h, w) of the fourth stage; "aux_logits" (N, K, H, W) of the
        auxiliary head, where there is one.
        """
        name = next(iter(self.heads)) if head is None else head
        check_choice("head", name, self.heads)
        layer3, layer4 = self.backbone(images.rgb if view == "rgb" else as_rgb(images.thermal))
        found = {"logits": self.heads[name](layer4, generator)}
        if self.auxiliary is not None:
            found["aux_logits"] = self.auxiliary(layer3)
        size, corners = images.rgb.shape[2:], self.align_corners
        for key, each in found.items():
            if each.shape[2:] != size:
                found[key] = F.interpolate(each, size, mode="bilinear", align_corners=corners)
        return Output(found.pop("logits"), {"features": layer4, **found})
