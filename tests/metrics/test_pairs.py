"""TC and CA by hand, by sets of pixels, and against the released evaluation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rgbt.metrics.counting import pair_counts
from rgbt.metrics.pairs import (
    HEADLINES,
    PROTOCOLS,
    ca,
    ca_released,
    changed,
    file_name,
    flickered,
    only_labelled,
    partition_name,
    protocol_of,
    tc,
)
from rgbt.metrics.scores import class_mean
from tests.metrics.test_counting import maps
from tests.models.golden import FOLDER

GOLDEN = FOLDER / "losses.npz"
BOTH = ["released", "exclude"]

FIRST = np.array([[0, 1, 1, 2], [2, 2, 0, 0]], np.uint8)
SECOND = np.array([[0, 1, 2, 2], [2, 1, 0, 1]], np.uint8)
LABEL = np.array([[0, 1, 2, 2], [1, 2, 0, 1]], np.uint8)


def by_sets_of_pixels(first, second, label, valid, classes: int) -> dict[str, list[float]]:
    """TC, CA and the coded CA of each class; NaN for 0 / 0."""
    found: dict[str, list[float]] = {"tc": [], "ca": [], "coded": []}
    for number in range(classes):
        one, two, truth = (
            set(np.flatnonzero((each == number) & valid)) for each in (first, second, label)
        )
        three = len(one & two & truth)
        coded = len(one) + len(two) + len(truth) - 2 * three
        for name, part, whole in (
            ("tc", len(one & two), len(one | two)),
            ("ca", three, len(one | two | truth)),
            ("coded", three, coded),
        ):
            found[name].append(part / whole if whole else np.nan)
    return found


# Scores.


@pytest.mark.parametrize("absent", BOTH)
def test_scores_by_hand(absent) -> None:
    counts = pair_counts(FIRST, SECOND, LABEL, 3)
    np.testing.assert_allclose(tc(counts, absent), [2 / 3, 1 / 4, 2 / 4])
    np.testing.assert_allclose(ca(counts, absent), [2 / 3, 1 / 5, 1 / 4])
    np.testing.assert_allclose(ca_released(counts, absent), [2 / 3, 1 / 6, 1 / 7])


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("masked", [False, True])
def test_equal_to_sets_of_pixels(seed: int, masked: bool) -> None:
    first, second, label, valid = maps(seed, 9, (6, 9))
    chosen = valid & (label < 9) if masked else np.ones_like(valid)
    counts = pair_counts(first, second, label, 9, chosen if masked else None)
    expected = by_sets_of_pixels(first, second, label, chosen, 9)
    np.testing.assert_allclose(tc(counts, "exclude"), expected["tc"])
    np.testing.assert_allclose(ca(counts, "exclude"), expected["ca"])
    np.testing.assert_allclose(ca_released(counts, "exclude"), expected["coded"])


def test_absent_classes_by_hand() -> None:
    # Class 1 is labelled and never predicted; class 2 is nowhere.
    nothing, label = np.zeros((1, 4), np.uint8), np.array([[0, 0, 0, 1]])
    counts = pair_counts(nothing, nothing, label, 3)
    np.testing.assert_array_equal(tc(counts, "released"), [1, 0, 0])
    np.testing.assert_array_equal(tc(counts, "exclude"), [1, np.nan, np.nan])
    np.testing.assert_array_equal(ca(counts, "exclude"), [3 / 4, 0, np.nan])
    np.testing.assert_array_equal(ca(counts, "released"), [3 / 4, 0, 0])


@pytest.mark.parametrize(("absent", "expected"), [("released", 1 / 3), ("exclude", 1 / 2)])
def test_the_mean_is_over_sets_not_over_their_pixels(absent, expected: float) -> None:
    # Class 0: alike in 1 of 1 pixel, in 0 of 9, and in the third set nowhere. Pooled: 1 / 10.
    one, none = np.zeros((1, 1), np.uint8), np.zeros((1, 9), np.uint8)
    sets = [
        pair_counts(one, one, one, 2),
        pair_counts(none, none + 1, none, 2),
        pair_counts(none + 1, none + 1, none + 1, 2),
    ]
    counts = np.concatenate(sets)
    assert counts.shape == (9, 2, 2)
    assert tc(counts, absent)[0] == pytest.approx(expected)
    assert ca(counts, absent)[0] == pytest.approx(expected)
    assert tc(sum(sets), absent)[0] == pytest.approx(1 / 10)


def test_rows_that_are_no_whole_number_of_sets() -> None:
    with pytest.raises(ValueError, match="expected S x 4 rows, got 5"):
        tc(np.zeros((5, 3, 3)), "released")


# The released evaluation.


@pytest.fixture(scope="module")
def golden() -> Any:
    if not GOLDEN.exists():
        pytest.skip("reference material is not beside the checkout")
    return np.load(GOLDEN)


def frames_of(golden: Any, protocol: str) -> list[np.ndarray]:
    """Counts of the four frames."""
    found = []
    for number in range(4):
        name = f"consistency.frame{number}"
        second, label = golden[f"{name}.p2"], golden[f"{name}.y2"]
        if protocol == "aligned":
            found.append(pair_counts(golden[f"{name}.p12"], second, label, 9, label < 9))
        else:
            found.append(pair_counts(golden[f"{name}.p1"], second, label, 9))
    return found


@pytest.mark.parametrize(("protocol", "union"), [("release", ca_released), ("aligned", ca)])
def test_each_frame_is_equal_to_the_reference(golden: Any, protocol: str, union) -> None:
    for number, counts in enumerate(frames_of(golden, protocol)):
        for name, score in (("tc", tc), ("ca", union)):
            stored = golden[f"consistency.frame{number}.{protocol}.{name}_intersection_union"]
            # Counts of both are below 3072: equal quotients in this precision are equal counts.
            expected = np.divide(*stored, out=np.full(9, np.nan), where=stored[1] > 0)
            np.testing.assert_allclose(score(counts, "exclude"), expected, rtol=1e-14)


def test_all_frames_are_equal_to_the_release(golden: Any) -> None:
    counts = sum(frames_of(golden, "release"))
    for name, score in (("tc", tc), ("ca", ca_released)):
        found = score(counts, "released")
        # 1e-10 in the released denominator moves the quotient by less than 1e-12.
        expected = golden[f"consistency.release.{name}_per_class"]
        np.testing.assert_allclose(found, expected, atol=1e-12, rtol=0)
        mean = golden[f"consistency.release.{name}_mean"]
        assert class_mean(found, None) == pytest.approx(float(mean), abs=1e-12)


def test_all_frames_are_equal_to_the_aligned_reference(golden: Any) -> None:
    counts = sum(frames_of(golden, "aligned"))
    for name, score in (("tc", tc), ("ca", ca)):
        found = score(counts, "exclude")
        expected = golden[f"consistency.aligned.{name}_per_class"]
        np.testing.assert_allclose(found, expected, atol=1e-12, rtol=0)
        mean = golden[f"consistency.aligned.{name}_mean_present"]
        assert class_mean(found, None) == pytest.approx(float(mean), abs=1e-12)


# Names.


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_the_protocol_is_read_from_the_partition(protocol) -> None:
    assert protocol_of(partition_name(protocol, 3)) == protocol
    assert file_name(protocol, "val") == f"evaluations/consistency_{protocol}_val.npz"
    assert HEADLINES[protocol][0] == ("flicker" if protocol == "triples" else "TC")


@pytest.mark.parametrize("partition", ["ring5", "ring9_released_3_4", "vertical3", "aligned", ""])
def test_regions_are_no_protocol(partition: str) -> None:
    assert protocol_of(partition) is None


# Changes along the motion.


def test_warping_error_by_hand() -> None:
    first = np.array([[0, 0, 1, 1], [2, 2, 2, 0]])
    second = np.array([[0, 1, 1, 0], [2, 2, 1, 0]])
    label = np.full((2, 4), 255)
    valid = np.array([[1, 1, 1, 1], [1, 1, 1, 0]], bool)
    counts = pair_counts(first, second, label, 3, valid)
    part, every = changed(counts)
    assert part.tolist() == [1, 1, 1]  # of the classes 0, 1 and 2 of the first frame
    assert every.tolist() == [2, 2, 3]
    part, every = changed(np.concatenate([counts, counts]))  # two sets of views
    assert (part.sum(), every.sum()) == (6, 14)


def test_flicker_by_hand() -> None:
    frames = np.array(
        [
            [[0, 0, 1, 1, 2, 2]],  # A
            [[1, 0, 1, 2, 0, 1]],  # B
            [[0, 0, 1, 1, 1, 2]],  # C
        ]
    )
    valid = np.array([[1, 1, 1, 1, 1, 0]], bool)
    part, every = flickered(pair_counts(frames[1], frames[2], frames[0], 3, valid))
    # Pixels 0 and 3 change and change back; pixel 4 changes twice; pixel 5 does not count.
    assert part.tolist() == [1, 1, 0]
    assert every.tolist() == [2, 2, 1]


def test_only_labelled_pixels_are_known_by_their_row() -> None:
    first = second = np.array([[0, 1, 1]])
    labels = pair_counts(first, second, np.array([[0, 1, 255]]), 2)
    assert only_labelled(labels).sum() == 2
    assert np.isnan(only_labelled(pair_counts(first, second, np.full((1, 3), 255), 2))).all()
