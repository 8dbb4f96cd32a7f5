"""Classes that are counted but not scored, wherever the analysis takes a mean over classes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analysis.compare import absent_classes, entry
from analysis.figures import classes, consistency, inputs, maps, panels, profiles, trends
from analysis.predictions.maps import PixelMaps, iou_map
from analysis.predictions.table import ScoreKey, score_table
from analysis.predictions.text import convention_line, region_grid, tidy_csv
from analysis.uncertainty import Resampling, compare, estimate
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from tests.analysis import counts as makes
from tests.analysis.figures.drawn import statistics, strips

CLASSES = ("road", "car", "person", "void")
LEFT = [[6, 1, 0, 1], [1, 3, 0, 0], [0, 0, 0, 0], [2, 0, 0, 5]]
"""By label and prediction. Road 6 of 11, car 3 of 5, nobody; void 5 of 8."""

RIGHT = [[4, 0, 0, 0], [0, 0, 0, 2], [0, 0, 2, 0], [0, 0, 2, 1]]
"""Road 4 of 4, car 0 of 2, person 2 of 4; void 1 of 5."""

LEFT_MEAN, RIGHT_MEAN = 100 * (6 / 11 + 3 / 5) / 3, 100 * (1 + 0 + 1 / 2) / 3
# Both: road 10 of 15, car 3 of 7, person 2 of 4; void 6 of 13.
MEAN = 100 * (10 / 15 + 3 / 7 + 2 / 4) / 3
FEW = Resampling(resamples=200, blocks="none")


def counts_of(images: object = (), **changed: Any) -> Counts:
    given = {"classes": CLASSES, "unscored": ("void",), "partition": "vertical2"}
    return makes.counts_of(images or [[LEFT, RIGHT]], **(given | changed))


# Intervals and tests.


def ious(matrix: np.ndarray) -> list[float]:
    """Of the scored classes, one loop at a time; 0 where nothing is to be counted."""
    found = []
    for k in range(3):
        either = sum(matrix[i][j] for i in range(4) for j in range(4) if k in (i, j))
        found.append(100 * matrix[k][k] / either if either else 0.0)
    return found


def random_counts(seed: int, images: int = 12) -> Counts:
    sizes = np.random.default_rng(0).integers(1, 60, (images, 2, 4))
    right = 0.6 * np.eye(4) + 0.1
    array = np.random.default_rng(seed).multinomial(sizes, right)
    return counts_of(array.tolist())


def test_every_resample_excludes_the_class() -> None:
    counts = random_counts(1)
    found = estimate([counts], ["mIoU", "Var"], replace(FEW, seed=3))
    whole = counts.counts.sum((0, 1)).tolist()
    assert found["mIoU"].value == pytest.approx(np.mean(ious(whole)))
    regions = [np.mean(ious(region.tolist())) for region in counts.counts.sum(0)]
    assert found["Var"].value == pytest.approx(np.var(regions))


def test_difference_in_unscored_classes_only_is_none() -> None:
    """What the one method finds void rightly, the other takes for `other`, unscored as well."""
    first = random_counts(1)
    every = {"classes": (*CLASSES, "other"), "unscored": ("void", "other")}
    wide = np.zeros((12, 2, 5, 5), np.int32)
    wide[..., :4, :4] = first.counts
    moved = wide.copy()
    moved[..., 3, 4], moved[..., 3, 3] = wide[..., 3, 3], 0
    a, b = (replace(first, counts=each, **every) for each in (wide, moved))
    metrics = ["mIoU", "Var", "mAcc", "mPrecision", "mF1", "region/1"]
    for difference in compare([a], [b], metrics, FEW).differences:
        assert difference.value == 0, difference.metric
        assert difference.interval is not None
        assert (difference.interval.low, difference.interval.high) == (0, 0)
        assert difference.difference.p == 1
    both = [replace(each, unscored=()) for each in (a, b)]
    (scored,) = compare([both[0]], [both[1]], ["mIoU"], FEW).differences
    assert scored.value < -1
    assert scored.difference.p < 0.05


REFUSED = (
    r"leave out void cannot be compared .* leave out no class. Evaluate both with the same "
    r"dataset\.unscored"
)


def test_means_over_different_classes_are_refused(tmp_path: Path) -> None:
    counts = random_counts(1)
    other = replace(random_counts(2), unscored=())
    for call in (
        lambda: compare([counts], [other], ["mIoU"], FEW),
        lambda: estimate([counts, other], ["class/car"], FEW),
        lambda: inputs.check_same_images({"a": [counts], "b": [other]}),
        lambda: profiles.means_only("a", [counts, other], "released"),
    ):
        with pytest.raises(InputError, match=REFUSED):
            call()
    pairs = [replace(each, partition="aligned1") for each in (pairs_of(), pairs_of())]
    with pytest.raises(InputError, match=REFUSED):
        consistency.class_consistency(
            {"a": [pairs[0]], "b": [replace(pairs[1], unscored=())]}, "released"
        )
    counts.save(tmp_path / "a.npz")
    other.save(tmp_path / "b.npz")
    with pytest.raises(InputError, match=REFUSED):
        entry.run([f"a={tmp_path}/a.npz", f"b={tmp_path}/b.npz", "resamples=100"])


# Tables of predictions.


def test_score_table_by_hand() -> None:
    table = score_table(counts_of(), "ours")
    assert table.scores[ScoreKey()].value == pytest.approx(MEAN)
    assert table.scores[ScoreKey(region=1)].value == pytest.approx(LEFT_MEAN)
    assert table.scores[ScoreKey(region=2)].value == pytest.approx(RIGHT_MEAN)
    acc = 100 * (10 / 12 + 3 / 6 + 2 / 2) / 3
    assert table.scores[ScoreKey(metric="Acc")].value == pytest.approx(acc)
    spread = ((LEFT_MEAN - RIGHT_MEAN) / 2) ** 2
    assert table.scores[ScoreKey(metric="Var")].value == pytest.approx(spread)
    left = ScoreKey(region=1, absent="exclude")
    assert table.scores[left].value == pytest.approx(1.5 * LEFT_MEAN)
    assert table.scores[replace(left, class_name="void")].value == pytest.approx(100 * 5 / 8)
    labels = [row[0] for row in region_grid(table).rows]
    assert labels[-2:] == ["person", "void (not in means)"]
    assert table.absent_classes() == ("person",)
    assert ",void,IoU," in tidy_csv([table])  # data keep their names


def test_an_unscored_class_without_pixels_changes_no_mean() -> None:
    gone = [[[5, 1, 1, 0], [0, 3, 0, 0], [1, 0, 2, 0], [0, 0, 0, 0]]] * 2
    table = score_table(counts_of([gone]), "ours")
    assert table.conventions() == ("released",)
    assert table.absent_classes() == ()
    assert "every class of the means has pixels in every region" in convention_line(table)
    everything = score_table(counts_of([gone], unscored=()), "ours")
    assert everything.conventions() == ("released", "exclude")
    assert everything.absent_classes() == ("void",)


# Figures.


def pairs_of() -> Counts:
    pairs = np.zeros((5, 4, 4), int)
    pairs[0, 0, :2] = 3, 1  # road: TC 3 of 4, CA 3 of 4
    pairs[1, 1, 1] = 1  # car: TC 1 of 2
    pairs[3, 3, 3] = 8  # void
    return counts_of([pairs.tolist()], partition="aligned1")


def test_figures_over_regions() -> None:
    counts = counts_of()
    expected = pytest.approx([LEFT_MEAN, RIGHT_MEAN])
    shown = profiles.means_only("ours", [counts, counts], "released")
    assert (shown.means, shown.miou) == (expected, pytest.approx(MEAN))
    drawn = trends.trend("vertical", np.ones(2), {"ours": counts}, "released")
    assert drawn.ious["ours"] == expected
    left, right = (6 / 8 + 3 / 4) / 3, (1 + 0 + 1) / 3
    assert drawn.accuracies["ours"] == pytest.approx([100 * left, 100 * right])
    labels = np.zeros((1, 6, 8), np.uint8)
    stats = statistics(labels, strips(2, "vertical"), None)
    assert classes.class_regions(stats, "all", ("ours", counts)).miou == expected
    # One image alone: over the classes that occur in it.
    assert panels.image_mious(counts) == {"00000D": pytest.approx(MEAN)}
    empty = counts_of([[LEFT, np.zeros((4, 4), int).tolist()]])
    assert panels.image_mious(empty) == {"00000D": pytest.approx(1.5 * LEFT_MEAN)}


def test_pixel_maps_exclude_the_class(tmp_path: Path) -> None:
    intersection, union = np.zeros((2, 4, 6, 8), np.int32)
    union[0], intersection[0] = 4, 1
    union[1, :3], intersection[1, :3] = 2, 1  # the upper half
    union[3], intersection[3] = 9, 9
    about: Any = {"images": 9, "palette": ((0, 0, 0),) * 4, "dataset": "f", "split": "test"}
    made = PixelMaps(
        intersection=intersection,
        union=union,
        classes=CLASSES,
        name="m",
        unscored=("void",),
        **about,
    )
    assert iou_map(made)[[0, 5], 0].tolist() == pytest.approx([(1 / 4 + 1 / 2) / 2, 1 / 4])
    assert maps.iou_heat(made, strips(2, "ring")).whole == pytest.approx((1 / 4 + 1 / 2 + 0) / 3)
    made.save(tmp_path / "maps.npz")
    assert PixelMaps.load(tmp_path / "maps.npz").unscored == ("void",)
    with pytest.raises(ValueError, match="some, but not all, of the classes"):
        replace(made, unscored=("sky",))


def test_comparison_names_absent_classes() -> None:
    """By the convention of the counts."""
    array = random_counts(1).counts[..., :2, :2].copy()
    array[:, :, 1] = array[..., 1] = 0
    counts = counts_of(array.tolist(), classes=("road", "car"), unscored=(), absent="exclude")
    assert absent_classes([counts, counts], None) == (
        "absent from the test split: car (left out of the mean)",
    )
    assert "counted as 0" in absent_classes([counts], "released")[0]
    found = estimate([counts], ["mIoU"], Resampling(resamples=100, blocks="none"))["mIoU"]
    assert found.value == pytest.approx(value("mIoU", counts, "exclude"))
    assert found.value == pytest.approx(2 * value("mIoU", counts, "released"))
