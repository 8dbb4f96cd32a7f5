"""Kinds of details: names of partitions, settings, metric names and values by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import Details, default, details_of, parse_detail, regions_of, requested
from rgbt.metrics.named import parse, value
from rgbt.metrics.names import in_percent
from rgbt.metrics.score_grid import headlines, score_grid
from tests.sweeps.tabled import counts_of

DISTANCE = Details("distance", (10.0, 40.0))
DAY, NIGHT = [[2, 0], [2, 0]], [[2, 1], [0, 1]]
NONE = [[0, 0], [0, 0]]


def of_details(details: Details, *images: object) -> Counts:
    return Counts(
        counts=np.array(images, np.int64),
        names=tuple(map(str, range(len(images)))),
        night=tuple(index % 2 == 1 for index in range(len(images))),
        classes=("road", "car"),
        partition=details.partition("ring2"),
        dataset="d",
        split="test",
    )


def by_distance() -> Counts:
    """Two regions of three bins and the sky; an image by day and one by night."""
    first = [DAY, NONE, NONE, NONE, NIGHT, NONE, NONE, DAY]
    return of_details(DISTANCE, first, [NIGHT, NONE, NONE, DAY] * 2)


def by_size() -> Counts:
    details = Details("size", (64.0,))
    return of_details(details, [NONE, DAY, NONE, NIGHT, NIGHT, DAY], [NONE] * 6)


def boundaries() -> Counts:
    """By region: both, label and prediction of road and car."""
    first, second = [[2, 1], [4, 2], [3, 2]], [[1, 0], [2, 0], [1, 0]]
    return of_details(Details("boundary", (0.02,)), [first, second], [second, second])


def calibrated() -> Counts:
    """Two regions of two bins: number, correct and units of confidence by predicted class."""
    low, high = [[4, 0], [1, 0], [12000, 0]], [[2, 4], [2, 2], [18000, 38000]]
    empty = [[0, 0], [0, 0], [0, 0]]
    return of_details(Details("calibration", (2.0,)), [low, high, empty, high])


@pytest.mark.parametrize(
    ("counts", "metric", "expected"),
    [
        # 0-10 m: [[2,0],[2,0]] + 2 [[2,1],[0,1]] + [[2,1],[0,1]] = [[8,3],[2,3]]: 8/13 and 3/8.
        (by_distance(), "distance/0-10", (8 / 13 + 3 / 8) / 2),
        (by_distance(), "class/car/distance/0-10", 3 / 8),
        # Region 2: [[2,1],[0,1]] twice: 4/6 and 2/4.
        (by_distance(), "region/2/distance/0-10", (4 / 6 + 2 / 4) / 2),
        (by_distance(), "class/car/region/2/distance/0-10", 2 / 4),
        (by_distance(), "night/distance/0-10", (4 / 6 + 2 / 4) / 2),
        (by_distance(), "distance/10-40", 0.0),  # no pixel, which "released" counts as 0
        # 0-64: [[2,1],[0,1]] of region 2. From 64 on [[2,0],[2,0]] + [[2,1],[0,1]].
        (by_size(), "size/0-64", (2 / 3 + 1) / 2),
        (by_size(), "size/64-inf", (4 / 5 + 1 / 3) / 2),
        (by_size(), "region/1/size/64-inf", (1 + 0) / 2),
        (by_size(), "class/road/size/64-inf", 4 / 5),
        # Road 2 + 1 + 1 + 1 of 4 + 2 + 2 + 2 and 3 + 1 + 1 + 1; car 1 of 2 and 2.
        (boundaries(), "boundary_mIoU", (5 / (10 + 6 - 5) + 1 / 3) / 2),
        (boundaries(), "region/1/boundary_mIoU", (3 / (6 + 4 - 3) + 1 / 3) / 2),
        (boundaries(), "class/road/boundary_IoU", 5 / 11),
        (boundaries(), "class/car/region/1/boundary_IoU", 1 / 3),
        # |1 - 1.2| + |8 - 11.2| over 16; region 2: |4 - 5.6| over 6; road: 0.2 + |4 - 3.6| over 8.
        (calibrated(), "ECE", (0.2 + 3.2) / 16),
        (calibrated(), "region/2/ECE", 1.6 / 6),
        (calibrated(), "class/road/ECE", (0.2 + 0.4) / 8),
    ],
)
def test_values_by_hand(counts: Counts, metric: str, expected: float) -> None:
    assert value(metric, counts, "released") == pytest.approx(100 * expected)


def test_absent_classes_and_unscored_classes() -> None:
    assert np.isnan(value("distance/10-40", by_distance(), "exclude"))
    assert np.isnan(value("region/1/size/0-64", by_size(), "released"))  # no object there
    road = replace(boundaries(), unscored=("car",))
    assert value("boundary_mIoU", road, "released") == pytest.approx(100 * 5 / 11)
    assert value("class/car/boundary_IoU", road, "released") == pytest.approx(100 / 3)


def test_every_score_of_a_table_has_a_value() -> None:
    for counts in (by_distance(), by_size(), boundaries(), calibrated(), counts_of()):
        grid = score_grid(counts)
        assert {len(row) for _, row in grid.rows} == {len(grid.columns)}
        for metric in grid.metrics:
            value(metric, counts, "released")
    assert score_grid(by_distance()).columns == ("0-10", "10-40", "40-inf")
    assert headlines(by_distance()) == ("distance/0-10", "distance/10-40", "distance/40-inf")
    assert headlines(calibrated()) == ("ECE", "region/1/ECE", "region/2/ECE")


@pytest.mark.parametrize(
    ("counts", "metric", "words"),
    [
        (counts_of(), "ECE", "details=calibration"),
        (boundaries(), "mIoU", "Use scores of boundary"),
        (boundaries(), "distance/0-10", "score of distance"),
        (by_distance(), "distance/0-20", "the bins 0-10, 10-40, 40-inf"),
        (by_distance(), "region/3/distance/0-10", "the regions 1 to 2"),
        (boundaries(), "class/cat/boundary_IoU", "no class 'cat'"),
        (calibrated(), "class/cat/ECE", "no class 'cat'"),
    ],
)
def test_scores_that_counts_do_not_have_are_refused(counts, metric: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        value(metric, counts, "released")


@pytest.mark.parametrize(
    "metric", ["class/car/boundary_mIoU", "boundary_IoU", "distance", "size/10", "size/a-b", "ece"]
)
def test_names_that_are_no_metric_are_refused(metric: str) -> None:
    with pytest.raises(InputError, match="is not a metric"):
        parse(metric)


def test_names_of_other_metrics_keep_their_meaning() -> None:
    for name in ("mIoU", "region/1", "class/size", "class/car/acc", "class/car/region/1"):
        assert parse_detail(name.split("/")) is None
        assert parse(name).details is None


@pytest.mark.parametrize("name", ["ring5", "ring9_released_3_4"])
@pytest.mark.parametrize(
    "details",
    [
        *map(default, ("boundary", "calibration", "distance", "size")),
        Details("boundary", (0.0012,)),
        Details("boundary", (0.02, 1.0)),
        Details("size", (0.5, 123456.0, 1e7)),
        Details("distance", (1e-05,)),
    ],
)
def test_partition_names_the_kind_and_its_setting(name: str, details: Details) -> None:
    partition = details.partition(name)
    assert details_of(partition) == details
    assert regions_of(partition) == name


@pytest.mark.parametrize("partition", ["ring5", "aligned3", "aligned3-1c0ffe", "next1"])
def test_other_partitions_are_no_details(partition: str) -> None:
    assert details_of(partition) is None
    assert regions_of(partition) == partition


def test_requested_details() -> None:
    assert requested("none", (0.02, False), "10", "64") == ()
    assert [each.kind for each in requested("[size,boundary,size]", (0.1, False), "10", "64")] == [
        "size",
        "boundary",
    ]
    every = requested("all", (0.1, False), "5,7.5", "64,128")
    assert [each.setting for each in every] == [(0.1,), (15.0,), (5.0, 7.5), (64.0, 128.0)]
    assert [each.with_border for each in every] == [False] * 4
    assert requested("boundary", (0.1, True), "1", "1") == (Details("boundary", (0.1, 1.0)),)
    assert every[2].bins == ("0-5", "5-7.5", "7.5-inf")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (("boundry", (0.02, False), "1", "1"), "did you mean 'boundary'"),
        (("size,all", (0.02, False), "1", "1"), "'all' stands alone"),
        (
            ("boundary", (0.5, False), "1", "1"),
            "boundary_width must be between 0.001 and 0.2, got 0.5",
        ),
        (
            ("distance", (0.02, False), "10,5", "1"),
            "distances=10,5: expected 1 to 20 rising numbers",
        ),
        (("distance", (0.02, False), "near", "1"), "distances=near: expected numbers"),
        (("size", (0.02, False), "1", "0,5"), "sizes=0,5: expected 1 to 20 rising numbers"),
        (("size", (0.02, False), "1", "inf"), "sizes=inf: expected 1 to 20 rising numbers"),
    ],
)
def test_wrong_settings_are_refused(given, words: str) -> None:
    with pytest.raises(InputError, match=words):
        requested(*given)


@pytest.mark.parametrize("shape", [(6, 2, 2), (4, 3, 2)])
def test_counts_of_another_shape_are_refused(shape) -> None:
    with pytest.raises(ValueError, match="counts: expected"):
        of_details(DISTANCE, np.zeros(shape, np.int64))


def test_counts_are_stored_and_read(tmp_path) -> None:
    calibrated().save(tmp_path / "c.npz")
    again = Counts.load(tmp_path / "c.npz")
    assert np.array_equal(again.counts, calibrated().counts)
    assert again.partition == "ring2-calibration-2"


def test_fractions_are_shown_in_percent() -> None:
    for name in ("ECE", "boundary_mIoU", "region/1/ECE", "distance/0-10", "size/0-64"):
        assert in_percent(name, 0.5) == 50.0
