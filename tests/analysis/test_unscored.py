"""Classes that are counted but not scored, wherever the analysis takes a mean over classes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from analysis.compare import absent_classes
from analysis.figures import inputs, scores, spatialseg
from analysis.predictions.maps import PixelMaps
from analysis.score import conventions, score_tables
from analysis.score import scores as scores_of
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


def random_counts(seed: int, images: int = 12) -> Counts:
    sizes = np.random.default_rng(0).integers(1, 60, (images, 2, 4))
    right = 0.6 * np.eye(4) + 0.1
    array = np.random.default_rng(seed).multinomial(sizes, right)
    return counts_of(array.tolist())


def test_difference_in_unscored_classes_only_is_none() -> None:
    """What the one method finds void rightly, the other takes for `other`, unscored as well."""
    first = random_counts(1)
    every = {"classes": (*CLASSES, "other"), "unscored": ("void", "other")}
    wide = np.zeros((12, 2, 5, 5), np.int32)
    wide[..., :4, :4] = first.counts
    moved = wide.copy()
    moved[..., 3, 4], moved[..., 3, 3] = wide[..., 3, 3], 0
    a, b = (replace(first, counts=array, **every) for array in (wide, moved))
    metrics = ["mIoU", "Var", "mAcc", "mPrecision", "mF1", "region/1"]
    for difference in compare([a], [b], metrics, FEW).differences:
        assert difference.value == 0, difference.metric
        assert difference.interval is not None
        assert (difference.interval.low, difference.interval.high) == (0, 0)
        assert difference.difference.p == 1
    both = [replace(counts, unscored=()) for counts in (a, b)]
    (scored,) = compare([both[0]], [both[1]], ["mIoU"], FEW).differences
    assert scored.value < -1
    assert scored.difference.p < 0.05


def test_means_over_different_classes_are_refused() -> None:
    counts = random_counts(1)
    other = replace(random_counts(2), unscored=())
    for call in (
        lambda: compare([counts], [other], ["mIoU"], FEW),
        lambda: estimate([counts, other], ["class/car"], FEW),
        lambda: inputs.check_same_images([counts, other]),
    ):
        with pytest.raises(InputError, match="leave out void cannot be compared .* no class"):
            call()


# Tables of predictions.


def test_score_table_by_hand() -> None:
    counts = counts_of()
    frame = scores_of("ours", counts)
    cells = frame.set_index(["subset", "region", "class", "metric", "absent"])["value"]["all"]
    assert cells[0, "", "mIoU", "released"] == pytest.approx(MEAN)
    assert cells[1, "", "mIoU", "released"] == pytest.approx(LEFT_MEAN)
    assert cells[2, "", "mIoU", "released"] == pytest.approx(RIGHT_MEAN)
    acc = 100 * (10 / 12 + 3 / 6 + 2 / 2) / 3
    assert cells[0, "", "mAcc", "released"] == pytest.approx(acc)
    spread = ((LEFT_MEAN - RIGHT_MEAN) / 2) ** 2
    assert cells[0, "", "Var", "released"] == pytest.approx(spread)
    assert cells[1, "", "mIoU", "exclude"] == pytest.approx(1.5 * LEFT_MEAN)
    assert cells[1, "void", "IoU", "exclude"] == pytest.approx(100 * 5 / 8)
    table, *_, parts = score_tables(frame, counts)
    assert [row[0] for row in table.rows][-2:] == ["person", "void (not in means)"]
    assert parts.notes[0].startswith("Without a pixel in some region or part: person.")


def test_an_unscored_class_without_pixels_changes_no_mean() -> None:
    gone = [[[5, 1, 1, 0], [0, 3, 0, 0], [1, 0, 2, 0], [0, 0, 0, 0]]] * 2
    scored, everything = counts_of([gone]), counts_of([gone], unscored=())
    assert conventions(scores_of("ours", scored), scored) == ["released"]
    assert conventions(scores_of("ours", everything), everything) == ["released", "exclude"]
    *_, parts = score_tables(scores_of("ours", scored), scored)
    assert "part: no class. released: it" in parts.notes[0]


# Figures.


def test_figures_over_regions() -> None:
    counts = counts_of()
    expected = pytest.approx([LEFT_MEAN, RIGHT_MEAN])
    shown = scores.region_means({"ours": [counts, counts]}, "released")
    assert (shown["value"].tolist(), shown["mIoU"][0]) == (expected, pytest.approx(MEAN))
    drawn = spatialseg.trend("vertical", np.ones(2), {"ours": counts}, "released")
    drawn = drawn.set_index("kind")["score"]
    assert drawn["IoU"].tolist() == expected
    left, right = (6 / 8 + 3 / 4) / 3, (1 + 0 + 1) / 3
    assert drawn["Acc"].tolist() == pytest.approx([100 * left, 100 * right])
    stats = statistics(np.zeros((1, 6, 8), np.uint8), strips(2, "vertical"), None)
    classes = spatialseg.class_regions(stats, "all", ("ours", counts))
    assert classes["value"][-2:].tolist() == expected


def test_pixel_maps_exclude_the_class() -> None:
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
    assert made.iou()[[0, 5], 0].tolist() == pytest.approx([(1 / 4 + 1 / 2) / 2, 1 / 4])
    whole = spatialseg.iou_heat(made, strips(2, "ring")).image
    assert whole == pytest.approx(100 * (1 / 4 + 1 / 2 + 0) / 3)
    with pytest.raises(ValueError, match="expected some, not all, of"):
        replace(made, unscored=("sky",))


def test_comparison_names_absent_classes() -> None:
    """By the convention of the counts."""
    array = random_counts(1).counts[..., :3, :3].copy()
    array[:, :, 1] = array[..., 1] = 0
    classes = ("road", "car", "person")
    counts = counts_of(array.tolist(), classes=classes, unscored=(), absent="exclude")
    assert absent_classes([counts, counts], None) == (
        "A class without a pixel is left out of means (absent=exclude).",
        "absent from the test split: car (left out of the mean)",
    )
    assert "counted as 0" in absent_classes([counts], "released")[1]
    found = estimate([counts], ["mIoU"], Resampling(resamples=100, blocks="none"))["mIoU"]
    assert found.value == pytest.approx(value("mIoU", counts, "exclude"))
    assert found.value == pytest.approx(3 / 2 * value("mIoU", counts, "released"))
