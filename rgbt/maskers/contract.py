"""Check that a user's own masker follows the interface of maskers."""

from __future__ import annotations

import torch
from torch import Tensor

from rgbt.checks import InputError, check_members, described
from rgbt.geometry.padding import padded_hw
from rgbt.types import MaskPair

CALL = {"__call__": ("image_hw", "centre_yx", "generator")}


def check_masker(masker: object, image_hw: tuple[int, int], generator: torch.Generator) -> None:
    """Draw one mask, and refuse a masker that does not follow `rgbt.types.AnyMasker`.

    Args:
        masker: any object.
        image_hw: size of a crop in pixels, before padding.
        generator: of that draw.

    Raises:
        InputError: naming its class, what it returned and what was expected.
    """
    check_members("masker", masker, (), CALL)
    centre = torch.zeros(1, 2, dtype=torch.int64)
    check_masks(masker, masker(image_hw, centre, generator), image_hw, 1)  # type: ignore[operator]


def check_masks(masker: object, found: object, image_hw: tuple[int, int], count: int) -> None:
    """Check the masks for `count` crops of `image_hw` pixels; InputError as above."""
    height, width = padded_hw(image_hw)
    returned = f"masker: {type(masker).__name__}.__call__ returned {described(found)}"
    expected = (
        f"expected MaskPair(rgb, thermal), each bool ({count}, h, w), True = hidden, h and w "
        f"dividing {height} and {width}: a crop of {image_hw[0]}x{image_hw[1]} pixels is padded to "
        f"{height}x{width} before cells are cut"
    )
    if not isinstance(found, MaskPair) or not all(isinstance(each, Tensor) for each in found):
        raise InputError(f"{returned}; {expected}.")
    for name, mask in zip(found._fields, found, strict=True):
        fits = mask.dtype == torch.bool and mask.dim() == 3 and len(mask) == count
        cells = tuple(mask.shape[1:])
        if not fits or 0 in cells or height % cells[0] or width % cells[1]:
            raise InputError(f"{returned}: {name} is {described(mask)}; {expected}.")
    if found.rgb.shape != found.thermal.shape:
        raise InputError(f"{returned}: rgb and thermal differ in size; {expected}.")
