"""The script behind ``make gpu-check``, as far as a CPU shows it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.benchmarks.gpu_check import ROWS, in_process, main, share_of_peak
from tests.benchmarks.gpu_step import ROWS as STEPS


def on(card: str) -> dict[str, Any]:
    return {"ms a step": 100.0, "machine": {"gpus": [card]}}


def test_share_of_peak_is_that_of_the_card() -> None:
    rows = {"tf32": {"flops": 4.947e12}}  # in 0.1 s, 49.47 TFLOP/s
    card = on("NVIDIA H100 80GB HBM3")
    assert share_of_peak("tf32", card, rows) == "10.0 %"
    assert share_of_peak("bf16", card, rows) == "5.0 %"
    assert share_of_peak("tf32", card, {"tf32": {"failed": "why"}}) == "unknown"
    assert share_of_peak("tf32", on("NVIDIA T1"), rows) == "unknown"
    assert share_of_peak("tf32", {**card, "machine": {"gpus": []}}, rows) == "unknown"


def test_process_that_takes_too_long_is_stopped() -> None:
    assert in_process(["timeit", "-n", "1", "import time; time.sleep(60)"], 0.5)[0] is None
    assert in_process(["timeit", "-n", "1", "pass"], 60.0)[0] == 0


def test_rows_that_the_time_does_not_reach_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "found.json"
    assert set(ROWS) - {"tests"} == set(STEPS)
    assert main(["minutes=0", f"out={out}"]) == 0
    assert json.loads(out.read_text())["not reached"] == list(ROWS)
    assert f"Not reached in the time: {', '.join(ROWS)}." in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a card")
def test_machine_without_a_card_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([f"out={tmp_path / 'found.json'}"]) == 2
    assert "has no cuda" in capsys.readouterr().err


@pytest.mark.slow
def test_rows_of_a_tiny_network(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "found.json"
    chosen = ["tf32", "release", "tests", "loader_files", "recomputed", "not_fused"]
    words = ["device=cpu", f"out={out}", f"rows={','.join(chosen)}", f"release={tmp_path}"]
    assert main([*words, "minutes=10"]) == 1, "the folder is no checkout"
    report = json.loads(out.read_text())
    rows = report["rows"]
    assert (list(rows), report["not reached"]) == (chosen, [])
    assert list(rows["release"]) == ["failed"]
    assert rows["tests"]["outcome"].startswith("8 passed")
    measured = [rows[name] for name in chosen if name not in ("release", "tests")]
    assert all(row["images/s"] > 0 and row["batch"] == 2 for row in measured)
    losses = {rows[name]["loss"] for name in ("tf32", "recomputed", "not_fused")}
    assert len(losses) == 1, "one batch and one seed"
    # Each product of the network has a gradient for both factors, so there are many.
    assert rows["tf32"]["flops"] > 1e8
    assert rows["tf32"]["kernels"] > 1000
    assert len(rows["tf32"]["top"]) == 15
    said = capsys.readouterr().out
    assert "| the release |" not in said
    assert "| TF32, beside the release | not measured: " in said
