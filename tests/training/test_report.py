"""What a run prints before its first step, and the result of a finished run, without torch."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from dataclasses import replace as changed
from pathlib import Path

import pytest
import torch

from rgbt.assembly.training_setup import set_up_training
from rgbt.run import main
from rgbt.training.report import announce_network, announce_training, network_line
from tests.commands import Call, Trained, short, words_of
from tests.composed import specified

ROOT = Path(__file__).resolve().parents[2]
WORDS = (
    *("+experiment=mfnet", "dataset.num_train=3", "dataset.num_val=2", "dataset.num_test=4"),
    *("dataset.height=48", "dataset.width=64", "trainer.accelerator=cpu", "data.num_workers=0"),
    *("scale.batch_size=2", "trainer.max_steps=6", "trainer.eval_every=3", "tracking=none"),
)


def test_a_training_and_an_evaluation_say_what_they_work_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = (*WORDS, f"dataset.cache_dir={tmp_path}", f"runs_dir={tmp_path}")
    setup = set_up_training(specified(words))
    capsys.readouterr()
    announce_training(setup, "seed=0 · mfnet", Path("/runs/abc"))
    out, err = capsys.readouterr()
    name, *lines = err.splitlines()
    shown = {line.split()[0]: " ".join(line.split()[1:]) for line in lines}
    assert (out, name) == ("", "seed=0 · mfnet")
    threads = torch.get_num_threads()
    assert shown["device"] == f"cpu, {threads} thread{'s' * (threads > 1)}, 32-true"
    millions = sum(each.numel() for each in setup.session.model.parameters()) / 1e6
    assert shown["network"] == f"MFNet, {millions:.2f} M parameters"
    assert shown["images"] == "synth: 3 train, 2 val, 4 test"
    assert shown["sizes"] == "stored 48x64, trained 120x160, predicted 120x160"
    # one batch of two of the three images is an epoch
    assert shown["steps"] == "6 of batch 2 (6 epochs), validated every 3"
    assert "rgbt: " not in err, "a driver of a sweep takes that for why a run failed"
    for step in (240, 0):
        announce_network(changed(setup.session, step=step, label="final.pth"))
    first, second = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"cpu, \d+ threads?, 32-true; .*; checkpoint of step 240", first)
    assert second.endswith("; final.pth")
    assert network_line(setup.session) in first


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


def test_a_finished_run_is_compared_with_the_present_files(
    call: Call, words: list[str], data: Path
) -> None:
    shutil.copy(data / "labels" / "00101D.png", data / "labels" / "00201D.png")
    assert "trained on other files of the data set" in call(main, *words)[2]
    shutil.rmtree(data)
    code, out, err = call(main, *words)
    assert (code, "mIoU" in out) == (0, True)
    assert "other files" not in err, "a result can be shown without its data"
