"""What a chain of day-night runs prints: upstream runs in one line, both heads, means."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rgbt.config.compose import compose
from rgbt.evaluate import entry as evaluate
from rgbt.metrics.counts import Counts
from rgbt.run import main
from rgbt.runs.specify import specify
from tests.commands import Call
from tests.data.layouts import write_freiburg


def miou(path: Path, night: bool) -> float:
    """The mIoU of day or night by hand in percent; a class without pixels is 0."""
    counts = Counts.load(path)
    assert counts.night is not None
    matrix = counts.counts[np.array(counts.night) == night].sum(axis=(0, 1)).astype(float)
    unions = matrix.sum(0) + matrix.sum(1) - matrix.diagonal()
    ious = matrix.diagonal() / np.maximum(unions, 1)
    return 100 * float(ious[:12].mean())  # the last one is void


def value_of(row: str, out: str) -> float:
    (line,) = (each for each in out.splitlines() if each.strip().startswith(f"{row} "))
    return float(line.split()[-1])


def test_day_night_run_shows_mean_and_other_head(call: Call, tmp_path: Path) -> None:
    """Of two stages; the first one needs no teacher."""
    words = [
        *("+experiment=multi_head_night", "+debug=smoke", "dataset=freiburg", "tracking=none"),
        *(f"dataset.root={write_freiburg(tmp_path / 'freiburg')}", "dataset.crop=null"),
        *("scale.critic_width=4", "trainer.accelerator=cpu", "trainer.threads=1"),
        "model.weights=experiment:multi_head_thermal_stage1/last.pt",
        f"runs_dir={tmp_path / 'runs'}",
    ]
    code, printed, err = call(main, *words)
    assert code == 0, err
    folder = specify(compose(words), words).folder
    assert printed.count("IoU by region") == 1, "of the upstream run, one line alone"
    day, night = (miou(folder / "counts_test.npz", each) for each in (False, True))
    mean = value_of("mean of day and night", printed)
    assert mean == pytest.approx((day + night) / 2, abs=0.01)
    # As rgbt evaluate predicts the night with the head of the source.
    out = tmp_path / "source.npz"
    code, _, err = call(evaluate, f"run={folder}", "head=source", f"out={out}")
    assert code == 0, err
    other = miou(out, night=True)
    assert other != pytest.approx(night)
    assert value_of("source head, night", printed) == pytest.approx(other, abs=0.01)
    stored = Counts.load(folder / "evaluations" / "test_source-head.npz")
    assert np.array_equal(stored.counts, Counts.load(out).counts)
    result = json.loads((folder / "result.json").read_text())
    assert 100 * result["test"]["source_head/night/mIoU"] == pytest.approx(other)
