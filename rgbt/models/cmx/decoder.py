"""MLP decoder: four maps of different size to class scores of the image."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.modules.batchnorm import _BatchNorm

from rgbt.models.parts import drop_channels


class MlpDecoder(nn.Module):
    """Every map to E channels, enlarged to the first one's size, joined, mixed and classified.

        ReLU(BatchNorm(conv1x1([c4, c3, c2, c1]))),  c_i = enlarge(linear_i(x_i))

    Enlarging is linear and its weights sum to 1, so that it may follow the convolution instead:
    each map meets its own part of the convolution at its own size, and the two linear maps are
    one whose matrix is their product. The same numbers to rounding, at a fraction of the
    operations and without the map of 4 E channels.

    Source: SegFormer, Sec. 3.2, Eq. (4); CMX, Sec. III-A.

    `dims` are channels of the four maps, the largest first; `dim` is E; `norm_eps` is that of the
    normalisation in training and in evaluation; `mix_bias`: whether the convolution over the joined
    maps has a bias, as in CMX; the rest as in `CMX`.
    """

    def __init__(
        self,
        dims: Sequence[int],
        num_classes: int,
        *,
        dim: int,
        dropout: float,
        norm_eps: tuple[float, float],
        mix_bias: bool = True,
    ) -> None:
        super().__init__()
        self.dropout = dropout
        self.norm_eps = norm_eps
        self.linear_c1, self.linear_c2, self.linear_c3, self.linear_c4 = (
            nn.Sequential(OrderedDict(proj=nn.Linear(width, dim))) for width in dims
        )
        fuse = nn.Conv2d(4 * dim, dim, 1, bias=mix_bias)
        self.linear_fuse = nn.Sequential(fuse, nn.BatchNorm2d(dim, eps=norm_eps[0]), nn.ReLU())
        self.linear_pred = nn.Conv2d(dim, num_classes, 1)
        for convolution in (fuse, self.linear_pred):
            nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")

    def train(self, mode: bool = True) -> MlpDecoder:
        """Also chooses the eps of the normalisation, of any class that normalises a batch."""
        norm = self.linear_fuse[1]
        assert isinstance(norm, _BatchNorm), "put there by the constructor"
        norm.eps = self.norm_eps[0 if mode else 1]
        return super().train(mode)

    def forward(
        self,
        maps: list[Tensor],
        image_hw: tuple[int, int],
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Class scores (N, K, H, W) float32 of four (N, H_i, W_i, C_i), the largest first.

        They are computed at the size of the first map, a quarter of the image, and enlarged.
        `generator` draws the dropped channels, in training mode with a rate above 0 alone.
        """
        # The convolution over the four projected and enlarged maps, (N, E, H_1, W_1). The release
        # joins the maps in the order c4, c3, c2, c1.
        fuse = self.linear_fuse[0]
        assert isinstance(fuse, nn.Conv2d), "put there by the constructor"
        part4, part3, part2, part1 = fuse.weight.flatten(1).chunk(4, 1)
        mixed = _projected(self.linear_c1, maps[0], part1, fuse.bias)
        smaller = (
            _projected(self.linear_c2, maps[1], part2),
            _projected(self.linear_c3, maps[2], part3),
            _projected(self.linear_c4, maps[3], part4),
        )
        for small in smaller:
            mixed = mixed + F.interpolate(
                small, size=mixed.shape[2:], mode="bilinear", align_corners=False
            )
        mixed = self.linear_fuse[1:](mixed)
        if self.training and self.dropout > 0:
            mixed = drop_channels(mixed, self.dropout, generator)
        scores = self.linear_pred(mixed).float()
        return F.interpolate(scores, size=image_hw, mode="bilinear", align_corners=False)


def _projected(
    linear: nn.Module, x: Tensor, following: Tensor, bias: Tensor | None = None
) -> Tensor:
    """``following (proj x + b) + bias``: (N, H, W, in), (E, out) and (E,) -> (N, E, H, W)."""
    offset = following @ linear.get_parameter("proj.bias")
    if bias is not None:
        offset = offset + bias
    weight = following @ linear.get_parameter("proj.weight")
    return F.linear(x, weight, offset).permute(0, 3, 1, 2)
