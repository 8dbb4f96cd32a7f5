"""The discriminator of adversarial adaptation, which predicts the domain of a map."""

from __future__ import annotations

from itertools import pairwise

from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError, check_shape
from rgbt.ranges import BaseWidth, Channels
from rgbt.requirements import Record, Requirement

STRIDE = 32


class Critic(nn.Module):
    """Five strided 4x4 convolutions, no normalisation, no sigmoid.

    Source: AdaptSegNet, Sec. 3.2 ("discriminator"); HeatNet and the thesis use the same.
    Weights keep torch's initialisation, as released.

    The arguments are the keys of `critic` in ``conf/scheme/adversarial_heatnet.yaml``; `base_width`
    is doubled by each of the next three convolutions. `align_corners` is false in HeatNet's release
    and true in the thesis' port of it; AdaptSegNet and the thesis with two heads do not enlarge.

    Raises:
        InputError: align_corners without upsample.
    """

    def __init__(
        self, *, in_channels: Channels, base_width: BaseWidth, upsample: bool, align_corners: bool
    ) -> None:
        super().__init__()
        if align_corners and not upsample:
            raise InputError("critic.align_corners has no effect with critic.upsample=false.")
        self.in_channels = in_channels
        self.upsample = upsample
        self.align_corners = align_corners
        widths = (in_channels, *(base_width * factor for factor in (1, 2, 4, 8)), 1)
        self.conv1, self.conv2, self.conv3, self.conv4, self.classifier = (
            nn.Conv2d(before, after, 4, stride=2, padding=1) for before, after in pairwise(widths)
        )

    @property
    def record(self) -> Record:
        """It sees a map for each class."""
        setting = f"scheme.critic.in_channels={self.in_channels}"
        return Record(requires=(Requirement("dataset", "num_classes", self.in_channels, setting),))

    def forward(self, x: Tensor) -> Tensor:
        """Verdicts, not squashed; which number stands for which domain is the loss's choice.

        (N, in_channels, H, W), sides of at least 32 -> (N, 1, h, w) with h = H // 32, w = W // 32,
        or 32 times that with `upsample`: H and W, or a little less where 32 does not divide them.

        ValueError: another number of channels. InputError: a map that is too small.
        """
        sizes = check_shape("map", x, "N C H W", C=self.in_channels)
        if min(sizes["H"], sizes["W"]) < STRIDE:
            got = f"{sizes['H']} x {sizes['W']}"
            raise InputError(f"a discriminator requires maps of at least 32 x 32, got {got}.")
        for conv in (self.conv1, self.conv2, self.conv3, self.conv4):
            x = F.leaky_relu(conv(x), 0.2)
        verdicts: Tensor = self.classifier(x)
        if not self.upsample:
            return verdicts
        return F.interpolate(
            verdicts, scale_factor=STRIDE, mode="bilinear", align_corners=self.align_corners
        )
