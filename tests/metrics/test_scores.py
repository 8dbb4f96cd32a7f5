"""Scores by hand, against scikit-learn, against released metric code and published rows."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from sklearn.metrics import f1_score, jaccard_score, precision_score, recall_score

from rgbt.metrics import names, scores
from rgbt.metrics.counts import Counts

SHARED = Path(os.environ.get("RGBT_SHARED", Path(__file__).resolve().parents[2].parent / "shared"))
GOLDEN = SHARED / "golden" / "losses.npz"
BOTH = ["released", "exclude"]


@pytest.mark.parametrize("absent", BOTH)
def test_two_classes_by_hand(absent) -> None:
    counts = np.array([[6, 2], [1, 3]])
    # Class 0: TP 6, FN 2, FP 1. Class 1: TP 3, FN 1, FP 2.
    assert scores.iou(counts, absent).tolist() == [6 / 9, 3 / 6]
    assert scores.recall(counts, absent).tolist() == [6 / 8, 3 / 4]
    assert scores.precision(counts, absent).tolist() == [6 / 7, 3 / 5]
    assert scores.f1(counts, absent).tolist() == [12 / 15, 6 / 9]
    assert float(scores.miou(counts, absent, None)) == pytest.approx((6 / 9 + 3 / 6) / 2)
    assert float(scores.pixel_accuracy(counts)) == 9 / 12


def test_absent_classes_by_hand() -> None:
    # Class 1 is nowhere; class 2 is predicted but not there; class 3 is there but not predicted.
    counts = np.array([[4, 0, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0], [2, 0, 0, 0]])
    assert scores.iou(counts, "released").tolist() == [4 / 7, 0, 0, 0]
    np.testing.assert_array_equal(scores.iou(counts, "exclude"), [4 / 7, np.nan, 0, 0])
    np.testing.assert_array_equal(scores.recall(counts, "exclude"), [4 / 5, np.nan, np.nan, 0])
    np.testing.assert_array_equal(scores.precision(counts, "exclude"), [4 / 6, np.nan, 0, np.nan])
    np.testing.assert_array_equal(scores.f1(counts, "exclude"), [8 / 11, np.nan, 0, 0])
    assert float(scores.miou(counts, "released", None)) == pytest.approx(4 / 7 / 4)
    assert float(scores.miou(counts, "exclude", None)) == pytest.approx(4 / 7 / 3)


def test_nothing_counted() -> None:
    counts = np.zeros((2, 3, 3), int)
    assert scores.miou(counts, "released", None).tolist() == [0, 0]
    assert np.isnan(scores.miou(counts, "exclude", None)).all()
    assert np.isnan(scores.pixel_accuracy(counts)).all()
    assert np.isnan(scores.variance([np.nan, np.nan]))


@pytest.mark.parametrize("seed", range(5))
def test_equal_to_scikit_learn(seed) -> None:
    rng = np.random.default_rng(seed)
    label, prediction = rng.integers(0, 5, 400), rng.integers(0, 4, 400)
    counts = np.zeros((5, 5), int)
    np.add.at(counts, (label, prediction), 1)
    given = {"labels": range(5), "average": None, "zero_division": 0}
    for ours, theirs in (
        (scores.iou, jaccard_score),
        (scores.recall, recall_score),
        (scores.precision, precision_score),
        (scores.f1, f1_score),
    ):
        np.testing.assert_allclose(ours(counts, "released"), theirs(label, prediction, **given))


@pytest.mark.skipif(not GOLDEN.exists(), reason="reference material is not beside the checkout")
def test_equal_to_the_released_metric_code() -> None:
    stored = np.load(GOLDEN)
    matrix = stored["confusion.matrix"]
    score_of = {"precision": scores.precision, "recall": scores.recall, "iou": scores.iou}
    for name, score in score_of.items():
        zero = stored[f"confusion.zero_when_undefined.{name}"]
        np.testing.assert_allclose(score(matrix, "released"), zero, atol=1e-8)
        for release in ("nan_when_undefined_with_f1", "rtfnet"):
            undefined = stored[f"confusion.{release}.{name}"]
            np.testing.assert_allclose(score(matrix, "exclude"), undefined, atol=1e-8)
    # F1 of the Temporal release is undefined wherever precision or recall is 0 or undefined.
    expected = stored["confusion.nan_when_undefined_with_f1.f1"]
    ours = scores.f1(matrix, "exclude")
    known = ~np.isnan(expected)
    np.testing.assert_allclose(ours[known], expected[known], atol=1e-8)
    there = (matrix.sum(0) + matrix.sum(1)) > 0
    assert (ours[~known & there] == 0).all()
    assert np.isnan(ours[~there]).all()


def test_leading_dimensions_are_kept() -> None:
    counts = np.random.default_rng(0).integers(0, 50, (3, 5, 4, 4))
    every = scores.iou(counts, "released")
    assert every.shape == (3, 5, 4)
    np.testing.assert_array_equal(every[1, 2], scores.iou(counts[1, 2], "released"))


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


def test_variance_leaves_out_regions_without_a_score() -> None:
    # 40 and 60 percent: mean 50, variance 100.
    assert scores.variance([0.4, np.nan, 0.6]) == pytest.approx(100)


def example(night: tuple[bool, ...] | None) -> Counts:
    rng = np.random.default_rng(0)
    return Counts(
        counts=rng.integers(0, 100, (2, 3, 2, 2)),
        names=("00001D", "00002N"),
        night=night,
        classes=("unlabeled", "car"),
        partition="ring3",
        dataset="abc",
        split="test",
    )


@pytest.mark.parametrize("absent", BOTH)
def test_summary_is_derived_from_the_counts(absent) -> None:
    counts = example((False, True))
    result = scores.summary(counts, absent)
    pooled = counts.counts.sum((0, 1))
    assert result[names.MIOU] == pytest.approx(float(scores.miou(pooled, absent, None)))
    regions = [
        float(scores.miou(counts.counts[:, region].sum(0), absent, None)) for region in range(3)
    ]
    assert [result[names.region(number)] for number in (1, 2, 3)] == pytest.approx(regions)
    assert result[names.VAR] == pytest.approx(np.var(np.array(regions) * 100))
    assert result[names.class_iou("car")] == pytest.approx(scores.iou(pooled, absent)[1])
    night = scores.summary(counts.select(["00002N"]), absent)
    assert result[names.subset(names.NIGHT, names.MIOU)] == night[names.MIOU]
    assert result["night/Var"] == night[names.VAR]
    assert all(isinstance(value, float) for value in result.values())


def test_summary_without_day_and_night_has_no_parts() -> None:
    result = scores.summary(example(None), "released")
    assert set(result) == {
        *("mIoU", "Var", "mAcc", "mPrecision", "mF1", "pixel_accuracy"),
        *("region/1", "region/2", "region/3", "class/unlabeled", "class/car"),
    }


def test_the_pooled_mean_is_not_the_mean_of_the_regions() -> None:
    # Region 1: 90 of 100 pixels right; region 2: 1 of 4.
    counts = np.array([[[90, 10], [0, 0]], [[0, 0], [3, 1]]])
    pooled = float(scores.miou(counts.sum(0), "released", None))
    assert pooled == pytest.approx((90 / 103 + 1 / 14) / 2)
    assert pooled != pytest.approx(scores.miou(counts, "released", None).mean())
