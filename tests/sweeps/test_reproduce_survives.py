"""A table is run by a real command, killed in the middle, and gone on with by the same command."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sweeps.reproduce import entry
from tests.commands import SMALL, Call, short

ROOT = Path(__file__).resolve().parents[2]
TABLE = """
paper: my
number: ablation
caption: Three widths.
data: noise
unit: percent
columns:
  - {name: mIoU, metric: mIoU}
  - {name: thermal, metric: mIoU, modality: thermal}
rows:
  - {label: wide, experiment: grbm, overrides: [masker.sigma_div=1], values: {mIoU: 40.0}}
  - {label: narrow, experiment: grbm, overrides: [masker.sigma_div=4], values: {mIoU: 41.0}}
  - {label: between, experiment: grbm, overrides: [masker.sigma_div=2], values: {mIoU: 42.0}}
  - {label: wrong, experiment: grbm, overrides: [masker.sigma_div=0]}
"""
GATED = """
import time
from pathlib import Path

from rgbt.schemes.crm import CRM

GATE = Path(__file__).with_name("gate")


class Gated(CRM):
    'Two steps, of which there is a checkpoint, and no more until the gate is open.'

    steps = 0

    def phases(self, batch, generator_of):
        end = time.monotonic() + 120
        while self.steps == 2 and not GATE.exists() and time.monotonic() < end:
            time.sleep(0.01)
        self.steps += 1
        yield from super().phases(batch, generator_of)
"""


def command(table: Path, data: Path, runs: Path) -> list[str]:
    return [
        *(sys.executable, "-m", "sweeps.reproduce", f"table={table}", "workers=2"),
        *(f"runs_dir={runs}", "dataset=mfnet", f"dataset.root={data}", *SMALL, *short(4)),
        *("tracking=none", "scheme._target_=gated.Gated"),
    ]


def processes_in(runs: Path) -> list[int]:
    """Numbers of the processes that train now."""
    found = []
    for lock in runs.glob("*/lock"):
        match = re.match(r"process (\d+)", lock.read_text())
        if match and not (lock.parent / "result.json").exists():
            found.append(int(match.group(1)))
    return found


def table_of(runs: Path) -> str:
    (file,) = (runs / "tables" / "my").glob("ablation_demo-*/table.md")
    return file.read_text()


@pytest.mark.slow
def test_reproduce_killed_and_rerun_repeats_no_run(
    call: Call, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table, runs = tmp_path / "ablation.yaml", tmp_path / "runs"
    table.write_text(TABLE)
    (tmp_path / "gated.py").write_text(GATED)
    words = command(table, data, runs)
    env = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}
    first = subprocess.Popen(
        words, env=env, start_new_session=True, stderr=subprocess.PIPE, text=True
    )
    end = time.monotonic() + 120
    while len(list(runs.glob("*/last.pt"))) < 2:
        assert first.poll() is None, first.stderr and first.stderr.read()
        assert time.monotonic() < end
        time.sleep(0.05)
    running = processes_in(runs)
    assert len(running) == 2
    os.killpg(first.pid, signal.SIGKILL)
    # One of the two is left alone, as if only the driver had died; the other dies as at a reboot.
    os.killpg(running[0], signal.SIGKILL)
    first.wait()
    (tmp_path / "gate").touch()

    again = subprocess.run(words, env=env, capture_output=True, text=True, timeout=240)
    assert again.returncode == 1, again.stderr[-3000:]  # the row that is wrong
    finished = sorted(path.parent for path in runs.glob("*/result.json"))
    assert len(finished) == 3
    starts = [len(json.loads((run / "provenance.json").read_text())) for run in finished]
    # Only what was killed was begun twice; it went on from its checkpoint.
    assert sorted(starts) == [1, 1, 2]
    text = table_of(runs)
    assert "'masker.sigma_div' must be a number from 0.001" in text

    monkeypatch.syspath_prepend(tmp_path)
    assert call(entry, *words[3:])[0] == 1
    assert [len(json.loads((run / "provenance.json").read_text())) for run in finished] == starts
    assert table_of(runs) == text
