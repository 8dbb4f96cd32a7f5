"""The masker class, which every file of conf/masker/ configures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from annotated_types import Interval, MultipleOf, doc
from torch import Tensor

from rgbt.checks import InputError, check_shape
from rgbt.geometry.padding import STRIDE, padded_hw
from rgbt.maskers import pattern
from rgbt.ranges import Pixels, Share
from rgbt.requirements import Record
from rgbt.types import MaskPair

Sampler = Literal["none", "uniform", "bernoulli", "square", "gaussian_count", "gaussian_bernoulli"]
TOKEN = 4
"""Pixels per token side of the networks; a cell holds whole tokens."""

PatchSize = Annotated[int, Interval(ge=TOKEN, le=8192), MultipleOf(TOKEN), doc("pixels")]

THIRDS = (1 / 3, 1 / 3, 1 / 3)
"""The three patterns of `rand_comp` are equally likely in both releases."""

CELLS = {"patch_size", "pairing"}
GAUSSIAN = {"sigma_div", "anchor", "cell_position"}
NEEDED: dict[str, set[str]] = {
    "none": set(),
    "uniform": CELLS | {"ratio"},
    "bernoulli": CELLS | {"ratio"},
    "square": CELLS | {"ratio"},
    "gaussian_count": CELLS | GAUSSIAN | {"ratio"},
    "gaussian_bernoulli": CELLS | GAUSSIAN,
}


@dataclass(frozen=True, kw_only=True)
class Masker:
    """Draws which cells of a crop are hidden in RGB and in thermal.

    The crop is padded to multiples of 32 pixels as the networks do, and cut into square cells.
    One draw per sample, on the device of the batch, from a passed generator.

    The position of the Gaussian, where paper and release of SpatialSeg differ:
        Paper: grid centre (N_y / 2, N_x / 2); cell i lies at i, so the weight leans by half a cell
            to the bottom and right (`anchor: grid`, `cell_position: index`).
        Released: centre of the original image, followed through resize, crop and flip and floored
            to a cell (`anchor: tracked`, `cell_position: index`).
        `cell_position: centre` measures cells at their middle and removes that half cell.
    Its width: ``sigma_p = N_y / sigma_div`` cells. Whether N_y counts the rows of the image or of
    the crop is open in the paper; the release takes the padded crop (`sigma_height: null`).

    Attributes:
        sampler: "none" hides nothing; "uniform" a fixed number of cells (CRM); "square" one
            rectangle (CRM, Fig. 5); "gaussian_count" a fixed number, likelier near the anchor
            (SpatialSeg as released); "gaussian_bernoulli" each cell independently with the
            Gaussian as its probability (SpatialSeg, Eq. 9); "bernoulli" each cell independently
            with probability `ratio` (MIC).
        patch_size: side of a cell in pixels, multiple of 4; must divide the padded crop.
        ratio: share of the cells that a mask takes, 0..1; for "bernoulli" their probability, and
            for "square" the share of each side.
        sigma_div: M_div, > 0.
        sigma_height: height in pixels that N_y is counted on, ``floor(sigma_height / patch_size)``;
            None: the padded crop.
        anchor: "grid" the middle of the padded crop; "tracked" `centre_yx` of the batch.
        cell_position: "index" or "centre", see above.
        pairing: "comp" RGB hides the mask, thermal its complement; "rand_comp" that, or one of
            the two alone (see `pattern_probabilities`); "indiv" two independent masks; "same" one
            mask for both (MIC has one image).
        pattern_probabilities: of only thermal, only RGB, both hidden, for "rand_comp" alone; None:
            1/3 each.

    Raises:
        InputError: a setting without effect is not None, a required one is None, or the settings
            do not fit each other.
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
    def record(self) -> Record:
        """Cells are hidden, but by the sampler "none"; a scheme then omits the masked pass."""
        return Record(hides_cells=self.sampler != "none")

    def __call__(
        self, image_hw: tuple[int, int], centre_yx: Tensor, generator: torch.Generator
    ) -> MaskPair:
        """(B, h, w) bool cells of the padded crop, True = hidden, one independent draw per sample.

        Args:
            image_hw: size of the crop in pixels, before padding.
            centre_yx: (B, 2), pixel of the crop nearest to the centre of the original image.
            generator: on the device of `centre_yx`.

        Raises:
            InputError: the patch size does not divide the padded crop.
        """
        check_shape("centre_yx", centre_yx, "B yx", yx=2)
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
            return pattern.complementary(taken)
        shares = self.pattern_probabilities or THIRDS
        return pattern.random_complementary(taken, shares, generator)

    def grid_hw(self, image_hw: tuple[int, int]) -> tuple[int, int]:
        """(h, w) cells of a crop of `image_hw` pixels; cheap enough for a check before training.

        Raises:
            InputError: the patch size does not divide the padded crop.
        """
        height, width = padded_hw(image_hw)
        size = self.patch_size or STRIDE
        if height % size or width % size:
            common = math.gcd(height, width)
            fitting = [str(n) for n in range(TOKEN, common + 1, TOKEN) if common % n == 0]
            raise InputError(
                f"masker.patch_size={size} does not divide the padded crop of {height}x{width} "
                f"pixels; sizes that do: {', '.join(fitting)}."
            )
        return height // size, width // size

    def _draw(
        self, grid_hw: tuple[int, int], centre_yx: Tensor, generator: torch.Generator
    ) -> Tensor:
        """(B, h, w) bool, the cells that one mask takes."""
        if self.ratio is None:
            return pattern.bernoulli(self._log_weight(grid_hw, centre_yx), generator)
        if self.sampler == "square":
            return pattern.square(len(centre_yx), grid_hw, self.ratio, generator)
        if self.sampler == "bernoulli":
            every = centre_yx.new_full((len(centre_yx), *grid_hw), self.ratio, dtype=torch.float32)
            return pattern.bernoulli(every.log(), generator)
        if self.sampler == "uniform":
            log_weight = centre_yx.new_zeros((len(centre_yx), *grid_hw), dtype=torch.float32)
        else:
            log_weight = self._log_weight(grid_hw, centre_yx)
        return pattern.fixed_count(log_weight, pattern.num_taken(grid_hw, self.ratio), generator)

    def _log_weight(self, grid_hw: tuple[int, int], centre_yx: Tensor) -> Tensor:
        assert self.patch_size, "the constructor requires it"
        assert self.sigma_div, "the constructor requires it"
        rows = grid_hw[0] if self.sigma_height is None else self.sigma_height // self.patch_size
        by_index = self.cell_position == "index"
        if self.anchor == "grid":
            middle = centre_yx.new_tensor(grid_hw, dtype=torch.float32) / 2
            centre = middle.expand(len(centre_yx), 2)
        elif by_index:
            centre = (centre_yx // self.patch_size).float()
        else:
            centre = (centre_yx + 0.5) / self.patch_size
        offset = 0.0 if by_index else 0.5
        return pattern.gaussian_log_weight(grid_hw, centre, rows / self.sigma_div, offset)

    def __post_init__(self) -> None:
        needed = NEEDED[self.sampler]
        optional = {"sigma_height"} if "sigma_div" in needed else set()
        if self.pairing == "rand_comp":
            optional.add("pattern_probabilities")
        variant = f"masker.sampler={self.sampler} and masker.pairing={self.pairing}"
        for name, value in vars(self).items():
            if name == "sampler" or name in optional:
                continue
            if name in needed and value is None:
                raise InputError(f"masker.{name} requires a value with {variant}, but it is null.")
            if name not in needed and value is not None:
                raise InputError(
                    f"masker.{name}={value} has no effect with {variant}; set masker.{name}=null."
                )
        if self.sigma_height is not None and self.sigma_height < (self.patch_size or 1):
            raise InputError(
                f"masker.sigma_height must be at least masker.patch_size={self.patch_size}, got "
                f"{self.sigma_height}."
            )
        shares = self.pattern_probabilities
        if shares is not None and abs(sum(shares) - 1) > 1e-6:
            raise InputError(
                "masker.pattern_probabilities must be three numbers >= 0 with sum 1 (only thermal, "
                f"only RGB, both), got {list(shares)}."
            )
