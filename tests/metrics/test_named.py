from __future__ import annotations

import numpy as np
import pytest

from rgbt.checks import InputError
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


@pytest.mark.parametrize("metric", ["mIou", "region/0", "region/x", "class/", "class/car/prec", ""])
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
    found = values(asked, many, counts.classes, "released")
    alone = [values(asked, each[0], counts.classes, "released") for each in many]
    assert found.shape == (3, 1)
    np.testing.assert_allclose(found[:, 0], alone)
    np.testing.assert_allclose(found[0], value(metric, counts, "released"))
