"""A table is completed despite failures of its cells, disk, tracking server or command."""

from __future__ import annotations

import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from sweeps.reproduce import entry
from tests.commands import SMALL, Call, short

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
HEAD = """
paper: my
number: ablation
caption: Rows of a test.
data: noise
unit: percent
"""
WIDTHS = (
    HEAD
    + """\
columns:
  - {name: mIoU, metric: mIoU}
  - {name: thermal, metric: mIoU, modality: thermal}
rows:
  - {label: wide, experiment: grbm, overrides: [masker.sigma_div=1], values: {mIoU: 40.0}}
  - {label: narrow, experiment: grbm, overrides: [masker.sigma_div=4], values: {mIoU: 41.0}}
  - {label: between, experiment: grbm, overrides: [masker.sigma_div=2], values: {mIoU: 42.0}}
  - {label: wrong, experiment: grbm, overrides: [masker.sigma_div=0]}
"""
)
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
BROKEN = """
import os
import signal

import torch

from rgbt.schemes.supervised import Supervised


class Raises(Supervised):
    def phases(self, batch, generator_of):
        raise RuntimeError("the loss has no shape for this")


class Dies(Supervised):
    def phases(self, batch, generator_of):
        os.kill(os.getpid(), signal.SIGSEGV)


class Eats(Supervised):
    def phases(self, batch, generator_of):
        torch.ones(2**36)
"""
BREAKING = (
    HEAD
    + """\
columns: [{name: mIoU, metric: mIoU}]
rows:
  - {label: good, experiment: baseline}
  - {label: raises, experiment: baseline, overrides: [scheme._target_=broken.Raises]}
  - {label: dies, experiment: baseline, overrides: [scheme._target_=broken.Dies]}
  - {label: eats, experiment: baseline, overrides: [scheme._target_=broken.Eats]}
"""
)
UNMASKED = tuple(word for word in SMALL if not word.startswith("masker."))
MEMORY = 24 * 2**30
"""Bytes of address space; the cell that eats asks for 256 GiB."""


@pytest.fixture
def full_disk(tmp_path: Path) -> Iterator[Path]:
    """A folder on a disk of 64 kB."""
    place = tmp_path / "full"
    place.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(place)]
    if os.getuid() != 0 or subprocess.run(words, capture_output=True).returncode != 0:
        pytest.skip("a small disk can only be mounted by root")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def environment(place: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": f"{place}{os.pathsep}{ROOT}"}


def command(place: Path, text: str, data: Path, *words: str) -> list[str]:
    """The command that makes a table, whose rows may name modules of `place`."""
    (place / "ablation.yaml").write_text(text)
    (place / "broken.py").write_text(BROKEN)
    (place / "gated.py").write_text(GATED)
    return [
        *(sys.executable, "-m", "sweeps.reproduce", f"table={place / 'ablation.yaml'}"),
        *("workers=2", "dataset=mfnet", f"dataset.root={data}", *words),
    ]


def table_of(runs: Path) -> str:
    (file,) = (runs / "tables" / "my").glob("ablation_demo-*/table.md")
    return file.read_text()


def breaking(place: Path, data: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a table whose rows break; its cells say why, and its command shows no traceback."""
    done = subprocess.run(
        command(place, BREAKING, data, *UNMASKED, *short(2), *words),
        env=environment(place),
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY)),
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 1, done.stderr[-3000:]
    assert "Traceback" not in done.stderr
    return done


def test_failed_cells_have_a_reason(data: Path, tmp_path: Path, full_disk: Path) -> None:
    runs = tmp_path / "runs"
    done = breaking(tmp_path, data, f"runs_dir={runs}", f"tracking.artifact_uri={full_disk}")
    text = table_of(runs)
    for word in ("the loss has no shape for this", "SIGSEGV", "memory"):
        assert word in text
    assert len(list(runs.glob("*/result.json"))) == 1
    assert "No space left on device" in done.stderr + "".join(
        path.read_text() for path in (runs / ".logs").iterdir()
    )


def test_server_that_is_away_costs_a_line(data: Path, tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    done = breaking(tmp_path, data, f"runs_dir={runs}", "tracking.uri=http://127.0.0.1:9")
    assert "the loss has no shape for this" in table_of(runs)
    assert len(list(runs.glob("*/result.json"))) == 1
    assert "MLflow cannot be used" in done.stderr


def test_full_disk_is_reason_of_cell(data: Path, tmp_path: Path, full_disk: Path) -> None:
    words = (f"storage={tmp_path / 'studies.journal'}", f"out={tmp_path / 'out'}", "tracking=none")
    breaking(tmp_path, data, f"runs_dir={full_disk}", *words)
    text = (tmp_path / "out" / "table.md").read_text()
    assert f"the disk of {full_disk / '.logs'} is full" in text


def processes_in(runs: Path) -> list[int]:
    """Numbers of the processes that train now."""
    found = []
    for lock in runs.glob("*/lock"):
        match = re.match(r"process (\d+)", lock.read_text())
        if match and not (lock.parent / "result.json").exists():
            found.append(int(match.group(1)))
    return found


def test_killed_command_is_resumed_by_the_same_command(
    call: Call, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = tmp_path / "runs"
    gated = (f"runs_dir={runs}", *SMALL, *short(4), "tracking=none", "scheme._target_=gated.Gated")
    words = command(tmp_path, WIDTHS, data, *gated)
    env = environment(tmp_path)
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
    assert "'masker.sigma_div'" in text

    monkeypatch.syspath_prepend(tmp_path)
    assert call(entry, *words[3:])[0] == 1
    assert [len(json.loads((run / "provenance.json").read_text())) for run in finished] == starts
    assert table_of(runs) == text
