"""The command ``rgbt.robustness``, and ``rgbt.evaluate`` with a corruption."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest

from rgbt import evaluate, robustness
from rgbt.metrics.counts import Counts
from rgbt.metrics.scores import summary
from tests.commands import Call, Trained, short

ENTRY = robustness.entry
EVALUATE = evaluate.entry
NOISE = ("corruptions=noise:rgb", "corruption.severities=[16,64]")
MARKS = ("test_rgb", "test_thermal", "test_noise_rgb-16", "test_noise_rgb-64")


@pytest.mark.slow
def test_robustness_counts_are_those_of_evaluate(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    done = trained("+experiment=crm", *short(1))
    folder = Path(shutil.copytree(done, tmp_path / "runs" / done.name))
    code, out, err = call(ENTRY, f"run={folder}", *NOISE)
    assert code == 0, err
    place = folder / "evaluations"
    assert f"counts  {place}/" in out
    assert {path.name for path in place.iterdir()} == {
        *("robustness_test_noise_rgb.md", "robustness_test_noise_rgb.csv"),
        *(f"{mark}.npz" for mark in MARKS),
    }
    counts = {path.stem: Counts.load(path).counts for path in place.glob("*.npz")}
    clean = Counts.load(folder / "counts_test.npz")
    with (place / "robustness_test_noise_rgb.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["severity"] for line in lines] == ["0", "0", "0", "16", "64"]
    # Clean images are those that the run ended with.
    assert float(lines[0]["mIoU"]) == pytest.approx(100 * summary(clean, clean.absent)["mIoU"])
    # The same by the other command.
    words_of = {
        "test_noise_rgb-64": ("corruption=noise:rgb", "severity=64"),
        "test_thermal": ("modality=thermal",),
    }
    for mark, words in words_of.items():
        file = tmp_path / f"{mark}.npz"
        assert call(EVALUATE, f"run={folder}", f"out={file}", *words)[0] == 0
        np.testing.assert_array_equal(counts[mark], Counts.load(file).counts)
    words = ("corruption=noise", "corruption.image=rgb", "severity=16")
    before = {path: path.read_bytes() for path in place.iterdir()}
    code, out, err = call(EVALUATE, f"run={folder}", *words)
    assert code == 0, err
    assert "test_noise_rgb-16.npz (measured before)" in " ".join(out.split())
    assert {path: path.read_bytes() for path in place.iterdir()} == before
    # Over other regions beside them; twice the same run, of which nothing is made again.
    words = ("corruptions=removed:thermal", "regions=ring9", "runs_dir=" + str(tmp_path / "runs"))
    code, out, err = call(ENTRY, f"run={folder.name},{folder.name}", *words)
    assert code == 0, err
    assert out.count("thermal removed (zeroed)") == 2
    assert (place / "test_ring9_thermal_removed.npz").exists()
    assert (place / "robustness_test_ring9_thermal_removed.csv").exists()
    assert {path: path.read_bytes() for path in before} == before
