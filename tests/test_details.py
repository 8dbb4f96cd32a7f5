"""``rgbt evaluate modality=all details=...`` and ``rgbt details``, as a user calls them."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import numpy as np

from analysis import details
from rgbt import evaluate
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from tests.commands import Call, Trained, assert_one_sentence, short


def test_details_of_every_input_are_stored_and_shown_again(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    done = trained("+experiment=crm", *short(1))
    folder = Path(shutil.copytree(done, tmp_path / done.name))

    code, _, err = call(details.entry, f"run={folder}")
    assert code == 2
    assert_one_sentence(err, "modality=all details=boundary")

    words = (f"run={folder}", "modality=all", "details=[boundary,calibration]")
    code, out, err = call(evaluate.entry, *words)
    assert code == 0, err
    stem = folder / "evaluations" / "mfnet_test"
    for view in ("rgbt", "rgb", "thermal"):
        for kind, partition in (
            ("", "ring5"),
            ("-boundary", "ring5-boundary-0.02"),
            ("-calibration", "ring5-calibration-15"),
        ):
            assert Counts.load(Path(f"{stem}_{view}_ring5{kind}.npz")).partition == partition
    assert "mIoU in percent by region and input" in out
    plain = Counts.load(Path(f"{stem}_rgbt_ring5.npz"))
    assert np.array_equal(plain.counts, Counts.load(folder / "counts_test.npz").counts)

    code, out, err = call(details.entry, f"run={folder}", f"out={tmp_path / 'shown'}")
    assert code == 0, err
    assert "mIoU in percent by region and input (ring5)" in out
    lines = list(csv.DictReader((tmp_path / "shown" / "details.csv").open()))
    found = {(row["details"], row["input"], row["metric"]): row for row in lines}
    boundary = Counts.load(Path(f"{stem}_thermal_ring5-boundary.npz"))
    row = found["boundary", "thermal", "boundary_mIoU"]
    assert float(row["value"]) == value("boundary_mIoU", boundary, "released")
    assert (row["low"], row["high"]) == ("", "")  # 3 images have no interval

    refused = ((*words, f"out={tmp_path / 'x.npz'}"), (f"run={folder}", "details=distance"))
    for each, key in zip(refused, ("out=", "details=distance"), strict=True):
        code, _, err = call(evaluate.entry, *each)
        assert code == 2
        assert_one_sentence(err, key)
