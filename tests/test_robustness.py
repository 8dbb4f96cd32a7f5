"""The command ``rgbt.robustness``, and ``rgbt.evaluate`` with a corruption."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest

from rgbt import evaluate, robustness
from rgbt.metrics.counts import Counts
from tests.commands import Call, Trained, short

ENTRY = robustness.entry
EVALUATE = evaluate.entry
NOISE = ("corruptions=noise:rgb", "corruption.severities=[16,64]")
MARKS = ("clean", "features-rgb", "features-thermal", "noise_rgb-16", "noise_rgb-64")


@pytest.mark.slow
def test_robustness_counts_are_those_of_evaluate(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    done = trained("+experiment=crm", *short(1))
    folder = Path(shutil.copytree(done, tmp_path / "runs" / done.name))
    code, out, err = call(ENTRY, f"run={folder}", *NOISE)
    assert code == 0, err
    place = folder / "evaluations" / "robustness" / "test"
    assert f"counts  {place}/" in out
    assert {path.name for path in place.iterdir()} == {
        *("robustness_noise_rgb.md", "robustness_noise_rgb.csv"),
        *(f"{mark}.{end}" for mark in MARKS for end in ("npz", "json")),
    }
    counts = {path.stem: Counts.load(path).counts for path in place.glob("*.npz")}
    np.testing.assert_array_equal(counts["clean"], Counts.load(folder / "counts_test.npz").counts)
    with (place / "robustness_noise_rgb.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["severity"] for line in lines] == ["0", "1", "1", "16", "64"]
    # The same by the other command.
    words_of = {
        "noise_rgb-64": ("corruption=noise:rgb", "severity=64"),
        "features-thermal": ("modality=thermal",),
    }
    for mark, words in words_of.items():
        file = tmp_path / f"{mark}.npz"
        assert call(EVALUATE, f"run={folder}", f"out={file}", *words)[0] == 0
        np.testing.assert_array_equal(counts[mark], Counts.load(file).counts)
    words = ("corruption=noise", "corruption.image=rgb", "severity=16")
    assert call(EVALUATE, f"run={folder}", *words)[0] == 0
    assert (folder / "evaluations" / "mfnet_test_rgbt_ring5_noise_rgb-16.npz").exists()
    # Over other regions beside them; twice the same run, of which nothing is made again.
    words = ("corruptions=removed:thermal", "regions=ring9", "runs_dir=" + str(tmp_path / "runs"))
    code, out, err = call(ENTRY, f"run={folder.name},{folder.name}", *words)
    assert code == 0, err
    assert out.count("thermal removed (zeroed)") == 2
    assert (place.with_name("test_ring9") / "thermal_removed-1.npz").exists()
