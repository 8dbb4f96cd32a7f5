"""Counts that are there stay, what is missing is measured beside them; what differs is named."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from analysis.figures.page import stored_pictures
from rgbt import evaluate
from rgbt.metrics.counts import Counts
from rgbt.metrics.scores import extremes
from tests.commands import Call, Trained, short
from tests.measured import measurement


def test_details_leave_the_counts_that_are_there(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    """Those of another machine may differ in single pixels."""
    done = trained("+experiment=crm", *short(2))
    run = Path(shutil.copytree(done, tmp_path / "runs" / done.name))
    own = Counts.load(run / "counts_test.npz")
    other = replace(own, counts=own.counts[..., ::-1])
    other.save(run / "counts_test.npz")
    for is_again in (False, True):
        code, out, err = call(evaluate.entry, f"run={run}", "details=boundary")
        assert code == 0, err
        assert ("best.png" in err) != is_again, "pictures that are missing are drawn"
        name, _, _ = stored_pictures(run / "figures" / "best.png")
        assert name == extremes(other)["best"][0]
        kept = Counts.load(run / "counts_test.npz")
        assert np.array_equal(kept.counts, other.counts)
        assert [path.name for path in (run / "evaluations").iterdir()] == [
            "test_ring5-boundary-0.02.npz"
        ]
    assert "(measured before)" in out


def test_every_difference_counts_between_measurements_of_one_network() -> None:
    """Of two networks, each may be tested on other regions as it is trained."""
    test, val = (measurement(run="a", split=split) for split in ("test", "val"))
    rings = replace(val, partition="ring9")
    assert test.unlike(val) == ("split: test, val",)
    assert test.unlike(rings) == ("partition: ring5, ring9", "split: test, val")
    assert test.unlike(replace(rings, run="b")) == ()
    weights = replace(rings, run="", weights="ab" * 32)
    assert weights.unlike(replace(test, run="", weights="ab" * 32)) == (
        *("partition: ring9, ring5", "split: val, test"),
    )
    assert weights.unlike(replace(test, run="", weights="cd" * 32)) == ()
