from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis import commands
from analysis.statistics.collect import SpatialStatistics, collect
from analysis.statistics.measure import ImageMeter
from analysis.statistics.resampled import ResampledSplit, occupancy_map
from rgbt.checks import InputError
from rgbt.metrics.metric import Regions
from rgbt.types import Sample
from tests.analysis.statistics.scenes import InMemory, random_sample

RINGS = Regions(partition="ring", regions=3, aspect="image", absent="released")


def memory(names: list[str], hw: tuple[int, int] = (24, 32)) -> InMemory:
    rng = np.random.default_rng(5)
    return InMemory([random_sample(name, hw, rng) for name in names])


def assert_same(one: SpatialStatistics, other: SpatialStatistics) -> None:
    for name in one.__dataclass_fields__:
        a, b = getattr(one, name), getattr(other, name)
        if isinstance(a, np.ndarray):
            np.testing.assert_array_equal(a, b)
            assert a.dtype == b.dtype, name
        else:
            assert a == b, name


def test_every_image_in_order_and_maps_by_part() -> None:
    dataset = memory([f"{n:05d}{'DNN'[n % 3]}" for n in range(7)])
    stats = collect(dataset, "train", RINGS)
    assert stats.names == tuple(dataset.samples)
    assert stats.night.tolist() == [name.endswith("N") for name in stats.names]
    meter = ImageMeter(stats.region_map, 9)
    for n, sample in enumerate(dataset.samples.values()):
        measured = meter(sample)
        assert set(measured) == {"labels", "ignored", "laplacian", "mean", "noise"}
        for key, array in measured.items():
            np.testing.assert_array_equal(getattr(stats, key)[n], array)
    labels = np.stack([sample.label for sample in dataset.samples.values()])
    for part, wanted in enumerate((~stats.night, stats.night)):
        for k in range(9):
            np.testing.assert_array_equal(stats.occupied[part, k], (labels[wanted] == k).sum(0))


def test_does_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    dataset, found = memory([f"{n:05d}{'DN'[n % 2]}" for n in range(69)], hw=(12, 16)), []
    for threads in (1, 2, 5):
        monkeypatch.setattr(commands, "usable_cores", lambda number=threads: number)
        found.append(collect(dataset, "train", RINGS))
    assert_same(found[0], found[1])
    assert_same(found[0], found[2])


def test_day_and_night_are_the_images_of_each() -> None:
    names = [f"{n:05d}{'DNN'[n % 3]}" for n in range(9)]
    dataset = memory(names)
    stats = collect(dataset, "train", RINGS)
    for letter, part in (("D", "day"), ("N", "night")):
        alone = InMemory([s for s in dataset.samples.values() if s.name.endswith(letter)])
        expected = collect(alone, "train", RINGS)
        np.testing.assert_array_equal(occupancy_map(stats, part), occupancy_map(expected))
        ours, theirs = ResampledSplit(stats), ResampledSplit(expected)
        for name in ("occupancy", "classes", "entropy", "laplacian", "noise", "snr"):
            np.testing.assert_allclose(getattr(ours, name)(part), getattr(theirs, name)())


def test_image_of_other_size_or_without_label_is_refused() -> None:
    rng = np.random.default_rng(0)
    first, other = random_sample("1D", (24, 32), rng), random_sample("2N", (24, 30), rng)
    with pytest.raises(InputError, match="'2N' is 24x30 pixels but '1D' is 24x32"):
        collect(InMemory([first, other]), "train", RINGS)
    with pytest.raises(InputError, match="'2N' has no label"):
        collect(InMemory([first, replace(other, label=None)]), "train", RINGS)


@pytest.mark.parametrize("night", [True, False])
def test_file_round_trip(tmp_path: Path, night: bool) -> None:
    dataset = memory(["1D", "2N", "3D"] if night else ["a", "b"])
    stats = collect(dataset, "train", RINGS)
    stats.save(tmp_path / "statistics.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["statistics.npz"]
    assert_same(SpatialStatistics.load(tmp_path / "statistics.npz"), stats)


def test_images_are_measured_in_the_chosen_size() -> None:
    label = np.zeros((48, 64), np.uint8)
    label[24:, :] = 1
    rgb = np.repeat(np.arange(64, dtype=np.uint8)[None, :, None], 48, 0).repeat(3, 2)
    sample = Sample(rgb, rgb[..., 0], label, "00000D")
    strips = Regions(partition="horizontal", regions=2, aspect=None, absent="released")
    stats = collect(InMemory([sample]), "train", strips, short_edge=12)
    assert stats.region_map.shape == (12, 16)
    assert stats.labels[0, :, :2].tolist() == [[96, 0], [0, 96]]
    # The area mean of columns 0..3 is 1.5, and so on: mean of all columns is 31.5, rounded to even.
    assert stats.mean[0, 1] == pytest.approx([31.5, 31.5], abs=0.5)
