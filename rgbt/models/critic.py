"""The discriminator of adversarial adaptation, which predicts the domain of a map."""

from __future__ import annotations

from itertools import pairwise

from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.ranges import BaseWidth, Channels
from rgbt.requirements import NetworkRecord, Requirement


class Critic(nn.Module):
    """Judges the domain of a map by five strided 4x4 convolutions, without normalisation.

    Source: AdaptSegNet, Sec. 3.2 ("discriminator"); HeatNet and the thesis use the same.
    Weights keep torch's initialisation, as released.

    The arguments are the keys of `critic` in ``conf/scheme/adversarial_heatnet.yaml``; `base_width`
    is doubled by each of the next three convolutions. `align_corners` is false in HeatNet's release
    and true in the thesis' port of it; AdaptSegNet and the thesis with two heads do not enlarge.
    """

    def __init__(
        self, *, in_channels: Channels, base_width: BaseWidth, upsample: bool, align_corners: bool
    ) -> None:
        super().__init__()
        if align_corners and not upsample:
            raise InputError("critic.align_corners has no effect with critic.upsample=false.")
        self.upsample, self.align_corners = upsample, align_corners
        widths = (in_channels, base_width, 2 * base_width, 4 * base_width, 8 * base_width, 1)
        self.conv1, self.conv2, self.conv3, self.conv4, self.classifier = (
            nn.Conv2d(before, after, 4, stride=2, padding=1) for before, after in pairwise(widths)
        )
        setting = f"scheme.critic.in_channels={in_channels}"
        need = Requirement("dataset", "num_classes", in_channels, setting)
        self.record = NetworkRecord(requires=(need,))

    def forward(self, x: Tensor) -> Tensor:
        """Return verdicts, not squashed; the loss chooses which number stands for which domain.

        (N, in_channels, H, W), sides of at least 32 -> (N, 1, h, w) with h = H // 32, w = W // 32,
        or 32 times that with `upsample`: H and W, or a little less where 32 does not divide them.
        """
        for conv in (self.conv1, self.conv2, self.conv3, self.conv4):
            x = F.leaky_relu(conv(x), 0.2)
        x = self.classifier(x)
        if not self.upsample:
            return x
        return F.interpolate(x, scale_factor=32, mode="bilinear", align_corners=self.align_corners)
