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

from tests.commands import SMALL, short

TABLE = """
paper: my
number: ablation
caption: Two widths.
data: noise
unit: percent
columns:
  - {name: mIoU, metric: mIoU}
  - {name: thermal, metric: mIoU, modality: thermal}
rows:
  - {label: wide, experiment: grbm, overrides: [masker.sigma_div=1], values: {mIoU: 40.0}}
  - {label: narrow, experiment: grbm, overrides: [masker.sigma_div=4], values: {mIoU: 41.0}}
  - {label: wrong, experiment: grbm, overrides: [masker.sigma_div=0]}
"""


def command(table: Path, data: Path, runs: Path) -> list[str]:
    return [
        *(sys.executable, "-m", "sweeps.reproduce", f"table={table}", "seeds=2", "workers=2"),
        *(f"runs_dir={runs}", "dataset=mfnet", f"dataset.root={data}", *SMALL, *short(24)),
        "tracking=none",
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


def test_killed_and_called_again_loses_nothing_and_runs_nothing_twice(
    data: Path, tmp_path: Path
) -> None:
    table, runs = tmp_path / "ablation.yaml", tmp_path / "runs"
    table.write_text(TABLE)
    words = command(table, data, runs)
    first = subprocess.Popen(words, start_new_session=True, stderr=subprocess.PIPE, text=True)
    end = time.monotonic() + 120
    while not list(runs.glob("*/last.pt")):
        assert first.poll() is None, first.stderr and first.stderr.read()
        assert time.monotonic() < end
        time.sleep(0.05)
    running = processes_in(runs)
    assert running
    os.killpg(first.pid, signal.SIGKILL)
    # One of the two is left alone, as if only the driver had died; the other dies as at a reboot.
    os.killpg(running[0], signal.SIGKILL)
    first.wait()

    again = subprocess.run(words, capture_output=True, text=True, timeout=240)
    assert again.returncode == 1, again.stderr[-3000:]  # the row that is wrong
    finished = sorted(path.parent for path in runs.glob("*/result.json"))
    assert len(finished) == 4
    starts = [len(json.loads((run / "provenance.json").read_text())) for run in finished]
    # Only what was killed was begun twice; it went on from its checkpoint.
    assert sorted(starts) == [1, 1, 1, 2]
    text = table_of(runs)
    assert "masker.sigma_div must be positive, got 0" in text

    third = subprocess.run(words, capture_output=True, text=True, timeout=240)
    assert third.returncode == 1
    assert [len(json.loads((run / "provenance.json").read_text())) for run in finished] == starts
    assert table_of(runs) == text
