from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import CHANGES, OF_PAIRS, images_of, parse, value, values
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


@pytest.mark.parametrize(
    ("metric", "of_pairs", "night", "word"),
    [
        ("class/carr", False, True, "no class 'carr'; did you mean 'car'"),
        ("region/3", False, True, "the counts have the regions 1 to 2"),
        ("night/mIoU", False, False, "marked as day"),
        ("class/carr/TC", True, True, "no class 'carr'; did you mean 'car'"),
        ("night/TC", True, False, "marked as day"),
        *((each, True, True, "score of single frames.*aligned2, of rgbt consistency")
          for each in ("mIoU", "Var", "class/car/acc", "class/car/region/2", "night/mIoU")),
        *((each, False, True, "score of pairs.*ring2.*rgbt consistency run=")
          for each in ("TC", "CA", "night/CA_released", "class/car/TC")),
    ],
)  # fmt: skip
def test_scores_that_counts_do_not_have_are_refused(
    metric: str, of_pairs: bool, night: bool, word: str
) -> None:
    given = {} if night else {"night": None}
    counts = pairs_of(**given) if of_pairs else counts_of(DAY, **given) if given else counts_of()
    with pytest.raises(InputError, match=word):
        value(metric, counts, "released")


@pytest.mark.parametrize(
    "metric",
    ["mIou", "region/0", "region/x", "class/", "class/car/prec", "region/1/TC", "class//CA", ""],
)
def test_unknown_metrics_are_refused(metric: str) -> None:
    with pytest.raises(InputError, match=f"'{metric}' is not a metric"):
        parse(metric)
    with pytest.raises(InputError, match="did you mean 'mIoU'"):
        parse("day/mIou")


@pytest.mark.parametrize(
    "metric",
    ["mIoU", "Var", "mAcc", "pixel_accuracy", "region/2", "class/car", "day/class/car/acc"]
    + ["TC", "CA", "CA_released", "class/car/CA", "night/TC"]
    + ["warping_error", "class/car/warping_error"],
)
def test_many_sums_at_once_are_each_alone(metric: str) -> None:
    requested = parse(metric)
    counts = pairs_of() if requested.score in {*OF_PAIRS, *CHANGES} else counts_of()
    by_region = images_of(requested, counts).by_region()
    many = np.stack([by_region, 3 * by_region, by_region[..., ::-1]])[:, None]
    found = values(requested, many, counts, "released")
    assert found.shape == (3, 1)
    alone = [values(requested, each[0], counts, "released") for each in many]
    np.testing.assert_allclose(found[:, 0], alone)
    np.testing.assert_allclose(found[0], value(metric, counts, "released"))


def test_scores_of_a_protocol_alone() -> None:
    for protocol, metric, word in (
        ("triples1", "TC", "'TC' is no score of counts by triples1; use flicker"),
        ("flow1", "flicker", "use TC, CA, CA_released, warping_error"),
        ("released1", "warping_error", "use TC, CA, CA_released"),
    ):
        with pytest.raises(InputError, match=word):
            value(metric, replace(pairs_of(), partition=protocol), "released")


def test_ca_along_an_estimated_flow_is_of_labelled_pixels() -> None:
    """What has no label cannot be wrong, and counts for TC and the warping error alone."""
    labelled = pairs_of()
    counts = labelled.counts.copy()
    counts[:, -1] += 7
    more = replace(labelled, counts=counts, partition="flow1")
    counts = labelled.counts.copy()
    counts[:, -1] = 0
    less = replace(labelled, counts=counts, partition="next1")
    assert value("CA", more, "released") == value("CA", less, "released") > 0
    assert value("TC", more, "released") < value("TC", less, "released")
    none = counts.copy()
    none[:, :-1] = 0
    none[:, -1] = 1
    for absent in ("released", "exclude"):
        assert np.isnan(value("CA", replace(more, counts=none), absent))
