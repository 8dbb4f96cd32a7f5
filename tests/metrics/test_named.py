"""Scores by their names: values by hand, what counts do not have, and many sums at once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import DEFAULTS, Details, details_of, regions_of, requested
from rgbt.metrics.named import (
    CHANGES,
    PAIR_SCORES,
    details_of_metric,
    images_of,
    parse,
    sums_of,
    value,
    values,
)
from rgbt.metrics.names import in_percent, shown
from rgbt.metrics.score_grid import headlines, score_grid
from tests.measured import measurement, remeasured
from tests.sweeps.tabled import DAY, counts_of

# Pairs of frames, by label, first, second.

ONE = [[[3, 1], [0, 0]], [[1, 0], [1, 2]], [[0, 0], [0, 0]]]
"""Road: alike in 4 of 6, all three in 3 of 6 (coded: 8). Car: in 2 of 4, all three in 2 of 5
(coded: 6)."""

OTHER = [[[0, 0], [0, 4]], [[0, 0], [0, 4]], [[0, 0], [0, 0]]]
"""Road: in no frame, all three in 0 of 4; car: alike in 8 of 8, all three in 4 of 8 (coded: 12)."""


def pairs_of(night: tuple[bool, ...] | None = (False, True), partition: str = "aligned2") -> Counts:
    """Two sets: by day each once, by night the first one twice."""
    counts = counts_of([*ONE, *OTHER], [*ONE, *ONE], night=night)
    return remeasured(replace(counts, names=("a", "b")), partition=partition)


# Details, of an image by day and one by night.

SUNNY, DARK, NONE = [[2, 0], [2, 0]], [[2, 1], [0, 1]], [[0, 0], [0, 0]]


def of_details(kind: Any, setting: tuple[float, ...], *images: object) -> Counts:
    return Counts(
        counts=np.array(images, np.int64),
        names=tuple(map(str, range(len(images)))),
        night=tuple(index % 2 == 1 for index in range(len(images))),
        classes=("road", "car"),
        measurement=measurement(partition=Details(kind, setting).partition("ring2")),
    )


FIRST = [SUNNY, NONE, NONE, NONE, DARK, NONE, NONE, SUNNY]
BY_DISTANCE = of_details("distance", (10.0, 40.0), FIRST, [DARK, NONE, NONE, SUNNY] * 2)
BY_SIZE = of_details("size", (64.0,), [NONE, SUNNY, NONE, DARK, DARK, SUNNY], [NONE] * 6)
OUTER = [[1, 0], [2, 0], [1, 0]]
BOUNDARIES = of_details(
    "boundary", (0.02,), [[[2, 1], [4, 2], [3, 2]], OUTER], [OUTER, OUTER]
)  # by region: both, label and prediction of road and car
LOW, HIGH = [[4, 0], [1, 0], [12000, 0]], [[2, 4], [2, 2], [18000, 38000]]
CALIBRATED = of_details("calibration", (2.0,), [LOW, HIGH, [[0, 0]] * 3, HIGH])
"""Two regions of two bins: number, correct and units of confidence by predicted class."""


@pytest.mark.parametrize(
    ("counts", "metric", "absent", "expected"),
    [
        # whole image [[7, 1], [2, 6]]: IoU 7/10 and 6/9
        (counts_of(), "mIoU", "released", (7 / 10 + 6 / 9) / 2),
        (counts_of(), "class/car", "released", 6 / 9),
        (counts_of(), "class/car/acc", "released", 6 / 8),
        # rings [[4, 0], [2, 2]]: 4/6 and 2/4; [[3, 1], [0, 4]]: 3/4 and 4/5
        (counts_of(), "region/1", "released", (4 / 6 + 2 / 4) / 2),
        (counts_of(), "region/2", "released", 0.775),
        (counts_of(), "class/road/region/1", "released", 4 / 6),
        (counts_of(), "Var", "released", 100 * ((0.775 - 1.75 / 3) / 2) ** 2),
        (counts_of(), "day/mIoU", "released", 0.775),  # [[3, 1], [0, 4]]
        (counts_of(), "night/class/car/acc", "released", 0.5),  # [[4, 0], [2, 2]]
        (pairs_of(), "night/TC", "released", (4 / 6 + 2 / 4) / 2),
        (pairs_of(), "night/CA", "released", (3 / 6 + 2 / 5) / 2),
        (pairs_of(), "night/CA_released", "released", (3 / 8 + 2 / 6) / 2),
        # By day the sets differ; their shares are averaged.
        (pairs_of(), "day/class/car/TC", "released", (2 / 4 + 8 / 8) / 2),
        (pairs_of(), "day/class/car/CA", "exclude", (2 / 5 + 4 / 8) / 2),
        (pairs_of(), "day/TC", "exclude", (4 / 6 + 3 / 4) / 2),
        # Day and night: images are pooled inside a set.
        (pairs_of(), "class/car/CA", "released", (2 / 5 + 6 / 13) / 2),
        (pairs_of(), "TC", "released", (4 / 6 + (2 / 4 + 10 / 12) / 2) / 2),
        # 0-10 m: [[2,0],[2,0]] + 2 [[2,1],[0,1]] + [[2,1],[0,1]] = [[8,3],[2,3]]: 8/13 and 3/8.
        (BY_DISTANCE, "distance/0-10", "released", (8 / 13 + 3 / 8) / 2),
        # Region 2: [[2,1],[0,1]] twice: 4/6 and 2/4.
        (BY_DISTANCE, "class/car/region/2/distance/0-10", "released", 2 / 4),
        (BY_DISTANCE, "night/distance/0-10", "released", (4 / 6 + 2 / 4) / 2),
        (BY_DISTANCE, "distance/10-40", "released", 0.0),  # no pixel, which counts as 0
        (BY_DISTANCE, "distance/10-40", "exclude", np.nan),
        # 0-64: [[2,1],[0,1]] of region 2. From 64 on [[2,0],[2,0]] + [[2,1],[0,1]].
        (BY_SIZE, "size/0-64", "released", (2 / 3 + 1) / 2),
        (BY_SIZE, "region/1/size/0-64", "released", np.nan),  # no object there
        (BY_SIZE, "region/1/size/64-inf", "released", (1 + 0) / 2),
        (BY_SIZE, "class/road/size/64-inf", "released", 4 / 5),
        # Road 2 + 1 + 1 + 1 of 4 + 2 + 2 + 2 and 3 + 1 + 1 + 1; car 1 of 2 and 2.
        (BOUNDARIES, "boundary_mIoU", "released", (5 / (10 + 6 - 5) + 1 / 3) / 2),
        (BOUNDARIES, "region/1/boundary_mIoU", "released", (3 / (6 + 4 - 3) + 1 / 3) / 2),
        (BOUNDARIES, "class/car/region/1/boundary_IoU", "released", 1 / 3),
        (replace(BOUNDARIES, unscored=("car",)), "boundary_mIoU", "released", 5 / 11),
        # |1 - 1.2| + |8 - 11.2| over 16; region 2: |4 - 5.6| over 6; road: 0.2 + |4 - 3.6| over 8.
        (CALIBRATED, "ECE", "released", (0.2 + 3.2) / 16),
        (CALIBRATED, "class/road/ECE", "released", (0.2 + 0.4) / 8),
    ],
)
def test_values_by_hand(counts: Counts, metric: str, absent: Any, expected: float) -> None:
    assert value(metric, counts, absent) == pytest.approx(100 * expected, nan_ok=True)


@pytest.mark.parametrize(
    ("counts", "metric", "word"),
    [
        (counts_of(), "day/mIou", "is not a metric; did you mean 'mIoU'"),
        (counts_of(), "class/carr", "no class 'carr'; did you mean 'car'"),
        (counts_of(), "region/3", "the counts have the regions 1 to 2"),
        (counts_of(DAY, night=None), "night/mIoU", "marked as day"),
        (pairs_of(), "night/mIoU", "score of single frames.*aligned2.*of pairs"),
        (counts_of(), "night/CA_released", "score of pairs.*ring2.*rgbt consistency run="),
        (counts_of(), "ECE", "details=calibration"),
        (BOUNDARIES, "mIoU", "score of single frames.*of boundary"),
        (BOUNDARIES, "distance/0-10", "score of distance"),
        (BY_DISTANCE, "distance/0-20", "have 0-10, 10-40, 40-inf"),
        (pairs_of(partition="triples1"), "TC", "have flicker"),
        (pairs_of(partition="released1"), "warping_error", "have TC, CA, CA_released; use"),
    ],
)
def test_scores_that_counts_do_not_have_are_refused(counts, metric: str, word: str) -> None:
    with pytest.raises(InputError, match=word):
        value(metric, counts, "released")


@pytest.mark.parametrize(
    "metric",
    ["mIou", "region/0", "region/x", "class/", "class/car/", "class/car/prec", "region/1/TC"]
    + ["class//CA", "", "day", "class/car/boundary_mIoU", "boundary_IoU", "distance", "size/10"]
    + ["size/a-b", "ece", "mIoU/0-10", "region/1/mIoU"],
)
def test_names_that_are_no_metric_are_refused(metric: str) -> None:
    with pytest.raises(InputError, match=f"'{metric}' is not a metric"):
        parse(metric)


def test_kind_of_details_that_a_metric_needs() -> None:
    kinds = {"day/class/car/ECE": "calibration", "size/0-64": "size", "class/size": None}
    assert {metric: details_of_metric(metric) for metric in kinds} == kinds


@pytest.mark.parametrize(
    "metric",
    ["mIoU", "Var", "pixel_accuracy", "region/2", "class/car", "day/class/car/acc"]
    + ["TC", "class/car/CA", "night/TC", "warping_error", "class/car/warping_error"],
)
def test_many_sums_at_once_are_each_alone(metric: str) -> None:
    requested = parse(metric)
    counts = pairs_of() if requested.score in {*PAIR_SCORES, *CHANGES} else counts_of()
    by_region = images_of(requested, counts).by_region()
    many = np.stack([by_region, 3 * by_region, by_region[..., ::-1]])[:, None]
    sums = sums_of(requested, many, counts.partition)
    found = values(requested, sums, counts, "released")
    assert found.shape == (3, 1)
    alone = [values(requested, of_one[0], counts, "released") for of_one in sums]
    np.testing.assert_allclose(found[:, 0], alone)
    np.testing.assert_allclose(found[0], value(metric, counts, "released"))


@pytest.mark.parametrize(
    ("counts", "metric"),
    [
        *((counts_of(), metric) for metric in ("mIoU", "Var", "class/car/region/2")),
        *((pairs_of(), metric) for metric in ("TC", "class/car/CA", "warping_error")),
        (pairs_of(partition="flow2"), "CA"),
        (pairs_of(partition="triples2"), "flicker"),
        *((BY_DISTANCE, metric) for metric in ("distance/0-10", "region/2/distance/40-inf")),
        *((BOUNDARIES, metric) for metric in ("boundary_mIoU", "region/2/boundary_mIoU")),
        *((CALIBRATED, metric) for metric in ("ECE", "class/road/region/1/ECE")),
    ],
)
def test_sums_of_images_add_up(counts: Counts, metric: str) -> None:
    requested = parse(metric)
    by_image = sums_of(requested, counts.counts, counts.partition)
    whole = sums_of(requested, counts.by_region(), counts.partition)
    assert by_image.shape == (len(counts.names), *whole.shape)
    np.testing.assert_array_equal(by_image.sum(0), whole)
    found = values(requested, whole, counts, "exclude")
    np.testing.assert_array_equal(found, value(metric, counts, "exclude"))


def test_scores_of_equal_sums_read_the_same() -> None:
    """Means and classes read the same pixels; regions and Var others, and so do day and pairs."""
    same = [
        {"mIoU", "mAcc", "class/car", "pixel_accuracy"},
        {"Var", "region/2", "class/car/region/1"},
    ]
    same += [{"day/mIoU", "day/class/car/acc"}, {"TC", "class/car/TC"}, {"CA", "CA_released"}]
    groups = [{parse(metric).sums for metric in metrics} for metrics in same]
    assert [len(group) for group in groups] == [1] * len(same)
    assert len(set.union(*groups)) == len(same)


def test_ca_along_an_estimated_flow_is_of_labelled_pixels() -> None:
    """What has no label cannot be wrong, and counts for TC and the warping error alone."""
    counts = pairs_of().counts
    unlabelled = np.zeros_like(counts)
    unlabelled[:, -1] = 7
    more = replace(pairs_of(partition="flow1"), counts=counts + unlabelled)
    less = pairs_of(partition="next1")
    assert value("CA", more, "released") == value("CA", less, "released") > 0
    assert value("TC", more, "released") < value("TC", less, "released")
    for absent in ("released", "exclude"):
        assert np.isnan(value("CA", replace(more, counts=unlabelled), absent))


def test_every_score_of_a_table_has_a_value() -> None:
    for counts in (BY_DISTANCE, BY_SIZE, BOUNDARIES, CALIBRATED, counts_of(), pairs_of()):
        grid = score_grid(counts)
        assert {len(row) for _, row in grid.rows} == {len(grid.columns)}
        for metric in grid.metrics:
            value(metric, counts, "released")
    assert score_grid(BY_DISTANCE).columns == ("0-10", "10-40", "40-inf")
    assert headlines(BY_DISTANCE) == ("distance/0-10", "distance/10-40", "distance/40-inf")
    assert headlines(CALIBRATED) == ("ECE", "region/1/ECE", "region/2/ECE")


@pytest.mark.parametrize(
    "details",
    [
        *(Details(kind, setting) for kind, setting in DEFAULTS.items()),
        *(Details("boundary", (0.0012,)), Details("boundary", (0.02, 1.0))),
        *(Details("size", (0.5, 123456.0, 1e7)), Details("distance", (1e-05,))),
    ],
)
def test_partition_names_the_kind_and_its_setting(details: Details) -> None:
    name = "ring9_released_3_4"
    partition = details.partition(name)
    assert details_of(partition) == details
    assert regions_of(partition) == regions_of(name) == name
    assert details_of(name) is details_of("aligned3-1c0ffe") is None


def test_requested_details() -> None:
    assert requested("none", (0.02, False), "10", "64") == ()
    found = requested("[size,boundary,size]", (0.1, True), "10", "64")
    assert found == (Details("size", (64.0,)), Details("boundary", (0.1, 1.0)))
    every = requested("all", (0.1, False), "5,7.5", "64,128")
    assert [details.setting for details in every] == [(0.1,), (15.0,), (5.0, 7.5), (64.0, 128.0)]
    assert every[2].bins == ("0-5", "5-7.5", "7.5-inf")


def test_fractions_are_shown_in_percent() -> None:
    for name in ("ECE", "day/boundary_mIoU", "region/1/ECE", "distance/0-10", "size/0-64"):
        assert in_percent(name, 0.5) == 50.0
    assert shown({"mIoU": 0.12346, "Var": 0.127, "loss": 0.127}) == {
        "mIoU": 12.35,
        "Var": 0.13,
        "loss": 0.127,
    }
