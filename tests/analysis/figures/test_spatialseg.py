"""SpatialSeg, Figs. 1 to 6: the numbers that are drawn, by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from analysis.figures.spatialseg import (
    by_region,
    class_regions,
    draw_by_region,
    draw_classes,
    iou_heat,
    occupancy_heat,
    occupancy_over,
    trend,
)
from analysis.predictions.maps import PixelMaps
from analysis.predictions.scoring import score_folder
from analysis.statistics.resampled import ResampledSplit
from analysis.uncertainty import Resampling
from rgbt.checks import InputError
from rgbt.data.mfnet import MFNet
from rgbt.metrics.metric import Absent, Regions
from rgbt.metrics.named import value
from tests.analysis.counts import counts_of
from tests.analysis.figures.drawn import CLASSES, PALETTE, statistics, strips, texts

RINGS, HALVES = strips(2, "ring"), strips(2)
TWO = np.array([[[6, 2], [0, 2]], [[8, 0], [0, 2]]])
"""Region 1: IoU 6/8 and 2/4, Acc 6/8 and 1. Region 2: all right."""

SIX = statistics(np.zeros((40, 4, 6), np.uint8), strips(3), np.arange(40) >= 20)
"""See `drawn.statistics` for its values."""


def maps(intersection: np.ndarray, union: np.ndarray) -> PixelMaps:
    return PixelMaps(
        intersection=intersection.astype(np.int32),
        union=union.astype(np.int32),
        images=4,
        classes=CLASSES[:2],
        palette=tuple(map(tuple, PALETTE[:2].tolist())),
        dataset="fingerprint",
        split="test",
        name="RTFNet",
    )


def test_three_numbers_pool_pixels_before_dividing() -> None:
    """6 x 8 pixels: ring 1 is the 5 x 5 around the middle, ring 2 the 23 around it."""
    inner = RINGS.map((6, 8)) == 0
    intersection, union = np.zeros((2, 6, 8)), np.zeros((2, 6, 8))
    union[0], intersection[0] = 4, np.where(inner, 1, 3)
    union[1], intersection[1] = np.where(inner, 2, 0), np.where(inner, 1, 0)
    heat = iou_heat(maps(intersection, union), RINGS)
    assert heat.centre == pytest.approx(100 * (1 / 4 + 1 / 2) / 2)
    assert heat.edge == pytest.approx(100 * (3 / 4 + 0) / 2)  # released: an absent class scores 0
    assert heat.image == pytest.approx(100 * ((25 * 1 + 23 * 3) / (48 * 4) + 1 / 2) / 2)
    # The map leaves classes out that never occur at a pixel.
    np.testing.assert_allclose(heat.values, np.where(inner, 3 / 8, 3 / 4))


@pytest.mark.parametrize("absent", ["released", "exclude"])
def test_the_three_numbers_are_those_of_the_tables(tmp_path: Path, absent: Absent) -> None:
    """One folder of predictions: Fig. 1 and the table of regions say the same."""
    names, rng = ("00001D", "00002N"), np.random.default_rng(0)
    for folder in ("images", "labels", "ours"):
        (tmp_path / folder).mkdir()
    (tmp_path / "test.txt").write_text("\n".join(names))
    for name in names:
        label = rng.integers(0, 3, (24, 32), np.uint8)
        label[8:16, 10:22] = 0  # the centre lacks classes 1 and 2
        predicted = np.where(rng.random(label.shape) < 0.7, label, 0)
        label[rng.random(label.shape) < 0.1] = 255
        cv2.imwrite(str(tmp_path / "labels" / f"{name}.png"), label)
        cv2.imwrite(str(tmp_path / "ours" / f"{name}.png"), predicted)
    dataset = MFNet(str(tmp_path))
    scored = score_folder(tmp_path / "ours", dataset, "test", regions=5)
    assert scored.maps is not None
    rings = Regions(partition="ring", regions=5, aspect="image", absent=absent)
    heat = iou_heat(scored.maps, rings)
    wanted = [value(m, scored.counts[0], absent) for m in ("region/1", "region/5", "mIoU")]
    np.testing.assert_allclose([heat.centre, heat.edge, heat.image], wanted)


def test_occupancy_is_the_share_of_labels_beside_background() -> None:
    labels = np.zeros((4, 6, 8), np.uint8)
    inner = RINGS.map((6, 8)) == 0
    labels[0][inner] = 1
    labels[1][inner] = 2
    labels[2][~inner] = 1
    stats = statistics(labels, strips(3), None)
    heat = occupancy_heat(stats, RINGS)
    assert (heat.centre, heat.edge, heat.source) == (50, 25, "toy, train")
    assert heat.image == pytest.approx(100 * (25 * 0.5 + 23 * 0.25) / 48)
    road = replace(stats, background=())
    with pytest.raises(InputError, match="no class of toy is stated as background"):
        occupancy_heat(road, RINGS)
    with pytest.raises(InputError, match="metric: vertical2 has no centre"):
        occupancy_heat(stats, HALVES)
    # Class 0 is then drawn as every other class.
    assert [*class_regions(road)["series"].unique()] == [*CLASSES]


def test_occupancy_over_measured_regions_equals_statistics() -> None:
    labels = np.random.default_rng(0).integers(0, 3, (5, 12, 16), dtype=np.uint8)
    stats = statistics(labels, RINGS, np.array([True, False, True, False, False]))
    for part in ("all", "day", "night"):
        found = occupancy_over(stats, stats.region_map, part)
        np.testing.assert_allclose(found, ResampledSplit(stats).occupancy(part)[0])


def test_changes_from_the_first_region_by_hand() -> None:
    frame = trend("ring", np.array([0.4, 0.1]), {"CRM": counts_of(TWO)}, "released")
    assert [*frame["series"].unique()] == ["IoU (CRM)", "Acc (CRM)", "SOR"]
    np.testing.assert_allclose(frame["score"], [62.5, 100, 87.5, 100, 40, 10])
    np.testing.assert_allclose(frame["value"], [0, 37.5, 0, 12.5, 0, -30])


@pytest.mark.parametrize("partition", ["vertical2", "ring3", "ring21"])
def test_counts_of_another_partition_are_refused(partition: str) -> None:
    other = counts_of(TWO, partition=partition)
    with pytest.raises(InputError, match=f"'CRM' was counted over {partition}, expected ring2"):
        trend("ring", np.ones(2), {"CRM": other}, "released")
    with pytest.raises(InputError, match="expected ring2"):
        class_regions(statistics(two_images(), RINGS, None), "all", ("CRM", other))


def two_images() -> np.ndarray:
    """Car: 6 pixels on the left, 3 on the right; color_cone: none, 2 on the right."""
    labels = np.zeros((2, 3, 4), np.uint8)
    labels[0, :, :2] = 1
    labels[1, :, 3] = 1
    labels[0, :2, 2] = 2
    return labels


def test_shares_of_the_largest_region_and_miou_by_hand(tmp_path: Path) -> None:
    stats = statistics(two_images(), HALVES, None)
    method = "CRM-B", counts_of(TWO, partition="vertical2")
    frame = class_regions(stats, "all", method)
    assert [*frame["series"].unique()] == ["car", "color_cone", "mIoU (CRM-B)"]
    np.testing.assert_allclose(frame["value"], [100, 50, 0, 100, 62.5, 100])
    found = texts(draw_classes(frame, "region"), tmp_path)
    assert {"car", "color cone", "mIoU (CRM-B)"} <= set(found)


def test_miou_covers_the_same_part_as_the_shares() -> None:
    matrices = np.array([[TWO[0]] * 2, [TWO[1]] * 2])
    counts = counts_of(matrices, partition="vertical2")
    stats = statistics(two_images(), HALVES, np.array([False, True]))
    known = replace(counts, night=(False, True))
    for part, expected in (("night", 100), ("day", 62.5)):
        frame = class_regions(stats, part, ("CRM-B", known))
        np.testing.assert_allclose(frame["value"][-2:], expected)
    for night in (None, (False, False)):
        with pytest.raises(InputError, match="counts of 'CRM-B' contain no such image"):
            class_regions(stats, "night", ("CRM-B", replace(counts, night=night)))


DRAWS = Resampling(resamples=400, blocks=2)


def test_quality_by_region_by_hand() -> None:
    """Laplacian: mean over images n of 10 (m + 1) (n + 1) + r; SNR: 100 + n over noise."""
    frame = by_region(ResampledSplit(SIX, DRAWS), "laplacian").set_index(["modality", "part"])[
        "value"
    ]
    for part, mean in (("all", 205), ("day", 105), ("night", 305)):
        np.testing.assert_allclose(frame["rgb", part], mean + np.arange(3))
        np.testing.assert_allclose(frame["thermal", part], 2 * mean + np.arange(3))
    snr = by_region(ResampledSplit(SIX, DRAWS), "snr").set_index(["modality", "part"])["value"]
    np.testing.assert_allclose(snr["rgb", "all"], 119.5 / np.array([1, 2, 3]), rtol=1e-5)
    np.testing.assert_allclose(snr["thermal", "night"], 129.5 / np.array([2, 4, 6]), rtol=1e-5)
    other = by_region(ResampledSplit(SIX, DRAWS, ("std", "images")), "snr")
    np.testing.assert_allclose(other["value"][3:6], 109.5 / 20, rtol=1e-5)  # rgb by day


@pytest.mark.parametrize("part", ["all", "day", "night"])
def test_intervals_are_of_the_blocks_of_their_part(part: str) -> None:
    """All: 20 blocks in two strata; day and night: 10 blocks each."""
    sample = ResampledSplit(SIX, DRAWS)
    quantile = 2.10092204024096 if part == "all" else 2.26215716279821  # t of 18 and of 9 degrees
    for quantity in ("laplacian", "snr"):
        frame = by_region(sample, quantity)
        rows = frame[(frame["part"] == part) & (frame["modality"] == "rgb")]
        logs = np.log(getattr(sample, quantity)(part)[:, 0])
        reach = quantile * logs[1:].std(0) * np.sqrt(10 / 9)
        np.testing.assert_allclose(rows["low"], np.exp(logs[0] - reach), rtol=1e-5)
        np.testing.assert_allclose(rows["high"], np.exp(logs[0] + reach), rtol=1e-5)


def test_far_modalities_get_a_logarithmic_axis(tmp_path: Path) -> None:
    near = ResampledSplit(SIX, DRAWS)
    assert draw_by_region(by_region(near, "snr"), near, "SNR").axes[0].get_yscale() == "linear"
    factor = np.array([20, 1]).reshape(1, 1, 2, 1)
    far = ResampledSplit(replace(SIX, noise=SIX.noise * factor), DRAWS)
    figure = draw_by_region(by_region(far, "snr"), far, "SNR")
    assert figure.axes[0].get_yscale() == "log"
    found = texts(figure, tmp_path)
    assert {"RGB, all", "thermal, night", "SNR", "(all 40, day 20, night 20 images)"} <= set(found)
