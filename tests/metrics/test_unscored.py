"""Classes that are counted but not scored: by hand, and against scikit-learn."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from sklearn.metrics import f1_score, jaccard_score, precision_score, recall_score

from rgbt.checks import InputError
from rgbt.metrics import scores
from rgbt.metrics.counts import ARCHIVE, Counts, check_same_means
from rgbt.metrics.named import parse, value, values

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


def counts_of(
    *images: object,
    unscored: tuple[str, ...] = ("void",),
    night: tuple[bool, ...] | None = None,
    partition: str = "ring2",
) -> Counts:
    return Counts(
        counts=np.array(images or [[LEFT, RIGHT]], np.int32),
        names=tuple(f"{index:05d}" for index in range(max(1, len(images)))),
        night=night,
        classes=CLASSES,
        partition=partition,
        dataset="f",
        split="test",
        unscored=unscored,
    )


@pytest.mark.parametrize("absent", ["released", "exclude"])
def test_means_by_hand(absent) -> None:
    counts = counts_of()
    expected = BY_HAND | {"region/1": IN_LEFT[absent]}
    # Two regions: half their difference is the deviation of both.
    spread = (100 * (IN_LEFT[absent] - IN_RIGHT) / 2) ** 2
    summary = scores.summary(counts, absent)
    for metric, fraction in expected.items():
        assert value(metric, counts, absent) == pytest.approx(100 * fraction), metric
        if metric in summary:
            assert summary[metric] == pytest.approx(fraction), metric
    assert value("Var", counts, absent) == summary["Var"] == pytest.approx(spread)
    assert {f"class/{name}" for name in CLASSES} < set(summary)  # all, the unscored one too


def test_with_every_class_scored_the_means_are_others() -> None:
    counts = counts_of(unscored=())
    assert value("mIoU", counts, "released") == pytest.approx(
        100 * (10 / 15 + 3 / 7 + 2 / 4 + 6 / 13) / 4
    )
    assert value("pixel_accuracy", counts, "released") == pytest.approx(70)


def test_an_unscored_class_without_pixels_is_no_zero_either() -> None:
    # Nothing is void, in label or prediction: "released" counts the person as 0 and void not at
    # all. Road 6 of 8, car 3 of 5.
    empty = [[6, 1, 0, 0], [1, 3, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
    counts = counts_of([empty])
    assert value("mIoU", counts, "released") == pytest.approx(100 * (6 / 8 + 3 / 5) / 3)
    assert value("mIoU", counts, "exclude") == pytest.approx(100 * (6 / 8 + 3 / 5) / 2)


def test_a_region_of_unscored_pixels_alone() -> None:
    nothing = np.zeros((4, 4), int)
    nothing[3, 3] = 9
    counts = counts_of([LEFT, nothing, RIGHT], partition="ring3")
    released = [IN_LEFT["released"], 0, IN_RIGHT]
    assert value("region/2", counts, "released") == 0
    assert value("Var", counts, "released") == pytest.approx(np.var(np.array(released) * 100))
    assert np.isnan(value("region/2", counts, "exclude"))
    expected = (100 * (IN_LEFT["exclude"] - IN_RIGHT) / 2) ** 2
    assert value("Var", counts, "exclude") == pytest.approx(expected)


def test_day_and_night_and_chosen_images_leave_it_out_too() -> None:
    counts = counts_of([LEFT, LEFT], [RIGHT, RIGHT], night=(False, True))
    day, night = 100 * IN_LEFT["released"], 100 * IN_RIGHT
    assert value("day/mIoU", counts, "released") == pytest.approx(day)
    assert value("night/mIoU", counts, "released") == pytest.approx(night)
    summary = scores.summary(counts, "released")
    assert 100 * summary["day/mIoU"] == pytest.approx(day)
    assert summary["night/Var"] == pytest.approx(0)
    chosen = [counts.select(["00001"]), counts.parts()["day"], replace(counts, split="val")]
    assert [each.unscored for each in chosen] == [("void",)] * 3
    assert value("mIoU", chosen[0], "released") == pytest.approx(night)


@pytest.mark.parametrize(
    ("metric", "theirs"),
    [
        ("mIoU", jaccard_score),
        ("mAcc", recall_score),
        ("mPrecision", precision_score),
        ("mF1", f1_score),
    ],
)
@pytest.mark.parametrize("seed", range(3))
def test_equal_to_scikit_learn_over_the_scored_labels(seed, metric, theirs) -> None:
    rng = np.random.default_rng(seed)
    label, prediction = rng.integers(0, 7, 500), rng.integers(1, 7, 500)
    matrix = np.zeros((7, 7), np.int64)
    np.add.at(matrix, (label, prediction), 1)
    names = tuple(f"c{index}" for index in range(7))
    counts = replace(
        counts_of(unscored=()), counts=matrix[None, None], classes=names, unscored=("c5", "c2")
    )
    expected = theirs(label, prediction, labels=[0, 1, 3, 4, 6], average="macro", zero_division=0)
    assert value(metric, counts, "released") == pytest.approx(100 * expected)


def test_many_sums_at_once_are_each_alone() -> None:
    counts = counts_of()
    by_region = counts.by_region()
    many = np.stack([by_region, by_region[::-1], by_region.transpose(0, 2, 1)])
    for metric in ("mIoU", "Var", "mF1", "region/1", "class/void"):
        found = values(parse(metric), many, counts, "exclude")
        alone = [value(metric, replace(counts, counts=each[None]), "exclude") for each in many]
        np.testing.assert_allclose(found, alone)


# Pairs of frames: by label (the last: no class), first, second.


def test_pairs_of_frames_by_hand() -> None:
    pairs = np.zeros((5, 4, 4), int)
    pairs[0, 0, 0] = 3  # road, twice seen as such
    pairs[0, 0, 1] = 1
    pairs[1, 1, 1] = 2
    pairs[2, 3, 3] = 4  # a person, twice void
    pairs[3, 3, 0] = 2  # void, then road
    counts = counts_of(pairs, partition="aligned1")
    # TC: road 3 of 6, car 2 of 3, person in no frame; void 4 of 6.
    # CA: road 3 of 6, car 2 of 3, person 0 of 4 (label alone); void 0 of 6.
    assert value("class/void/TC", counts, "released") == pytest.approx(100 * 4 / 6)
    assert value("TC", counts, "released") == pytest.approx(100 * (3 / 6 + 2 / 3 + 0) / 3)
    assert value("TC", counts, "exclude") == pytest.approx(100 * (3 / 6 + 2 / 3) / 2)
    for absent in ("released", "exclude"):
        assert value("CA", counts, absent) == pytest.approx(100 * (3 / 6 + 2 / 3 + 0) / 3)
    # As released: the three sizes less twice what all three share.
    road, car = 3 / (4 + 5 + 4 - 2 * 3), 2 / (2 + 3 + 2 - 2 * 2)
    assert value("CA_released", counts, "released") == pytest.approx(100 * (road + car + 0) / 3)


# The file, and what is refused.


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    for unscored in ((), ("void",), ("void", "person")):
        counts_of(unscored=unscored).save(tmp_path / "test.npz")
        assert Counts.load(tmp_path / "test.npz").unscored == unscored


def test_files_from_before_score_every_class(tmp_path: Path) -> None:
    counts = counts_of()
    stored = {each.name: getattr(counts, each.name) for each in fields(counts)}
    del stored["unscored"]
    ARCHIVE.save(tmp_path / "old.npz", {**stored, "night": np.array((), bool)})
    loaded = Counts.load(tmp_path / "old.npz")
    assert loaded.unscored == ()
    assert loaded.scored.tolist() == [True] * 4
    assert counts.scored.tolist() == [True, True, True, False]


@pytest.mark.parametrize("unscored", [("sky",), ("void", "Void"), CLASSES])
def test_unscored_are_some_of_the_classes(unscored) -> None:
    with pytest.raises(ValueError, match="some of the classes road, car, person, void, but not"):
        counts_of(unscored=unscored)


def test_means_over_different_classes_are_not_compared() -> None:
    check_same_means(counts_of(unscored=("void", "car")), counts_of(unscored=("car", "void")))
    with pytest.raises(
        InputError, match=r"leave void out.*leave out no class; .*dataset\.unscored"
    ):
        check_same_means(counts_of(), counts_of(unscored=()))
