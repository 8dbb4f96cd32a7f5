"""Heat maps of regions and profiles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from analysis.figures.profiles import (
    Profile,
    draw_heat,
    draw_profiles,
    map_of,
    means_only,
    profile,
    staircase,
)
from analysis.uncertainty import Resampling
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from tests.analysis.counts import counts_of
from tests.analysis.figures.drawn import strips, texts

FAST = Resampling(resamples=200, blocks="none")


def method(seed: int = 0, regions: int = 2) -> Counts:
    """40 images of 2 classes with 20 pixels of each in every region: the same labels every time."""
    right = np.random.default_rng(seed).integers(1, 20, (40, regions, 2))
    matrices = np.stack([[right[..., 0], 20 - right[..., 0]], [20 - right[..., 1], right[..., 1]]])
    return counts_of(np.moveaxis(matrices, (0, 1), (2, 3)))


def known(label: str, *means: float, partition: str = "ring2") -> Profile:
    return Profile(label, partition, np.array(means), 50.0, 1, 10)


def test_means_by_hand_and_over_seeds() -> None:
    first = counts_of(np.array([[[6, 2], [0, 2]], [[8, 0], [0, 2]]]))  # 62.5 and 100
    second = counts_of(np.array([[[8, 0], [0, 2]], [[6, 2], [0, 2]]]))
    found = means_only("grbm", [first, second, second], "released")
    np.testing.assert_allclose(found.means, [(62.5 + 200) / 3, (100 + 125) / 3])
    assert found.miou == pytest.approx(50 * (14 / 16 + 4 / 6))
    assert found.bars is None


@pytest.mark.parametrize(
    ("seeds", "band", "covers"),
    [
        (1, "widest", "images"),
        (2, "widest", "images and seeds"),
        (2, "images", "images"),
        (2, "seeds", "seeds"),
    ],
)
def test_intervals_cover_requested_sources(seeds: int, band: str, covers: str) -> None:
    found = profile("m", [method(seed) for seed in range(seeds)], FAST, band)
    assert found.covers == covers
    low, high = found.bars
    assert (low < found.means).all()
    assert (found.means < high).all()
    assert (found.seeds, found.images, found.level) == (seeds, 40, 0.95)


@pytest.mark.parametrize("band", ["seeds", "both"])
def test_one_seed_gives_no_interval_over_seeds(band: str) -> None:
    with pytest.raises(InputError, match=f"band={band} needs at least two seeds, but 'm' has one"):
        profile("m", [method()], FAST, band)


def test_methods_over_different_regions_are_refused() -> None:
    other = known("b", 1, 2, 3, partition="ring3")
    for draw in (draw_profiles, lambda profiles: draw_heat(profiles, (48, 64))):
        with pytest.raises(InputError, match="'a' was counted over ring2 but 'b' over ring3"):
            draw([known("a", 1, 2), other])
    with pytest.raises(InputError, match="seeds of 'm' were counted over ring2 and ring3"):
        means_only("m", [method(), method(regions=3)], "released")


def test_partitions_by_name() -> None:
    for name, regions in (("ring5", strips(5, "ring")), ("vertical4", strips(4))):
        np.testing.assert_array_equal(map_of(name, (48, 64)), regions.map((48, 64)))
    assert map_of("ring9_released_3_4", (480, 640)).max() == 8
    with pytest.raises(InputError, match="'rings' is not a partition"):
        map_of("rings", (48, 64))


def test_heat_maps_share_one_scale() -> None:
    figure = draw_heat([known("a", 10, 90), known("b", 50, 50)], (48, 64))
    first, second = (axes.images[0] for axes in figure.axes[:2])
    assert first.get_clim() == second.get_clim() == (10, 90)
    inner = strips(2, "ring").map((48, 64)) == 0
    np.testing.assert_array_equal(first.get_array(), np.where(inner, 10, 90))


def test_values_of_rings_are_separate_and_inside() -> None:
    region_map = strips(9, "ring").map((480, 640))
    places = staircase(region_map, 60)
    assert [int(region_map[place]) for place in places if place] == list(range(9))
    outer = sorted(place[1] for place in places[1:] if place)
    assert min(np.diff(outer)) >= 55


def test_draws_values_names_and_what_the_intervals_cover(tmp_path: Path) -> None:
    found = texts(draw_heat([known("a", 12.3, 45.6)] * 4, (48, 64)), tmp_path)
    assert {"12.3", "45.6", "mIoU 50.0", "mIoU of the region (%)"} <= set(found)
    profiles = [profile(f"m{n}", [method(n)], FAST, "images") for n in range(3)]
    for number in (2, 3):
        found = texts(draw_profiles(profiles[:number]), tmp_path)
        assert {"95 % intervals over images", "1 seed, 40 images", "region (ring2)"} <= set(found)
        assert f"m1 (mIoU {profiles[1].miou:.1f})" in found


def test_undefined_regions_are_drawn_as_a_dash(tmp_path: Path) -> None:
    heat = draw_heat([known("a", 12.3, float("nan"))], (48, 64))
    assert "-" in texts(heat, tmp_path)
