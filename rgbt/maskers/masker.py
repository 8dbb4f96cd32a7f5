"""Maskers: which cells of RGB and of thermal are hidden; conf/masker/ configures them.

A mask is (B, h, w) bool, True = taken. A whole batch is drawn on the device of the arguments.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from annotated_types import Interval, MultipleOf, doc
from torch import Tensor

from rgbt.checks import InputError, check_members, described
from rgbt.geometry.padding import STRIDE, padded_hw
from rgbt.ranges import Pixels, Share
from rgbt.requirements import MaskerRecord
from rgbt.types import MaskPair

Sampler = Literal["none", "uniform", "bernoulli", "square", "gaussian_count", "gaussian_bernoulli"]

PatchSize = Annotated[int, Interval(ge=4, le=8192), MultipleOf(4), doc("pixels, whole tokens")]

CELLS = {"patch_size", "pairing"}
GAUSSIAN = CELLS | {"sigma_div", "anchor", "cell_position"}
NEEDED: dict[str, set[str]] = {
    "none": set(),
    **dict.fromkeys(("uniform", "bernoulli", "square"), CELLS | {"ratio"}),
    "gaussian_count": GAUSSIAN | {"ratio"},
    "gaussian_bernoulli": GAUSSIAN,
}


@dataclass(frozen=True, kw_only=True)
class Masker:
    """Draws which cells of a crop are hidden in RGB and in thermal.

    The crop is padded to multiples of 32 pixels as the networks do, and cut into square cells.
    The position of the Gaussian, where paper and release of SpatialSeg differ:
        Paper: grid centre (N_y / 2, N_x / 2); cell i lies at i, so the weight leans by half a cell
            to the bottom and right (`anchor: grid`, `cell_position: index`).
        Released: centre of the original image, followed through resize, crop and flip and floored
            to a cell (`anchor: tracked`, `cell_position: index`).
        `cell_position: centre` measures cells at their middle and removes that half cell.
    Its width: ``sigma_p = N_y / sigma_div`` cells. Whether N_y counts the rows of the image or of
    the crop is open in the paper; the release takes the padded crop (`sigma_height: null`).

    The settings are the keys of ``conf/masker/grbm.yaml``.

    Attributes:
        sampler: "none" hides nothing; "uniform" a fixed number of cells (CRM); "square" one
            rectangle (CRM, Fig. 5); "gaussian_count" a fixed number, likelier near the anchor
            (SpatialSeg as released); "gaussian_bernoulli" each cell with the probability of the
            Gaussian (SpatialSeg, Eq. 9); "bernoulli" each with the probability `ratio` (MIC).
        pairing: "comp" RGB hides the mask, thermal its complement (CRM, Sec. 3.2; SpatialSeg,
            Eqs. 6 and 10); "rand_comp" one of three patterns per sample, (M_rgb, M_th) =
            (0, 1 - m), (m, 0) or (m, 1 - m) (SpatialSeg, Eq. 11; in both releases each with 1/3);
            "indiv" two independent masks; "same" one mask for both (MIC has one image).
    """

    sampler: Sampler
    patch_size: PatchSize | None
    ratio: Share | None
    sigma_div: Annotated[float, Interval(ge=0.001, le=10_000)] | None
    sigma_height: Pixels | None
    anchor: Literal["grid", "tracked"] | None
    cell_position: Literal["index", "centre"] | None
    pairing: Literal["comp", "rand_comp", "indiv", "same"] | None
    pattern_probabilities: tuple[Share, Share, Share] | None

    @property
    def record(self) -> MaskerRecord:
        """State whether cells are hidden; a scheme omits the masked pass where none are."""
        return MaskerRecord(hides_cells=self.sampler != "none")

    def __post_init__(self) -> None:
        needed = NEEDED[self.sampler] | {"sampler"}
        optional = {"sigma_height"} if "sigma_div" in needed else set()
        optional |= {"pattern_probabilities"} if self.pairing == "rand_comp" else set()
        for name, value in vars(self).items():
            if name not in optional and (name in needed) == (value is None):
                effect = " requires a value" if name in needed else f"={value} has no effect"
                raise InputError(
                    f"masker.{name}{effect} with masker.sampler={self.sampler} and masker.pairing="
                    f"{self.pairing}."
                )
        if self.sigma_height is not None and self.sigma_height < (self.patch_size or 1):
            raise InputError(f"masker.sigma_height={self.sigma_height} is less than one cell.")
        shares = self.pattern_probabilities
        if shares is not None and abs(sum(shares) - 1) > 1e-6:
            raise InputError(f"masker.pattern_probabilities must sum to 1, got {list(shares)}.")

    def __call__(
        self, image_hw: tuple[int, int], centre_yx: Tensor, generator: torch.Generator
    ) -> MaskPair:
        """Draw cells (B, h, w) bool of the padded crop, True = hidden, independent per sample.

        `image_hw` is the size of the crop in pixels, before padding, and `centre_yx` (B, 2) the
        pixel of the crop nearest to the centre of the original image, on the generator's device.
        """
        grid_hw = self.grid_hw(image_hw)
        if self.sampler == "none":
            nothing = centre_yx.new_zeros((len(centre_yx), *grid_hw), dtype=torch.bool)
            return MaskPair(nothing, nothing.clone())
        taken = self._draw(grid_hw, centre_yx, generator)
        if self.pairing == "indiv":
            return MaskPair(taken, self._draw(grid_hw, centre_yx, generator))
        if self.pairing == "same":
            return MaskPair(taken, taken.clone())
        if self.pairing == "comp":
            return MaskPair(rgb=taken, thermal=~taken)
        shares = torch.tensor(self.pattern_probabilities or (1 / 3,) * 3, device=taken.device)
        pattern = torch.multinomial(shares, len(taken), replacement=True, generator=generator)
        pattern = pattern[:, None, None]
        return MaskPair(rgb=taken & (pattern != 0), thermal=~taken & (pattern != 1))

    def grid_hw(self, image_hw: tuple[int, int]) -> tuple[int, int]:
        """Count the cells (h, w) of a crop of `image_hw` pixels; InputError for parts of cells."""
        height, width = padded_hw(image_hw)
        size = self.patch_size or STRIDE
        if height % size or width % size:
            raise InputError(
                f"masker.patch_size={size} does not divide the padded crop of {height}x{width} "
                f"pixels; it must divide {math.gcd(height, width)}."
            )
        return height // size, width // size

    def _draw(
        self, grid_hw: tuple[int, int], centre_yx: Tensor, generator: torch.Generator
    ) -> Tensor:
        """Draw the cells that one mask takes, (B, h, w) bool."""
        if self.ratio is None:
            return bernoulli(self._log_weight(grid_hw, centre_yx), generator)
        if self.sampler == "square":
            return square(len(centre_yx), grid_hw, self.ratio, generator)
        same = centre_yx.new_zeros((len(centre_yx), *grid_hw), dtype=torch.float32)
        if self.sampler == "bernoulli":
            return bernoulli((same + self.ratio).log(), generator)
        weight = same if self.sampler == "uniform" else self._log_weight(grid_hw, centre_yx)
        return fixed_count(weight, num_taken(grid_hw, self.ratio), generator)

    def _log_weight(self, grid_hw: tuple[int, int], centre_yx: Tensor) -> Tensor:
        """Return log (B, h, w) of a Gaussian of the distance in cells from a centre, 0 there.

            log W(y, x) = -((y + o - c_y)^2 + (x + o - c_x)^2) / (2 sigma^2)

        Source: SpatialSeg, Sec. IV-B, Eq. 8 (o = 0). o is 0 at the index of a cell, 0.5 in its
        middle.
        """
        assert self.patch_size, "the constructor requires it"
        assert self.sigma_div, "the constructor requires it"
        rows = grid_hw[0] if self.sigma_height is None else self.sigma_height // self.patch_size
        sigma_cells = rows / self.sigma_div
        by_index = self.cell_position == "index"
        offset = 0.0 if by_index else 0.5
        if self.anchor == "grid":
            middle = centre_yx.new_tensor(grid_hw, dtype=torch.float32) / 2
            centre = middle.expand(len(centre_yx), 2)
        elif by_index:
            centre = (centre_yx // self.patch_size).float()
        else:
            centre = (centre_yx + 0.5) / self.patch_size
        y, x = (torch.arange(side, device=centre.device) + offset for side in grid_hw)
        squared_y, squared_x = (y - centre[:, :1]) ** 2, (x - centre[:, 1:]) ** 2
        return -(squared_y[:, :, None] + squared_x[:, None, :]) / (2 * sigma_cells**2)


def num_taken(grid_hw: tuple[int, int], ratio: float) -> int:
    """Return ``ceil(h w ratio)`` (CRM release); 20 * 0.55 = 11.000000000000002 are eleven."""
    return math.ceil(grid_hw[0] * grid_hw[1] * ratio - 1e-9)


def fixed_count(log_weight: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draw exactly `count` cells per mask, one after the other, without replacement.

    Each draw takes a cell with probability proportional to its weight among the cells still there.
    The same distribution in one step (Efraimidis and Spirakis, Information Processing Letters 97,
    2006): the `count` largest of ``log w - log e`` with independent exponential e, (B, h, w).
    """
    waiting = torch.empty_like(log_weight).exponential_(generator=generator)
    keys = (log_weight - waiting.log()).flatten(1)
    taken = torch.zeros_like(keys, dtype=torch.bool)
    taken.scatter_(1, keys.topk(count, dim=1).indices, value=True)
    return taken.view_as(log_weight)


def bernoulli(log_probability: Tensor, generator: torch.Generator) -> Tensor:
    """Draw cells (B, h, w) independently with their own probabilities (SpatialSeg, Eq. 9)."""
    uniform = torch.rand(log_probability.shape, generator=generator, device=log_probability.device)
    return uniform < log_probability.exp()


def square(
    batch: int, grid_hw: tuple[int, int], ratio: float, generator: torch.Generator
) -> Tensor:
    """Draw a rectangle per mask at a uniform position, `ratio` of the height and of the width.

    Sides are rounded to whole cells; (B, h, w) bool. Paper: CRM, Fig. 5 (half of both sides).
    Released: the square mask stops with a size mismatch (rows and columns of the slice are
    exchanged, and the mask is in pixels where tokens are expected).
    """
    inside, device = [], generator.device
    for length in grid_hw:
        extent = round(length * ratio)
        last = length - extent
        start = torch.randint(last + 1, size=[batch, 1], generator=generator, device=device)
        position = torch.arange(length, device=device)
        inside.append((position >= start) & (position < start + extent))
    return inside[0][:, :, None] & inside[1][:, None, :]


def check_masker(masker: object, image_hw: tuple[int, int], generator: torch.Generator) -> None:
    """Draw one mask of a user's own masker; InputError if it does not fit the crop."""
    check_members("masker", masker, (), {"__call__": ("image_hw", "centre_yx", "generator")})
    found = masker(image_hw, torch.zeros(1, 2, dtype=torch.int64), generator)  # type: ignore[operator]
    height, width = padded_hw(image_hw)
    masks = tuple(found) if isinstance(found, MaskPair) else (found,)
    for mask in masks:
        shape = tuple(getattr(mask, "shape", ()))
        fits = len(masks) == 2 and len(shape) == 3 and shape[0] == 1 and 0 not in shape
        fits = fits and shape == masks[0].shape and not (height % shape[1] or width % shape[2])
        if not fits or mask.dtype != torch.bool:
            raise InputError(
                f"masker: {type(masker).__name__} returned {described(mask)}; expected "
                f"MaskPair(rgb, thermal), each bool (B, h, w), h and w dividing {height} and "
                f"{width}, the padded size of the crop."
            )
