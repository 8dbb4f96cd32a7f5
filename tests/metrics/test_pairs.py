"""TC and CA by hand, by sets of pixels, and against the released evaluation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rgbt.metrics import pairs
from rgbt.metrics.counting import pair_counts
from rgbt.metrics.pairs import ca, ca_released, frames, tc, triples
from rgbt.metrics.scores import class_mean
from tests.models.golden import FOLDER

GOLDEN = FOLDER / "losses.npz"

FIRST = np.array([[0, 1, 1, 2], [2, 2, 0, 0]], np.uint8)
SECOND = np.array([[0, 1, 2, 2], [2, 1, 0, 1]], np.uint8)
LABEL = np.array([[0, 1, 2, 2], [1, 2, 0, 1]], np.uint8)


@pytest.mark.parametrize("absent", ["released", "exclude"])
def test_scores_by_hand(absent: Any) -> None:
    counts = pair_counts(FIRST, SECOND, LABEL, 3)
    np.testing.assert_allclose(tc(frames(counts), absent), [2 / 3, 1 / 4, 2 / 4])
    np.testing.assert_allclose(ca(triples(counts), absent), [2 / 3, 1 / 5, 1 / 4])
    np.testing.assert_allclose(ca_released(triples(counts), absent), [2 / 3, 1 / 6, 1 / 7])


@pytest.mark.parametrize("masked", [False, True])
def test_equal_to_sets_of_pixels(masked: bool) -> None:
    """Predictions often agree with each other and the label, which has gaps."""
    rng, hw = np.random.default_rng(0), (23, 31)
    label = rng.integers(0, 9, hw).astype(np.uint8)
    first = np.where(rng.random(hw) < 0.7, label, rng.integers(0, 9, hw)).astype(np.uint8)
    second = np.where(rng.random(hw) < 0.7, first, rng.integers(0, 9, hw)).astype(np.uint8)
    label[rng.random(hw) < 0.1] = 255
    chosen = (rng.random(hw) < 0.8) & (label < 9) if masked else np.ones(hw, bool)
    counts = pair_counts(first, second, label, 9, chosen if masked else None)
    three = triples(counts)
    found = [tc(frames(counts), "exclude"), ca(three, "exclude"), ca_released(three, "exclude")]
    for number in range(9):
        one, two, truth = (
            set(np.flatnonzero((classes == number) & chosen)) for classes in (first, second, label)
        )
        alike = len(one & two & truth)
        coded = len(one) + len(two) + len(truth) - 2 * alike
        shares = len(one & two) / len(one | two), alike / len(one | two | truth), alike / coded
        assert [score[number] for score in found] == pytest.approx(list(shares))


@pytest.mark.parametrize(("absent", "expected"), [("released", 1 / 3), ("exclude", 1 / 2)])
def test_the_mean_is_over_sets_not_over_their_pixels(absent: Any, expected: float) -> None:
    # Class 0: alike in 1 of 1 pixel, in 0 of 9, and in the third set nowhere. Pooled: 1 / 10.
    one, none = np.zeros((1, 1), np.uint8), np.zeros((1, 9), np.uint8)
    sets = [
        pair_counts(one, one, one, 2),
        pair_counts(none, none + 1, none, 2),
        pair_counts(none + 1, none + 1, none + 1, 2),
    ]
    counts = np.concatenate(sets)
    assert tc(frames(counts), absent)[0] == pytest.approx(expected)
    assert ca(triples(counts), absent)[0] == pytest.approx(expected)
    assert tc(frames(sum(sets)), absent)[0] == pytest.approx(1 / 10)
    with pytest.raises(ValueError, match="expected S x 3 rows, got 8"):
        frames(counts[1:])


@pytest.mark.skipif(not GOLDEN.exists(), reason="reference material is not beside the checkout")
@pytest.mark.parametrize(
    ("protocol", "union", "absent", "mean"),
    [("release", ca_released, "released", "mean"), ("aligned", ca, "exclude", "mean_present")],
)
def test_equal_to_the_released_evaluation(protocol: str, union, absent: Any, mean: str) -> None:
    golden, every = np.load(GOLDEN), []
    for number in range(4):
        name = f"consistency.frame{number}"
        second, label = golden[f"{name}.p2"], golden[f"{name}.y2"]
        first, valid = golden[f"{name}.p1"], None
        if protocol == "aligned":
            first, valid = golden[f"{name}.p12"], label < 9
        every.append(pair_counts(first, second, label, 9, valid))
        for key, sums, score in (("tc", frames, tc), ("ca", triples, union)):
            stored = golden[f"{name}.{protocol}.{key}_intersection_union"]
            # Counts of both are below 3072: equal quotients in this precision are equal counts.
            expected = np.divide(*stored, out=np.full(9, np.nan), where=stored[1] > 0)
            found = score(sums(every[-1]), "exclude")
            np.testing.assert_allclose(found, expected, rtol=1e-14)
    for key, sums, score in (("tc", frames, tc), ("ca", triples, union)):
        found = score(sums(sum(every)), absent)
        # 1e-10 in the released denominator moves the quotient by less than 1e-12.
        expected = golden[f"consistency.{protocol}.{key}_per_class"]
        np.testing.assert_allclose(found, expected, atol=1e-12, rtol=0)
        stored = float(golden[f"consistency.{protocol}.{key}_{mean}"])
        assert class_mean(found, None) == pytest.approx(stored, abs=1e-12)


def test_the_protocol_is_read_from_the_partition() -> None:
    for protocol in pairs.PROTOCOLS:
        for views in ("", "1c0ffe"):
            assert pairs.protocol_of(pairs.partition_name(protocol, 3, views)) == protocol
    assert pairs.partition_name("next", 1, "1c0ffe") == "next1-1c0ffe"
    for partition in ("ring5", "ring9_released_3_4", "vertical3", "aligned", ""):
        assert pairs.protocol_of(partition) is None


def test_warping_error_by_hand() -> None:
    first = np.array([[0, 0, 1, 1], [2, 2, 2, 0]])
    second = np.array([[0, 1, 1, 0], [2, 2, 1, 0]])
    label = np.full((2, 4), 255)
    valid = np.array([[1, 1, 1, 1], [1, 1, 1, 0]], bool)
    counts = pair_counts(first, second, label, 3, valid)
    part, every = pairs.changed(np.concatenate([counts, counts]))  # two sets of views
    assert part.tolist() == [2, 2, 2]  # of the classes 0, 1 and 2 of the first frame
    assert every.tolist() == [4, 4, 6]


def test_flicker_by_hand() -> None:
    a, b, c = np.array([[[0, 0, 1, 1, 2, 2]], [[1, 0, 1, 2, 0, 1]], [[0, 0, 1, 1, 1, 2]]])
    valid = np.array([[1, 1, 1, 1, 1, 0]], bool)
    part, every = pairs.flickered(pair_counts(b, c, a, 3, valid))
    # Pixels 0 and 3 change and change back; pixel 4 changes twice; pixel 5 does not count.
    assert part.tolist() == [1, 1, 0]
    assert every.tolist() == [2, 2, 1]
