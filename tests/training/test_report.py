"""What a run prints before its first step, and the result of a finished run, without torch."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from rgbt.requirements import NetworkRecord, TransformRecord
from rgbt.run import main
from rgbt.training.report import _memory_lines, device_line
from sweeps.plan.planner import specify_run
from tests.commands import Call, Trained, short, words_of

ROOT = Path(__file__).resolve().parents[2]


SCRIPT = """
import runpy, sys
try:
    runpy.run_module("rgbt.run", run_name="__main__", alter_sys=True)
except SystemExit as left:
    assert not left.code, left.code
heavy = {"torch", "mlflow", "sqlalchemy", "pandas", "scipy", "matplotlib", "lightning_fabric"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
"""


@pytest.fixture
def words(trained: Trained, data: Path, tmp_path: Path) -> list[str]:
    """Arguments that request a finished run in `tmp_path`."""
    overrides = ("+experiment=crm", *short(1))
    done = trained(*overrides)
    shutil.copytree(done, tmp_path / "runs" / done.name)
    return words_of(data, tmp_path / "runs", *overrides)


def test_a_finished_run_is_shown_without_torch_and_mlflow(words: list[str]) -> None:
    command = [sys.executable, "-c", SCRIPT, *words, "data.num_workers=1", "name=other"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert "is already finished" in done.stderr
    assert "mIoU" in done.stdout


@pytest.mark.parametrize(("batch_size", "fits"), [(14, True), (40, False)])
def test_memory_of_a_gpu_is_compared_with_a_step(
    batch_size: int, fits: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Swin-S with CRM needs 39 GB at batch 14, as counted, and 106 GB at batch 40."""
    run = specify_run(("+experiment=crm", "scale=paper"), checked=False)
    network = SimpleNamespace(record=NetworkRecord(recomputed=("blocks",)))
    session: Any = SimpleNamespace(
        spec=run,
        device=torch.device("cuda"),
        loading=SimpleNamespace(batch_size=batch_size),
        trainer=run.trainer,
        model=network,
        transform=SimpleNamespace(record=TransformRecord()),
    )
    setup: Any = SimpleNamespace(session=session)
    card = SimpleNamespace(total_memory=85e9)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: card)
    needed = "39" if fits else "106"
    assert _memory_lines(setup) == [("memory", f"about {needed} GB of 85 GB")]
    said = capsys.readouterr().err
    assert ("trainer.activation_checkpointing=true" in said) != fits
    session.device = torch.device("cpu")
    assert _memory_lines(setup) == []


def test_a_finished_run_is_compared_with_the_present_files(
    call: Call, words: list[str], data: Path
) -> None:
    shutil.copy(data / "labels" / "00101D.png", data / "labels" / "00201D.png")
    assert "trained on other files of the data set" in call(main, *words)[2]
    shutil.rmtree(data)
    code, out, err = call(main, *words)
    assert (code, "mIoU" in out) == (0, True)
    assert "other files" not in err, "a result can be shown without its data"


def test_device_line_names_the_precision_of_products_on_cuda(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "H100")
    trainer = SimpleNamespace(precision="bf16-mixed", matmul_precision="high")
    lines = []
    for name in ("cuda", "cpu"):
        session: Any = SimpleNamespace(device=torch.device(name), trainer=trainer)
        lines.append(device_line(session))
    assert lines[0].startswith("cuda (H100), ")
    assert lines[0].endswith(", bf16-mixed, matmul_precision=high")
    assert lines[1].endswith(", bf16-mixed")
