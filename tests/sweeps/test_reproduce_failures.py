"""A table comes whatever happens to its cells, its disk or its tracking server."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.commands import SMALL, short

pytestmark = pytest.mark.slow

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
TABLE = """
paper: my
number: ablation
caption: What may go wrong.
data: noise
unit: percent
columns: [{name: mIoU, metric: mIoU}]
rows:
  - {label: good, experiment: baseline}
  - {label: raises, experiment: baseline, overrides: [scheme._target_=broken.Raises]}
  - {label: dies, experiment: baseline, overrides: [scheme._target_=broken.Dies]}
  - {label: eats, experiment: baseline, overrides: [scheme._target_=broken.Eats]}
"""
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


def reproduce(place: Path, data: Path, *words: str) -> subprocess.CompletedProcess[str]:
    (place / "broken.py").write_text(BROKEN)
    table = place / "ablation.yaml"
    table.write_text(TABLE)
    command = [
        *(sys.executable, "-m", "sweeps.reproduce", f"table={table}", "workers=2"),
        *("dataset=mfnet", f"dataset.root={data}", *UNMASKED, *short(2), *words),
    ]
    return subprocess.run(
        command,
        env={**os.environ, "PYTHONPATH": f"{place}{os.pathsep}{Path.cwd()}"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY)),
        capture_output=True,
        text=True,
        timeout=300,
    )


def table_of(runs: Path) -> str:
    (file,) = (runs / "tables" / "my").glob("ablation_demo-*/table.md")
    return file.read_text()


def test_cells_that_raise_die_and_eat_memory_say_why(
    data: Path, tmp_path: Path, full_disk: Path
) -> None:
    runs = tmp_path / "runs"
    done = reproduce(tmp_path, data, f"runs_dir={runs}", f"tracking.artifact_uri={full_disk}")
    assert done.returncode == 1, done.stderr[-3000:]
    text = table_of(runs)
    assert "the loss has no shape for this" in text
    assert "SIGSEGV" in text
    assert "memory" in text
    assert len(list(runs.glob("*/result.json"))) == 1
    assert "No space left on device" in done.stderr + "".join(
        path.read_text() for path in (runs / ".logs").iterdir()
    )
    assert "Traceback" not in done.stderr


def test_a_server_that_is_away_costs_a_line(data: Path, tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    done = reproduce(tmp_path, data, f"runs_dir={runs}", "tracking.uri=http://127.0.0.1:9")
    assert done.returncode == 1, done.stderr[-3000:]
    assert "the loss has no shape for this" in table_of(runs)
    assert len(list(runs.glob("*/result.json"))) == 1
    assert "MLflow cannot be used" in done.stderr
    assert "Traceback" not in done.stderr


def test_reproduce_full_disk_is_reason_of_cell(data: Path, tmp_path: Path, full_disk: Path) -> None:
    storage = f"storage={tmp_path / 'studies.journal'}"
    done = reproduce(
        *(tmp_path, data, f"runs_dir={full_disk}", storage, f"out={tmp_path / 'out'}"),
        "tracking=none",
    )
    assert done.returncode == 1, done.stderr[-3000:]
    assert (
        f"the disk of {full_disk / '.logs'} is full" in (tmp_path / "out" / "table.md").read_text()
    )
    assert "Traceback" not in done.stderr
