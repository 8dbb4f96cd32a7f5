"""CRM, Fig. 5: examples of masks, a square and patches of several sizes, on one pair of images."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from analysis.figures import style
from analysis.figures.inputs import FigureInput
from rgbt.checks import InputError
from rgbt.config.command import built

if TYPE_CHECKING:
    from rgbt.types import AnyMasker, Sample

PATCHES = (8, 16, 32, 64)
"""Sides in pixels that the paper draws (CRM, Fig. 5 and Table 3b)."""

STRIDE = 32
"""Maskers cut images whose sides are multiples of this; others they would pad with black."""

HIDDEN = (150, 190, 230)
"""Colour of a hidden pixel: a grey one would be lost in a thermal image."""


@dataclass(frozen=True)
class MaskExample:
    """One mask on a pair of images: (H, W, 3) pictures with hidden pixels in the colour `HIDDEN`,
    and (H, W) which pixels are hidden.
    """

    title: str
    rgb: NDArray[np.uint8]
    thermal: NDArray[np.uint8]
    rgb_hidden: NDArray[np.bool_]
    thermal_hidden: NDArray[np.bool_]


def make(given: FigureInput) -> Figure:
    """Masks on a pair of images."""
    patches = given.get("patches", PATCHES)
    sample = given.dataset.read(given.name())
    chosen = masker_overrides(patches).items()
    maskers = {title: built("masker", overrides) for title, overrides in chosen}
    return draw(mask_examples(sample, maskers, whole_cells(patches), given.get("seed", 0)))


def masker_overrides(patches: Sequence[int]) -> dict[str, tuple[str, ...]]:
    """Title -> what chooses the masker of each column of Fig. 5: a square, then the patches.

    The pairing is the complementary one: what one image hides, the other shows.
    """
    square = ("masker=square", "masker.pairing=comp")
    each = ("masker=crm", "masker.pairing=comp")
    by_size = {f"{size} x {size} pixels": (*each, f"masker.patch_size={size}") for size in patches}
    return {"square": square, **by_size}


def mask_examples(
    sample: Sample, maskers: Mapping[str, AnyMasker], multiple: int, seed: int
) -> tuple[MaskExample, ...]:
    """The pair under each mask.

    The images are cut around their centre to whole cells: 64 pixels do not divide 480.

    Args:
        sample: a pair of the data set.
        maskers: by title.
        multiple: number of pixels that every cell divides.
        seed: every mask is drawn from it and its place among the maskers.

    Raises:
        InputError: the images are smaller than one cell.
    """
    import torch

    from rgbt.randomness import torch_generator

    rgb, thermal = (_cut(image, multiple, sample.name) for image in (sample.rgb, sample.thermal))
    height, width = thermal.shape
    centre = torch.tensor([[height // 2, width // 2]])
    examples = []
    for index, (title, masker) in enumerate(maskers.items()):
        pair = masker((height, width), centre, torch_generator(seed, "figure masks", index))
        hidden = [
            np.kron(
                cells[0].numpy(), np.ones((height // cells.shape[1], width // cells.shape[2]), bool)
            )
            for cells in (pair.rgb, pair.thermal)
        ]
        shown = [rgb.copy(), np.repeat(thermal[..., None], 3, axis=2)]
        for image, each in zip(shown, hidden, strict=True):
            image[each] = HIDDEN
        examples.append(MaskExample(title, shown[0], shown[1], hidden[0], hidden[1]))
    return tuple(examples)


def whole_cells(patches: Sequence[int]) -> int:
    """Number of pixels that all patch sizes and the stride of the networks divide.

    Raises:
        InputError: a size that is not positive.
    """
    if min(patches, default=1) < 1:
        raise InputError(f"patches must be positive numbers of pixels, got {min(patches)}.")
    return math.lcm(STRIDE, *patches)


def _cut(image: NDArray[np.uint8], multiple: int, name: str) -> NDArray[np.uint8]:
    """The largest centred part whose sides are multiples of `multiple`."""
    sides = [length // multiple * multiple for length in image.shape[:2]]
    if min(sides) == 0:
        raise InputError(
            f"'{name}' has {image.shape[0]}x{image.shape[1]} pixels, less than cells of {multiple} "
            "need; give smaller ones, for example patches=8,16."
        )
    top, left = ((length - side) // 2 for length, side in zip(image.shape, sides, strict=False))
    return image[top : top + sides[0], left : left + sides[1]]


@style.styled
def draw(examples: Sequence[MaskExample]) -> Figure:
    """One column per mask; RGB above, thermal below."""
    height, width = examples[0].thermal_hidden.shape
    cell = (style.PAGE - 0.2) / len(examples)
    figure = style.new_figure(style.PAGE, 2 * (cell * height / width + 0.02) + 0.18)
    style.pack(figure)
    axes = figure.subplots(2, len(examples), squeeze=False)
    for column, example in enumerate(examples):
        style.show_image(axes[0, column], example.rgb)
        style.show_image(axes[1, column], example.thermal)
        axes[0, column].set_title(example.title)
    axes[0, 0].set_ylabel("RGB")
    axes[1, 0].set_ylabel("thermal")
    return figure
