"""``rgbt evaluate modality=all details=...`` and ``rgbt details``, as a user calls them."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

from analysis import details
from rgbt import evaluate
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from rgbt.runs.result import RunResult
from tests.commands import Call, Trained, assert_one_sentence, short


def test_details_of_every_input_are_stored_and_shown_again(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    done = trained("+experiment=crm", *short(1))
    folder = Path(shutil.copytree(done, tmp_path / done.name))

    code, _, err = call(details.entry, f"run={folder}")
    assert code == 2
    assert_one_sentence(err, "modality=all details=boundary")

    before = (folder / "counts_test.npz").read_bytes()
    words = (f"run={folder}", "modality=all", "details=[boundary,calibration]")
    code, out, err = call(evaluate.entry, *words)
    assert code == 0, err
    stored = {
        (path, of.view, of.partition) for path, of in RunResult(folder).measurements().items()
    }
    expected = {("counts_test.npz", "rgbt", "ring5"), ("counts_val.npz", "rgbt", "ring5")}
    expected |= {(f"evaluations/test_{view}.npz", view, "ring5") for view in ("rgb", "thermal")}
    for view, begin in (("rgbt", ""), ("rgb", "rgb_"), ("thermal", "thermal_")):
        for partition in ("ring5-boundary-0.02", "ring5-calibration-15"):
            expected.add((f"evaluations/test_{begin}{partition}.npz", view, partition))
    assert stored == expected
    assert "mIoU in percent by region and input" in out
    assert "counts_test.npz (measured before)" not in " ".join(out.split()), "for its details"
    assert (folder / "counts_test.npz").read_bytes() == before
    code, out, err = call(evaluate.entry, *words)
    assert code == 0, err
    assert out.count("(measured before)") == 3

    code, out, err = call(details.entry, f"run={folder}", f"out={tmp_path / 'shown'}")
    assert code == 0, err
    assert "mIoU in percent by region and input (ring5)" in out
    lines = list(csv.DictReader((tmp_path / "shown" / "details.csv").open()))
    found = {(row["details"], row["input"], row["metric"]): row for row in lines}
    boundary = Counts.load(folder / "evaluations" / "test_thermal_ring5-boundary-0.02.npz")
    row = found["boundary", "thermal", "boundary_mIoU"]
    assert float(row["value"]) == value("boundary_mIoU", boundary, "released")
    assert (row["low"], row["high"]) == ("", "")  # 3 images have no interval

    refused = ((*words, f"out={tmp_path / 'x.npz'}"), (f"run={folder}", "details=distance"))
    for given, key in zip(refused, ("out=", "details=distance"), strict=True):
        code, _, err = call(evaluate.entry, *given)
        assert code == 2
        assert_one_sentence(err, key)
