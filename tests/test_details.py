"""``rgbt evaluate modality=all details=...`` and ``rgbt details``, as a user calls them."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from analysis import details
from rgbt import evaluate
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from tests.commands import Call, assert_one_sentence, only_run, short, train


def test_details_of_every_input_are_stored_and_shown_again(
    call: Call, data: Path, tmp_path: Path
) -> None:
    code, _, err = train(call, data, tmp_path, "+experiment=crm", *short(1))
    assert code == 0, err
    folder = only_run(tmp_path)

    code, _, err = call(details.entry, f"run={folder}")
    assert code == 2
    assert_one_sentence(err, "modality=all details=boundary")

    words = (f"run={folder}", "modality=all", "details=[boundary,calibration]")
    code, out, err = call(evaluate.entry, *words)
    assert code == 0, err
    stem = folder / "evaluations" / "mfnet_test"
    for view in ("rgbt", "rgb", "thermal"):
        assert f"{view}: Boundary IoU in percent, width 2 % of the image diagonal" in out
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
    assert float(found["", "rgb", "mIoU"]["value"]) >= 0

    code, _, err = call(evaluate.entry, *words, f"out={tmp_path / 'x.npz'}")
    assert code == 2
    assert_one_sentence(err, "modality=all makes several; omit out=")
    code, _, err = call(evaluate.entry, f"run={folder}", "details=distance")
    assert code == 2
    assert_one_sentence(err, "mfnet has no maps of distance and objects")
