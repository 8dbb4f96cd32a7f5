"""A table is completed despite failures of its cells, which say why."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from tests.commands import SMALL, short

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
MEMORY = 24 * 2**30
"""Bytes of address space; the cell that eats asks for 256 GiB."""

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
BREAKING = """
paper: my
number: ablation
caption: Rows of a test.
data: noise
columns: [{name: mIoU, metric: mIoU}]
rows:
  - {label: good, experiment: baseline}
  - {label: raises, experiment: baseline, overrides: [scheme._target_=broken.Raises]}
  - {label: dies, experiment: baseline, overrides: [scheme._target_=broken.Dies]}
  - {label: eats, experiment: baseline, overrides: [scheme._target_=broken.Eats]}
"""


def test_failed_cells_have_a_reason_and_cost_nothing_else(data: Path, tmp_path: Path) -> None:
    (tmp_path / "ablation.yaml").write_text(BREAKING)
    (tmp_path / "broken.py").write_text(BROKEN)
    runs = tmp_path / "runs"
    place = (f"dataset.root={data}", f"runs_dir={runs}", "tracking=none")
    small = [word for word in SMALL if not word.startswith("masker.")]
    table = f"table={tmp_path / 'ablation.yaml'}"
    words = (table, "workers=2", "dataset=mfnet", *place, *small, *short(2))
    done = subprocess.run(
        [sys.executable, "-m", "sweeps.reproduce", *words],
        env={**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY)),
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 1, done.stderr[-3000:]
    assert "Traceback" not in done.stderr
    (file,) = (runs / "tables" / "my").glob("ablation_demo-*/table.md")
    for word in ("the loss has no shape for this", "SIGSEGV", "memory"):
        assert word in file.read_text()
    assert len(list(runs.glob("*/result.json"))) == 1
