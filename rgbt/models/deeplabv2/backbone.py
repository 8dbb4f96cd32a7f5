"""The residual backbone of DeepLab v2 as the domain adaptation releases build it."""

from __future__ import annotations

from typing import Literal, NamedTuple

from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.resnet import bottleneck_stage

TrainNorm = Literal["all", "statistics"]


class DeepLabFeatures(NamedTuple):
    """Maps at 1/8 of the size: layer3 (N, 16 w, h, w) and layer4 (N, 32 w, h, w)."""

    layer3: Tensor
    layer4: Tensor


class Backbone(nn.Module):
    """ResNet with the stride on the first 1x1 convolution and both last stages dilated throughout.

    Parameters have torchvision's names, so that its ImageNet files fit, although there the stride
    sits on the 3x3 convolution.

    Source: DeepLab v2, Sec. 3.1.   Released: AdaptSegNet, ADVENT, MaxSquareLoss, thesis.

    Args:
        depths: bottlenecks per stage.
        width: channels of the stem.
        ceil_mode: of the pooling: sides are rounded up (released), else down.
        train_norm: "all": normalisations are trained; "statistics": their scale and shift are
            not, while their statistics still follow the batches.
    """

    def __init__(
        self,
        depths: tuple[int, int, int, int],
        width: int,
        *,
        ceil_mode: bool,
        train_norm: TrainNorm,
    ) -> None:
        super().__init__()
        self.pool = nn.MaxPool2d(3, stride=2, padding=1, ceil_mode=ceil_mode)
        self.conv1 = nn.Conv2d(3, width, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.layer1 = bottleneck_stage(width, width, depths[0], stride_at="1x1")
        self.layer2 = bottleneck_stage(4 * width, 2 * width, depths[1], stride=2, stride_at="1x1")
        self.layer3 = bottleneck_stage(
            8 * width, 4 * width, depths[2], dilations=(2, 2), stride_at="1x1"
        )
        self.layer4 = bottleneck_stage(
            16 * width, 8 * width, depths[3], dilations=(4, 4), stride_at="1x1"
        )
        norms = [module for module in self.modules() if isinstance(module, nn.BatchNorm2d)]
        for norm in norms:
            norm.requires_grad_(train_norm == "all")

    def forward(self, image: Tensor) -> DeepLabFeatures:
        """(N, 3, H, W) -> features; h = H / 8, one more where the pooling rounded up."""
        x = self.pool(F.relu(self.bn1(self.conv1(image))))
        layer3 = self.layer3(self.layer2(self.layer1(x)))
        return DeepLabFeatures(layer3, self.layer4(layer3))
