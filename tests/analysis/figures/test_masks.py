"""CRM, Fig. 5."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch

from analysis.figures.masks import (
    HIDDEN,
    PATCHES,
    mask_examples,
    masker_overrides,
    whole_cells,
)
from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.types import MaskPair, Sample


def sample(height: int = 100, width: int = 140) -> Sample:
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 100, (height, width, 3), dtype=np.uint8)
    return Sample(rgb=rgb, thermal=rgb[..., 0].copy(), label=None, name="00001D")


@cache
def masker(words: tuple[str, ...]):
    return build(compose(words).masker)


def examples(patches: tuple[int, ...] = PATCHES, seed: int = 0):
    chosen = masker_overrides(patches)
    maskers = {title: masker(words) for title, words in chosen.items()}
    return mask_examples(sample(), maskers, whole_cells(patches), seed)


def test_a_known_mask_hides_its_cells_in_the_cut_image() -> None:
    """100 x 140 cut to 64 x 128 around the middle: from row 18, column 6."""

    def left_half(image_hw, centre_yx, generator):
        assert image_hw == (64, 128)
        assert centre_yx.tolist() == [[32, 64]]
        cells = torch.tensor([[[True, False]]])
        return MaskPair(cells, ~cells)

    (found,) = mask_examples(sample(), {"left": left_half}, 64, seed=0)
    assert found.rgb_hidden[:, :64].all()
    assert not found.rgb_hidden[:, 64:].any()
    np.testing.assert_array_equal(found.thermal_hidden, ~found.rgb_hidden)
    assert (found.rgb[:, :64] == HIDDEN).all()
    np.testing.assert_array_equal(found.rgb[:, 64:], sample().rgb[18:82, 70:134])
    np.testing.assert_array_equal(found.thermal[:, :64, 1], sample().thermal[18:82, 6:70])


def test_the_maskers_of_the_paper() -> None:
    found = {each.title: each for each in examples()}
    assert list(found) == ["square", *(f"{n} x {n} pixels" for n in PATCHES)]
    for each in found.values():
        np.testing.assert_array_equal(each.thermal_hidden, ~each.rgb_hidden)
    for size in PATCHES:
        hidden = found[f"{size} x {size} pixels"].rgb_hidden
        cells = hidden[::size, ::size]
        np.testing.assert_array_equal(np.kron(cells, np.ones((size, size), bool)), hidden)
        assert cells.mean() == 0.5
    rows, columns = np.nonzero(found["square"].rgb_hidden)
    box = found["square"].rgb_hidden[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    assert box.all()
    assert box.shape == (32, 64)  # half of each side


def test_seed_decides_the_masks() -> None:
    first, again, other = (examples(seed=seed)[1].rgb_hidden for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_images_smaller_than_a_cell() -> None:
    with pytest.raises(InputError, match="100x140 pixels, less than cells of 128"):
        mask_examples(sample(), {}, 128, seed=0)


def test_sizes_are_positive() -> None:
    assert whole_cells((8, 48)) == 96
    with pytest.raises(InputError, match="patches must be positive"):
        whole_cells((8, 0))
