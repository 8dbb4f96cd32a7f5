"""Every variant of the masker: shares, pairing, replay, published statistics, bad settings."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.maskers.masker import Masker, fixed_count, num_taken, square
from rgbt.randomness import torch_generator
from rgbt.types import MaskPair
from tests.models.golden import FOLDER

GOLDEN = FOLDER / "losses.npz"
VARIANTS = ["none", "crm", "irm", "mic", "square", "grbm_paper", "grbm_released"]


def configured(variant: str, scale: str = "paper", **changes: object) -> Masker:
    """The masker of conf/masker/<variant>.yaml at a scale, with some settings changed."""
    config = compose([f"masker={variant}", f"scale={scale}"])
    config.masker.update(changes)
    return build(config.masker)


def drawn(
    variant: str, count: int, *, scale: str = "paper", seed: int = 0, **changes: object
) -> MaskPair:
    """Masks of crops of 240x320 (demo: 120x160) whose centre is that of the original."""
    hw = (240, 320) if scale == "paper" else (120, 160)
    centre = torch.tensor([[hw[0] // 2, hw[1] // 2]]).expand(count, 2)
    return configured(variant, scale, **changes)(hw, centre, torch_generator(0, "m", seed))


def at_pixels(centre: list[list[int]], **changes: object) -> list[list[int]]:
    """The cells that a very narrow Gaussian of the release takes."""
    masker = configured("grbm_released", pairing="comp", sigma_div=100.0, **changes)
    return masker((240, 320), torch.tensor(centre), torch_generator(0, "m")).rgb.nonzero().tolist()


@pytest.mark.parametrize("variant", VARIANTS)
def test_contract_of_every_masker(variant) -> None:
    """Shapes and types, the same cells at every scale, and draws of the generator alone."""
    paper, demo = drawn(variant, 3), drawn(variant, 3, scale="demo")
    assert all(mask.dtype == torch.bool and len(mask) == 3 for mask in (*paper, *demo))
    if variant not in ("square", "none"):
        # Half of the pixels in half of the cell: the same grid, and the same draws.
        assert all(torch.equal(*pair) for pair in zip(paper, demo, strict=True))
    before = torch.get_rng_state()
    first, second, other = (drawn(variant, 64, seed=seed) for seed in (7, 7, 8))
    assert all(torch.equal(*pair) for pair in zip(first, second, strict=True))
    assert variant == "none" or not torch.equal(first.rgb, other.rgb)
    assert torch.equal(before, torch.get_rng_state())
    hidden = (first.rgb | first.thermal).any().item()
    assert configured(variant).record.hides_cells == bool(hidden)


@pytest.mark.parametrize("variant", ["crm", "grbm_released"])
def test_counts_are_exact_and_masks_complementary(variant) -> None:
    masks = drawn(variant, 100, pairing="comp")
    assert (masks.rgb.sum((1, 2)) == masks.rgb[0].numel() // 2).all()
    assert torch.equal(masks.thermal, ~masks.rgb)


@pytest.mark.parametrize("ratio", [0.3, 0.7])
def test_individual_masks_have_the_ratio_each_and_overlap(ratio) -> None:
    masks = drawn("irm", 500, ratio=ratio)
    assert all((mask.sum((1, 2)) == round(80 * ratio)).all() for mask in masks)
    # Independent: both hidden in ratio^2 of the cells.
    both = (masks.rgb & masks.thermal).double().mean().item()
    assert both == pytest.approx(ratio**2, abs=0.02)
    # No mask of thermal is that of RGB of any sample.
    rgb, thermal = (mask.flatten(1) for mask in masks)
    assert not (thermal[:, None] == rgb).all(-1).any()


def test_cells_of_mic_are_independent_and_hide_both_images() -> None:
    masks = drawn("mic", 4000)
    assert torch.equal(masks.rgb, masks.thermal)
    # 80 cells: the variance of their number is 80 * 0.7 * 0.3 = 16.8, with a standard error of 0.4.
    counts = masks.rgb.sum((1, 2)).double()
    assert counts.mean().item() / 80 == pytest.approx(0.7, abs=0.005)
    assert counts.var().item() == pytest.approx(16.8, abs=1.6)


@pytest.mark.parametrize(
    ("shares", "rgb", "thermal"),
    [([1, 0, 0], False, True), ([0, 1, 0], True, False), ([0, 0, 1], True, True)],
)
def test_given_pattern_probabilities_in_their_order(shares, rgb, thermal) -> None:
    masks = drawn("crm", 64, pattern_probabilities=[float(share) for share in shares])
    for mask, is_hidden in zip(masks, (rgb, thermal), strict=True):
        assert (mask.sum((1, 2)) == 40 * is_hidden).all()


def gaussian(sigma: float) -> list[float]:
    """Eq. 8 on the 4 x 5 grid, cell by cell."""
    squares = [(y - 2.0) ** 2 + (x - 2.5) ** 2 for y in range(4) for x in range(5)]
    return [np.exp(-square / (2 * sigma**2)) for square in squares]


def test_paper_gaussian_hides_its_expected_share() -> None:
    weights = gaussian(4 / 4)
    assert np.mean(weights) == pytest.approx(0.289, abs=5e-4)
    masks = drawn("grbm_paper", 20000, pairing="comp")
    np.testing.assert_allclose(masks.rgb.double().mean(0).flatten(), weights, atol=0.015)
    assert masks.rgb.sum((1, 2)).unique().numel() > 3, "the number of cells must vary"
    # N_y counted on 480 rows is 7 instead of 4.
    wide = drawn("grbm_paper", 4000, pairing="comp", sigma_height=480).rgb.double().mean().item()
    assert wide == pytest.approx(np.mean(gaussian(7 / 4)), abs=0.015)


def test_cell_middles_remove_the_lean_of_half_a_cell() -> None:
    lean = []
    for position in ("index", "centre"):
        masks = drawn("grbm_paper", 8000, pairing="comp", cell_position=position)
        share = masks.rgb.double().mean(0)
        lean.append((share[2:].sum() - share[:2].sum()).item() / share.sum().item())
    assert lean[0] > 0.2
    assert lean[1] == pytest.approx(0, abs=0.02)


def test_tracked_anchor_follows_the_centre_of_each_sample() -> None:
    # 5 % of 20 cells is one cell, and so narrow a Gaussian leaves only the cell at its centre.
    found = at_pixels([[0, 0], [70, 200], [239, 319]], ratio=0.05)
    assert found == [[0, 0, 0], [1, 1, 3], [2, 3, 4]]
    # Floored: (60, 125) lies in cell (0, 1), although (1, 2) is nearer.
    assert at_pixels([[60, 125]], ratio=0.05) == [[0, 0, 1]]
    # Pixel 63 lies beside the edge between cells 0 and 1: their middles are nearest.
    found = at_pixels([[30, 63]], ratio=0.1, cell_position="centre")
    assert found == [[0, 0, 0], [0, 0, 1]]
    # Pixel 64, whose middle lies at 64.5, is nearer to the middle of cell 1 than to that of cell 0.
    found = at_pixels([[31, 64]] * 200, ratio=0.05, cell_position="centre")
    assert sum(column == 1 for _, _, column in found) > 180


CASES = {
    "grbm_mf_no_centre": ("grbm_released", {"anchor": "grid"}, (256, 320), None),
    "grbm_mf_centre_128_160": ("grbm_released", {}, (256, 320), (128, 160)),
    "grbm_mf_centre_20_300": ("grbm_released", {}, (256, 320), (20, 300)),
    "grbm_kp_no_centre": ("grbm_released", {"anchor": "grid", "patch_size": 32}, (256, 320), None),
    "grbm_pst_no_centre": ("grbm_released", {"anchor": "grid", "patch_size": 32}, (224, 320), None),
    "crm_mf": ("crm", {}, (256, 320), None),
    "crm_pst": ("crm", {}, (224, 320), None),
}


@pytest.mark.skipif(not GOLDEN.exists(), reason="reference material is not beside the checkout")
@pytest.mark.parametrize("case", CASES)
def test_frequencies_of_the_releases(case) -> None:
    variant, changes, size, centre = CASES[case]
    stored, draws = np.load(GOLDEN), 20000
    centres = torch.tensor([centre or (0, 0)]).expand(draws, 2)
    masks = configured(variant, **changes)(size, centres, torch_generator(0, "golden"))
    for name, mask in zip(("rgb", "thermal"), masks, strict=True):
        expected = stored[f"masks.{case}.{name}_frequency"]
        np.testing.assert_allclose(mask.double().mean(0), expected, atol=0.02)
    rgb, thermal = (mask.any((1, 2)) for mask in masks)
    counts = [int(p.sum()) for p in (~rgb & thermal, rgb & ~thermal, rgb & thermal)]
    np.testing.assert_allclose(counts, stored[f"masks.{case}.pattern_counts"], atol=400)


@pytest.mark.parametrize(
    ("variant", "changes", "key"),
    [
        ("crm", {"sigma_div": 4.0}, "masker.sigma_div"),
        ("crm", {"ratio": None}, "masker.ratio"),
        ("none", {"patch_size": 32}, "masker.patch_size"),
        ("grbm_paper", {"ratio": 0.5}, "masker.ratio"),
        ("grbm_paper", {"sigma_div": None}, "masker.sigma_div"),
        ("grbm_paper", {"sigma_height": 32}, "masker.sigma_height"),
        ("irm", {"pattern_probabilities": [0.3, 0.3, 0.4]}, "masker.pattern_probabilities"),
        ("crm", {"pattern_probabilities": [0.5, 0.5, 0.5]}, "masker.pattern_probabilities"),
    ],
)
def test_wrong_setting_or_one_without_effect_is_named(variant, changes, key) -> None:
    with pytest.raises(InputError, match=key):
        configured(variant, **changes)


def test_grid_of_the_padded_crop() -> None:
    assert configured("grbm_paper").grid_hw((240, 320)) == (4, 5)
    assert configured("grbm_paper", "demo").grid_hw((120, 160)) == (4, 5)
    assert configured("crm").grid_hw((216, 320)) == (7, 10)
    with pytest.raises(InputError, match=r"masker.patch_size=64 .* 224x320 .* must divide 32\.$"):
        configured("grbm_released").grid_hw((224, 320))


# ---- functions -----------------------------------------------------------------------------


def test_number_of_cells_is_rounded_up() -> None:
    cells = {((8, 10), 0.5): 40, ((3, 3), 0.5): 5, ((4, 5), 0.55): 11, ((4, 5), 0): 0}
    assert {given: num_taken(*given) for given in cells} == cells


def test_gaussian_by_hand() -> None:
    masker = configured("grbm_paper", sigma_div=1.0)
    weight = masker._log_weight((2, 3), torch.zeros(1, 2, dtype=torch.int64))
    # Centre (1, 1.5), sigma 2: log W(0, 0) = -(1 + 2.25) / 8, log W(1, 2) = -0.25 / 8
    assert weight.shape == (1, 2, 3)
    assert weight[0, 0, 0].item() == pytest.approx(-3.25 / 8)
    assert weight[0, 1, 2].item() == pytest.approx(-0.25 / 8)


def test_fixed_count_is_drawing_one_after_the_other() -> None:
    # Three cells of weight 4, 2, 1; two are drawn without replacement.
    weights = (4.0, 2.0, 1.0)
    expected = dict.fromkeys(range(3), 0.0)
    for first, second in itertools.permutations(range(3), 2):
        rest = sum(weights) - weights[first]
        probability = weights[first] / sum(weights) * weights[second] / rest
        expected[first] += probability
        expected[second] += probability
    log_weight = torch.tensor(weights).log().expand(40000, 1, 3)
    share = fixed_count(log_weight, 2, torch_generator(1, "t")).double().mean(0)[0]
    # Standard error at most 0.0025.
    assert share.tolist() == pytest.approx([expected[i] for i in range(3)], abs=0.01)


@pytest.mark.parametrize(
    ("grid_hw", "ratio", "sides"),
    [((7, 9), 0.7, (5, 6)), ((5, 3), 0.55, (3, 2)), ((9, 5), 1, (9, 5))],
)
def test_sides_of_squares_are_rounded_to_cells(grid_hw, ratio, sides) -> None:
    """Of 7 x 9 cells 4.9 and 6.3, of 5 x 3 cells 2.75 and 1.65."""
    taken = square(50, grid_hw, ratio, torch_generator(0, "t"))
    assert taken.shape == (50, *grid_hw)
    assert (taken.any(2).sum(1) == sides[0]).all()
    assert (taken.any(1).sum(1) == sides[1]).all()


def test_square_is_one_rectangle_of_half_the_sides() -> None:
    taken = square(200, (8, 10), 0.5, torch_generator(0, "t"))
    rows, columns = taken.any(2), taken.any(1)
    assert (rows.sum(1) == 4).all()
    assert (columns.sum(1) == 5).all()
    assert torch.equal(taken, rows[:, :, None] & columns[:, None, :])
    # Contiguous: the first and last taken row are three apart.
    first = rows.int().argmax(1)
    last = 7 - rows.flip(1).int().argmax(1)
    assert (last - first == 3).all()
    # Every one of the 5 x 6 positions occurs.
    assert set(first.tolist()) == set(range(5))
    assert set(columns.int().argmax(1).tolist()) == set(range(6))
