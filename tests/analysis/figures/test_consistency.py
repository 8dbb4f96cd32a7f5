"""Temporal, Fig. 5."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.figures.consistency import class_consistency, draw
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from tests.analysis.counts import counts_of
from tests.analysis.figures.drawn import texts
from tests.analysis.uncertainty.simulated import CLASSES, pairs_of


def alike(share: int, partition: str = "aligned1") -> Counts:
    """Pairs that agree on class 0 in `share` of 100 pixels; the others are class 1 in frame 2."""
    pairs = np.zeros((3, 2, 2), int)
    pairs[0, 0] = share, 100 - share
    return counts_of(pairs, partition=partition)


def test_series_by_hand_and_their_means() -> None:
    # Seeds of one variant are averaged: 80 and 90 percent.
    data = class_consistency({"(G)": [alike(60)], "(H)": [alike(80), alike(90)]}, "released")
    assert data.protocol == "aligned"
    assert data.classes == ("class0", "class1")
    assert data.variants == ("(G)", "(H)")
    np.testing.assert_allclose(data.tc, [[60, 0], [85, 0]])
    np.testing.assert_allclose(data.ca, [[60, 0], [85, 0]])
    assert list(data.means()) == ["(G)", "(H)"]
    np.testing.assert_allclose(list(data.means().values()), [(30, 30), (42.5, 42.5)])


def test_ca_is_by_the_union_of_the_protocol() -> None:
    for partition, union in (
        ("aligned1", 100),
        ("next1", 100),
        ("released1", 100 + 60 + 100 - 120),
    ):
        data = class_consistency({"(G)": [alike(60, partition)]}, "released")
        np.testing.assert_allclose(data.ca, [[100 * 60 / union, 0]])


def test_value_equals_the_metric() -> None:
    seeds = [pairs_of(10, 0.6, seed) for seed in range(2)]
    data = class_consistency({"ours": seeds}, "released")
    for column, name in enumerate(CLASSES):
        for row, score in ((data.tc, "TC"), (data.ca, "CA")):
            metric = f"class/{name}/{score}"
            expected = np.mean([value(metric, each, "released") for each in seeds])
            assert row[0, column] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("partition", "title", "axis"),
    [
        ("released1", "virtual views, frames not warped (as released)", "CA (released) open"),
        ("next1", "consecutive frames", "CA open"),
    ],
)
def test_says_how_frames_were_compared(
    tmp_path: Path, partition: str, title: str, axis: str
) -> None:
    data = class_consistency({"(G)": [alike(60, partition)]}, "exclude")
    found = texts(draw(data), tmp_path)
    assert title in found
    assert any(text.endswith(axis) for text in found)


def test_counts_of_single_frames_are_refused() -> None:
    with pytest.raises(
        InputError, match=r"counts of 'x' \(ring2\) are of single .*consistency run="
    ):
        class_consistency({"x": [counts_of(np.ones((2, 2, 2), int))]}, "released")


@pytest.mark.parametrize(
    "other",
    [alike(60, "released1"), replace(alike(60), classes=("road", "car"))],
    ids=["protocol", "classes"],
)
def test_predictions_of_several_kinds_are_refused(other: Counts) -> None:
    with pytest.raises(InputError, match="give counts of one protocol and data set"):
        class_consistency({"x": [alike(60)], "y": [other]}, "released")
