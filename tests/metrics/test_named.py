from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import images_of, parse, value, values
from tests.sweeps.tabled import DAY, counts_of


@pytest.mark.parametrize(
    ("metric", "expected"),
    [
        # whole image [[7, 1], [2, 6]]: IoU 7/10 and 6/9
        ("mIoU", 100 * (7 / 10 + 6 / 9) / 2),
        ("mAcc", 100 * (7 / 8 + 6 / 8) / 2),
        ("mPrecision", 100 * (7 / 9 + 6 / 7) / 2),
        ("mF1", 100 * (14 / 17 + 12 / 15) / 2),
        ("pixel_accuracy", 100 * 13 / 16),
        ("class/car", 100 * 6 / 9),
        ("class/car/acc", 75.0),
        # rings [[4, 0], [2, 2]]: 4/6 and 2/4; [[3, 1], [0, 4]]: 3/4 and 4/5
        ("region/1", 100 * (4 / 6 + 2 / 4) / 2),
        ("region/2", 77.5),
        ("class/road/region/1", 100 * 4 / 6),
        ("Var", ((77.5 - 175 / 3) / 2) ** 2),
        ("day/mIoU", 77.5),  # [[3, 1], [0, 4]]
        ("night/class/car/acc", 50.0),  # [[4, 0], [2, 2]]
    ],
)
def test_values_by_hand(metric: str, expected: float) -> None:
    assert value(metric, counts_of(), "released") == pytest.approx(expected)


def test_absent_class_counts_as_asked() -> None:
    counts = counts_of([[[4, 0], [0, 0]]], night=None)
    assert value("mIoU", counts, "released") == 50.0
    assert value("mIoU", counts, "exclude") == 100.0


@pytest.mark.parametrize(
    "metric",
    ["mIou", "region/0", "region/x", "class/", "class/car/prec", "region/1/TC", "class//CA", ""],
)
def test_unknown_metric(metric: str) -> None:
    with pytest.raises(InputError, match=f"'{metric}' is not a metric"):
        parse(metric)


def test_nearest_metric_is_named() -> None:
    with pytest.raises(InputError, match="did you mean 'mIoU'"):
        parse("day/mIou")


def test_unknown_class_and_region() -> None:
    with pytest.raises(InputError, match="no class 'carr'; did you mean 'car'"):
        value("class/carr", counts_of(), "released")
    with pytest.raises(InputError, match="the counts have the regions 1 to 2"):
        value("region/3", counts_of(), "released")


def test_images_that_are_not_told_apart() -> None:
    with pytest.raises(InputError, match="told apart"):
        value("night/mIoU", counts_of(DAY, night=None), "released")


@pytest.mark.parametrize(
    "metric",
    ["mIoU", "Var", "mAcc", "pixel_accuracy", "region/2", "class/car", "day/class/car/acc"],
)
def test_many_sums_at_once_are_each_alone(metric: str) -> None:
    asked, counts = parse(metric), counts_of()
    by_region = images_of(asked, counts).by_region()
    many = np.stack([by_region, 3 * by_region, by_region[::-1]])[:, None]
    given = (counts, "released")
    found = values(asked, many, *given)
    alone = [values(asked, each[0], *given) for each in many]
    assert found.shape == (3, 1)
    np.testing.assert_allclose(found[:, 0], alone)
    np.testing.assert_allclose(found[0], value(metric, counts, "released"))


# Pairs of frames.

ONE = [[[3, 1], [0, 0]], [[1, 0], [1, 2]], [[0, 0], [0, 0]]]
"""By label, first, second. Road: alike in 4 of 6, all three in 3 of 6 (coded: 8). Car: in 2 of 4,
all three in 2 of 5 (coded: 6)."""

OTHER = [[[0, 0], [0, 4]], [[0, 0], [0, 4]], [[0, 0], [0, 0]]]
"""Road: in no frame, all three in 0 of 4; car: alike in 8 of 8, all three in 4 of 8 (coded: 12)."""


def pairs_of(night: tuple[bool, ...] | None = (False, True)) -> Counts:
    """Two sets: by day each once, by night the first one twice."""
    return replace(
        counts_of([*ONE, *OTHER], [*ONE, *ONE], night=night), partition="aligned2", names=("a", "b")
    )


@pytest.mark.parametrize(
    ("metric", "absent", "expected"),
    [
        ("night/TC", "released", (4 / 6 + 2 / 4) / 2),
        ("night/CA", "released", (3 / 6 + 2 / 5) / 2),
        ("night/CA_released", "released", (3 / 8 + 2 / 6) / 2),
        # By day the sets differ; their shares are averaged.
        ("day/class/car/TC", "released", (2 / 4 + 8 / 8) / 2),
        ("day/class/car/CA", "exclude", (2 / 5 + 4 / 8) / 2),
        ("day/class/car/CA_released", "exclude", (2 / 6 + 4 / 12) / 2),
        ("day/class/road/TC", "released", (4 / 6 + 0) / 2),
        ("day/class/road/TC", "exclude", 4 / 6),
        ("day/TC", "exclude", (4 / 6 + 3 / 4) / 2),
        # Day and night: images are pooled inside a set.
        ("class/car/TC", "released", (2 / 4 + 10 / 12) / 2),
        ("class/car/CA", "released", (2 / 5 + 6 / 13) / 2),
        ("class/road/CA", "released", (3 / 6 + 3 / 10) / 2),
        ("TC", "released", (4 / 6 + (2 / 4 + 10 / 12) / 2) / 2),
    ],
)
def test_values_of_pairs_by_hand(metric: str, absent, expected: float) -> None:
    assert value(metric, pairs_of(), absent) == pytest.approx(100 * expected)


@pytest.mark.parametrize("metric", ["TC", "CA", "CA_released", "class/car/CA", "night/TC"])
def test_many_sums_of_pairs_at_once_are_each_alone(metric: str) -> None:
    asked, counts = parse(metric), pairs_of()
    by_region = images_of(asked, counts).by_region()
    many = np.stack([by_region, 3 * by_region, by_region[..., ::-1]])[:, None]
    given = (counts, "released")
    found = values(asked, many, *given)
    assert found.shape == (3, 1)
    np.testing.assert_allclose(found[:, 0], [values(asked, each[0], *given) for each in many])
    np.testing.assert_allclose(found[0], value(metric, counts, "released"))


OF_SINGLE = ["mIoU", "Var", "mAcc", "pixel_accuracy", "region/1", "class/car", "class/car/acc"]


@pytest.mark.parametrize("metric", [*OF_SINGLE, "class/car/region/2", "night/mIoU"])
def test_pairs_have_no_scores_of_single_frames(metric: str) -> None:
    asked, counts = parse(metric), pairs_of()
    sentence = f"'{metric}' is a score of single frames.*aligned2, of rgbt consistency"
    with pytest.raises(InputError, match=sentence):
        value(metric, counts, "released")
    with pytest.raises(InputError, match=sentence):
        images_of(asked, counts)
    with pytest.raises(InputError, match=sentence):
        values(asked, counts.by_region(), counts, "released")


@pytest.mark.parametrize("metric", ["TC", "CA", "night/CA_released", "class/car/TC"])
def test_single_frames_have_no_scores_of_pairs(metric: str) -> None:
    asked, counts = parse(metric), counts_of()
    sentence = f"'{metric}' is a score of pairs.*ring2.*rgbt consistency run="
    with pytest.raises(InputError, match=sentence):
        value(metric, counts, "released")
    with pytest.raises(InputError, match=sentence):
        images_of(asked, counts)
    with pytest.raises(InputError, match=sentence):
        values(asked, counts.by_region(), counts, "released")


def test_classes_and_parts_of_pairs_are_checked_too() -> None:
    with pytest.raises(InputError, match="no class 'carr'; did you mean 'car'"):
        value("class/carr/TC", pairs_of(), "released")
    with pytest.raises(InputError, match="told apart"):
        value("night/TC", pairs_of(night=None), "released")
    with pytest.raises(InputError, match="did you mean 'CA_released'"):
        parse("day/CA_release")
