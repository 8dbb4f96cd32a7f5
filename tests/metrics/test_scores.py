"""Scores by hand, against released metric code and published rows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rgbt.metrics import scores
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from tests.measured import measurement
from tests.models.golden import FOLDER

GOLDEN = FOLDER / "losses.npz"
NAN = np.nan


@pytest.mark.parametrize("absent", ["released", "exclude"])
def test_two_classes_by_hand(absent: Any) -> None:
    counts = scores.tally(np.array([[6, 2], [1, 3]]))
    # Class 0: TP 6, FN 2, FP 1. Class 1: TP 3, FN 1, FP 2.
    assert scores.iou(counts, absent).tolist() == [6 / 9, 3 / 6]
    assert scores.recall(counts, absent).tolist() == [6 / 8, 3 / 4]
    assert scores.precision(counts, absent).tolist() == [6 / 7, 3 / 5]
    assert scores.f1(counts, absent).tolist() == [12 / 15, 6 / 9]
    assert float(scores.miou(counts, absent, None)) == pytest.approx((6 / 9 + 3 / 6) / 2)
    assert float(scores.pixel_accuracy(counts)) == 9 / 12


def test_absent_classes_by_hand() -> None:
    # Class 1 is nowhere; class 2 is predicted but not there; class 3 is there but not predicted.
    counts = scores.tally(np.array([[4, 0, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0], [2, 0, 0, 0]]))
    expected = {
        scores.iou: [4 / 7, NAN, 0, 0],
        scores.recall: [4 / 5, NAN, NAN, 0],
        scores.precision: [4 / 6, NAN, 0, NAN],
        scores.f1: [8 / 11, NAN, 0, 0],
    }
    for score, values in expected.items():
        np.testing.assert_array_equal(score(counts, "exclude"), values)
        np.testing.assert_array_equal(score(counts, "released"), np.nan_to_num(values))
    assert float(scores.miou(counts, "released", None)) == pytest.approx(4 / 7 / 4)
    assert float(scores.miou(counts, "exclude", None)) == pytest.approx(4 / 7 / 3)
    nothing = scores.tally(np.zeros((2, 4, 4), int))
    assert scores.miou(nothing, "released", None).tolist() == [0, 0]
    assert np.isnan(scores.miou(nothing, "exclude", None)).all()
    assert np.isnan(scores.pixel_accuracy(nothing)).all()
    assert np.isnan(scores.variance([NAN, NAN]))


@pytest.mark.skipif(not GOLDEN.exists(), reason="reference material is not beside the checkout")
def test_equal_to_the_released_metric_code() -> None:
    stored = np.load(GOLDEN)
    matrix = stored["confusion.matrix"]
    tallies = scores.tally(matrix)
    score_of = {"precision": scores.precision, "recall": scores.recall, "iou": scores.iou}
    for name, score in score_of.items():
        zero = stored[f"confusion.zero_when_undefined.{name}"]
        np.testing.assert_allclose(score(tallies, "released"), zero, atol=1e-8)
        for release in ("nan_when_undefined_with_f1", "rtfnet"):
            undefined = stored[f"confusion.{release}.{name}"]
            np.testing.assert_allclose(score(tallies, "exclude"), undefined, atol=1e-8)
    # F1 of the Temporal release is undefined wherever precision or recall is 0 or undefined.
    expected = stored["confusion.nan_when_undefined_with_f1.f1"]
    ours, known = scores.f1(tallies, "exclude"), ~np.isnan(expected)
    np.testing.assert_allclose(ours[known], expected[known], atol=1e-8)
    there = (matrix.sum(0) + matrix.sum(1)) > 0
    assert (ours[~known & there] == 0).all()
    assert np.isnan(ours[~there]).all()


@pytest.mark.parametrize(
    ("ious", "printed"),
    [
        # SpatialSeg, Table III, rows baseline, N_y, N_y / 2, N_y / 4; Table V, alpha = 2;
        # Table VI, weight on the centre.
        ((55.28, 62.79, 58.75, 63.36, 63.85), 10.90),
        ((57.88, 61.89, 59.11, 60.40, 61.15), 2.06),
        ((55.87, 62.88, 59.38, 60.94, 63.21), 7.19),
        ((56.55, 62.64, 60.14, 64.48, 64.81), 9.45),
        ((56.53, 63.87, 59.93, 63.72, 65.09), 10.01),
        ((55.92, 63.11, 59.47, 63.80, 63.37), 9.19),
    ],
)
def test_variances_of_the_paper_recompute(ious, printed) -> None:
    # Rounding of the printed IoUs moves the variance by 2 |deviation| 0.005 / R each.
    rounding = 2 * 0.005 * np.abs(np.array(ious) - np.mean(ious)).mean() + 0.005
    assert scores.variance(np.array(ious) / 100) == pytest.approx(printed, abs=rounding)


CLASSES = ("road", "car", "person", "void")
LEFT = [[6, 1, 0, 1], [1, 3, 0, 0], [0, 0, 0, 0], [2, 0, 0, 5]]
"""By label and prediction. Road 6 of 11, car 3 of 5, nobody; void 5 of 8."""

RIGHT = [[4, 0, 0, 0], [0, 0, 0, 2], [0, 0, 2, 0], [0, 0, 2, 1]]
"""Road 4 of 4, car 0 of 2, person 2 of 4; void 1 of 5."""

IN_LEFT = {"released": (6 / 11 + 3 / 5 + 0) / 3, "exclude": (6 / 11 + 3 / 5) / 2}
IN_RIGHT = (1 + 0 + 1 / 2) / 3

# Both: road 10 of 15, car 3 of 7, person 2 of 4; void 6 of 13.
BY_HAND = {
    "mIoU": (10 / 15 + 3 / 7 + 2 / 4) / 3,
    "mAcc": (10 / 12 + 3 / 6 + 2 / 2) / 3,
    "mPrecision": (10 / 13 + 3 / 4 + 2 / 4) / 3,
    "mF1": (20 / 25 + 6 / 10 + 4 / 6) / 3,
    "pixel_accuracy": (10 + 3 + 2 + 6) / 30,
    "region/2": IN_RIGHT,
    "class/void": 6 / 13,
    "class/void/acc": 6 / 10,
    "class/void/region/1": 5 / 8,
    "class/car": 3 / 7,
}


def counts_of(*regions: object) -> Counts:
    return Counts(
        counts=np.array([regions], np.int32),
        names=("0",),
        night=None,
        classes=CLASSES,
        measurement=measurement(partition=f"ring{len(regions)}"),
        unscored=("void",),
    )


@pytest.mark.parametrize("absent", ["released", "exclude"])
def test_means_by_hand(absent: Any) -> None:
    counts = counts_of(LEFT, RIGHT)
    # Two regions: half their difference is the deviation of both.
    spread = (100 * (IN_LEFT[absent] - IN_RIGHT) / 2) ** 2
    summary = scores.summary(counts, absent)
    for metric, fraction in {**BY_HAND, "region/1": IN_LEFT[absent]}.items():
        assert value(metric, counts, absent) == pytest.approx(100 * fraction), metric
        if metric in summary:
            assert summary[metric] == pytest.approx(fraction), metric
    assert value("Var", counts, absent) == summary["Var"] == pytest.approx(spread)
    assert {f"class/{name}" for name in CLASSES} < set(summary)  # all, the unscored one too
    # A region of unscored pixels alone.
    counts = counts_of(LEFT, np.diag([0, 0, 0, 9]), RIGHT)
    ious = [100 * share for share in (IN_LEFT[absent], 0, IN_RIGHT)]
    assert value("region/2", counts, absent) == pytest.approx(
        0 if absent == "released" else NAN, nan_ok=True
    )
    expected = np.var(ious) if absent == "released" else spread
    assert value("Var", counts, absent) == pytest.approx(expected)


def test_means_over_one_labelled_class_are_undefined() -> None:
    """Whatever is predicted; the scores of the class itself, and the released rule, stay."""
    alone = [[6, 2, 0, 1], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 3]]  # road, and void is unscored
    counts = counts_of(alone, RIGHT)
    of_road = counts_of(alone, alone)
    for metric in ("mIoU", "mAcc", "mPrecision", "mF1", "region/1", "Var"):
        assert np.isnan(value(metric, of_road, "exclude")), metric
        assert not np.isnan(value(metric, of_road, "released")), metric
    assert value("class/road", of_road, "exclude") == pytest.approx(100 * 6 / 9)
    assert value("mIoU", of_road, "released") == pytest.approx(100 * (6 / 9 + 0 + 0) / 3)
    # One region is undefined, and left out of the variance.
    assert np.isnan(value("region/1", counts, "exclude"))
    assert value("region/2", counts, "exclude") == pytest.approx(100 * IN_RIGHT)
    assert value("Var", counts, "exclude") == 0
    # A data set whose only scored class is road has a score.
    single = replace(of_road, unscored=("car", "person", "void"))
    assert value("mIoU", single, "exclude") == pytest.approx(100 * 6 / 9)
    end = ": a mean over classes is undefined"
    for found, where in ((of_road, "the test split"), (counts, "region 1")):
        settings = (found.by_region(), CLASSES, found.scored, "test")
        assert scores.absent_notes(*settings, "exclude")[-1] == (
            f"labels of a single class in {where}{end}"
        )
        assert not any(note.endswith(end) for note in scores.absent_notes(*settings, "released"))


def test_extremes_by_hand() -> None:
    """Two classes with 100 pixels each, so many of them right: IoU = right / (200 - right)."""

    def counts(*right: int) -> Counts:
        array = np.array([[[[n, 100 - n], [100 - n, n]]] for n in right])
        names = tuple(f"image{number}" for number in range(len(right)))
        about = {"classes": ("a", "b"), "measurement": measurement(partition="ring1")}
        kept = (np.array(right) >= 0)[:, None, None, None]
        return Counts(counts=array * kept, names=names, night=None, **about)

    found = scores.extremes(counts(50, 80, -1, 20, 100))  # the third one has no label
    assert [*found] == ["best", "median", "worst"]
    assert {word: name for word, (name, _) in found.items()} == {
        "best": "image4",
        "median": "image1",
        "worst": "image3",
    }
    assert [score for _, score in found.values()] == pytest.approx([100, 8000 / 120, 2000 / 180])
    assert scores.extremes(counts(20, 50)).keys() == {"best", "worst"}
    assert scores.extremes(counts(20)).keys() == {"best"}
    assert scores.extremes(counts(-1)) == {}
