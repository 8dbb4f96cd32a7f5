"""Footnotes about absent classes, and the convention that counts carry."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.metrics.absent import absent_notes
from rgbt.metrics.counts import ARCHIVE, Counts, convention
from rgbt.metrics.scores import summary

CLASSES = ("road", "car", "rail", "bump")


def counts_of(absent: str = "released") -> Counts:
    """One image, two regions: rail nowhere, bump predicted on 5 road pixels of region 2 only."""
    array = np.zeros((1, 2, 4, 4), np.int64)
    array[0, :, 0, 0] = 90, 95
    array[0, 0, 1, 1] = 10
    array[0, 1, 0, 3] = 5
    return Counts(
        counts=array,
        names=("a",),
        night=None,
        classes=CLASSES,
        partition="ring2",
        dataset="d",
        split="test",
        absent=absent,  # type: ignore[arg-type]
    )


@pytest.mark.parametrize(
    ("absent", "counted"), [("released", "counted as 0"), ("exclude", "left out of the mean")]
)
def test_absent_notes_by_hand(absent, counted: str) -> None:
    counts = counts_of()
    assert absent_notes(counts.by_region(), CLASSES, counts.scored, "test", absent) == (
        f"absent from the test split: rail ({counted})",
        "predicted, but not labelled in the test split: bump (IoU 0)",
        f"absent from some regions: car (region 2), bump (region 1); {counted} there",
    )


def test_absent_notes_leave_out_unscored_classes_and_are_none_where_all_are_there() -> None:
    counts = replace(counts_of(), unscored=("car", "rail", "bump"))
    assert absent_notes(counts.by_region(), CLASSES, counts.scored, "test", "released") == ()
    full = np.ones((2, 4, 4), np.int64)
    assert absent_notes(full, CLASSES, np.ones(4, bool), "test", "exclude") == ()


def test_one_false_pixel_of_an_unlabelled_class_counts_with_either_convention() -> None:
    """road 185 / 190, car 1, bump 0 of 5; rail is 0 or left out."""
    for absent, classes in (("released", 4), ("exclude", 3)):
        found = summary(counts_of(), absent)  # type: ignore[arg-type]
        assert found["mIoU"] == pytest.approx((185 / 190 + 1 + 0) / classes)


def test_counts_keep_their_convention(tmp_path: Path) -> None:
    path = tmp_path / "counts.npz"
    for absent in ("released", "exclude"):
        counts_of(absent).save(path)
        assert Counts.load(path).absent == absent
        assert Counts.load(path).select(["a"]).absent == absent
    values = ARCHIVE.load(path)
    ARCHIVE.save(path, {key: value for key, value in values.items() if key != "absent"})
    assert Counts.load(path).absent == "released"
    with pytest.raises(ValueError, match="expected released or exclude, got 'zero'"):
        counts_of("zero")


def test_convention_of_counts_made_with_both_is_refused() -> None:
    assert convention([counts_of("exclude"), counts_of("exclude")]) == "exclude"
    with pytest.raises(InputError, match="choose absent=released or absent=exclude"):
        convention([counts_of(), counts_of("exclude")])
