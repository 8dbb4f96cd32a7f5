"""Runs that several processes train: results, endings and resumed runs, as a user sees them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from rgbt.metrics.counts import Counts
from rgbt.run import main
from tests.commands import ON_CPU, Call, assert_one_sentence, losses, only_run
from tests.conftest import write_data

IMAGES = {
    "train": [f"{n:05d}{'DN'[n % 2]}" for n in range(1, 13)],
    "val": ["00101D", "00102N", "00103D"],
    "test": ["00201D", "00202N", "00203D", "00204N", "00205D"],
}
LASTING = 300.0  # seconds after which a command hangs


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("devices") / "mf", IMAGES, (32, 40))


def settings(data: Path, steps: int, *more: str) -> tuple[str, ...]:
    """Of a small run. A step changes the weights little: rounding stays, and is not amplified."""
    return (
        *("+experiment=mfnet", "dataset=mfnet", "scale.batch_size=4", "scale.eval_batch_size=1"),
        *("scale.crop_hw=[32,32]", "scale.train_sizes=[32]", "scale.test_short_edge=32"),
        *("masker.patch_size=null", "data.num_workers=0", "trainer.log_every=1", *ON_CPU),
        *(f"dataset.root={data}", f"trainer.max_steps={steps}", f"trainer.eval_every={steps // 2}"),
        *("optimizer.lr=1e-4", *more),
    )


class Command:
    """``python -m rgbt.run`` in a process of its own, with its output in a file."""

    def __init__(
        self,
        words: Sequence[str],
        folder: Path,
        program: Sequence[str] = ("-m", "rgbt.run"),
        environment: dict[str, str] | None = None,
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self.log = folder / f"log_{len(list(folder.glob('log_*')))}"
        command = [sys.executable, *program, *words, f"runs_dir={folder}"]
        given = {**os.environ, **(environment or {})}
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log, env=given)

    def wait(self) -> int:
        return self.process.wait(LASTING)

    def finished(self) -> Path:
        """The folder of its run, once it is finished."""
        assert self.wait() == 0, self.text
        return only_run(self.folder)

    @property
    def text(self) -> str:
        return self.log.read_text(errors="replace")

    def wait_for_step(self, step: int) -> None:
        deadline = time.monotonic() + LASTING
        while not any(f'"step": {step}' in p.read_text() for p in self.folder.glob("*/*.jsonl")):
            assert self.process.poll() is None, self.text
            assert time.monotonic() < deadline, self.text
            time.sleep(0.01)


def assert_same_run(folder: Path, other: Path) -> None:
    """The loss of every step to 1e-5, and counts that are equal in all but one pixel of 1,000.

    Its parts agree to 1e-4, as another point of nearly equal uncertainty may be sampled. Two
    classes with nearly equal scores may change places.
    """
    steps, others = losses(folder), losses(other)
    assert len(steps) == len(others) > 0
    for step, (values, expected) in enumerate(zip(steps, others, strict=True)):
        assert values["loss"] == pytest.approx(expected["loss"], rel=1e-5), step
        assert values == pytest.approx(expected, rel=1e-4, abs=1e-6), step
    for split in ("val", "test"):
        one, two = (Counts.load(run / f"counts_{split}.npz") for run in (folder, other))
        assert one.names == two.names
        differing = np.abs(one.counts.astype(int) - two.counts).sum() / 2
        assert differing <= 1e-3 * two.counts.sum(), split


@pytest.mark.parametrize("rank", ["0", "1"])
def test_batch_that_three_processes_cannot_share_is_refused(
    call: Call, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rank: str
) -> None:
    """By process 0 alone, before anything is written."""
    torchrun = {
        "RANK": rank,
        "WORLD_SIZE": "3",
        "LOCAL_WORLD_SIZE": "3",
        "TORCHELASTIC_RUN_ID": "1",
    }
    for name, value in {**torchrun, "TORCHELASTIC_RUN_ID": "1"}.items():
        monkeypatch.setenv(name, value)
    code, out, err = call(main, *settings(data, 4), f"runs_dir={tmp_path}")
    assert (code, list(tmp_path.iterdir())) == (2, [])
    if rank == "0":
        assert_one_sentence(err, "data.batch_size is 4, which 3 devices cannot share")
    else:
        assert out == err == ""


EXPERIMENTS: dict[str, tuple[Any, ...]] = {
    "mfnet": (2, "optimizer.lr=1e-4", "trainer.averaging=ema", "trainer.ema_decay=0.9"),
    "crm": (4, "optimizer.lr=1e-6"),
    "multi_head_night": (*(2, "optimizer.lr=1e-5", "scale.critic_lr=1e-5", "model.weights=null"),),
}
"""Number of processes, and rates at which a step changes the weights little: rounding stays."""


@pytest.mark.slow
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_any_number_of_processes_trains_the_same_run(tmp_path: Path, experiment: str) -> None:
    number, *own = EXPERIMENTS[experiment]
    words = (
        *(f"+experiment={experiment}", "+debug=smoke", "scale.batch_size=4", "scale.num_points=64"),
        *("trainer.max_steps=5", "trainer.eval_every=5", "data.num_workers=0", *ON_CPU),
        *("scale.crop_hw=[64,80]", "scale.train_sizes=[64]", "scale.test_short_edge=64"),
        *own,
    )
    alone = Command(words, tmp_path / "1").finished()
    several = Command((*words, f"trainer.devices={number}"), tmp_path / str(number))
    folder = several.finished()
    assert folder.name == alone.name
    assert_same_run(folder, alone)
    assert several.text.count(f"{number} x cpu, 1 thread each") == 1
    assert several.text.count("IoU by region") == 1


@pytest.fixture(scope="module")
def straight(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of one process that nothing interrupts."""
    words = settings(data, 60, "trainer.checkpoint_minutes=0")
    return Command(words, tmp_path_factory.mktemp("straight")).finished()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("killed", "signal_", "code", "number"),
    [
        ("process 1", signal.SIGKILL, 137, 1),
        ("command", signal.SIGKILL, -9, 2),
        ("command", signal.SIGTERM, 143, 1),
    ],
)
def test_killed_run_resumes_with_another_number(
    data: Path, straight: Path, tmp_path: Path, killed: str, signal_: int, code: int, number: int
) -> None:
    lasting = settings(data, 60, "trainer.checkpoint_minutes=0")
    first = Command((*lasting, "trainer.devices=2"), tmp_path)
    first.wait_for_step(7)
    members = sorted(psutil.Process(first.process.pid).children(), key=lambda each: each.pid)
    assert len(members) == 2
    os.kill(first.process.pid if killed == "command" else members[int(killed[-1])].pid, signal_)
    assert first.wait() == code, first.text
    assert not psutil.wait_procs(members, timeout=120)[1]
    if killed != "command":
        # The other process may say first that the launcher stopped it.
        text = first.text.replace("rgbt: stopped by SIGTERM; rerun the command to resume.", "", 1)
        assert_one_sentence(text, f"{killed} of 2 was stopped by SIGKILL")
    elif signal_ != signal.SIGKILL:
        assert_one_sentence(first.text, "and the checkpoint is saved; rerun the command")
    again = Command((*lasting, f"trainer.devices={number}"), tmp_path)
    assert_same_run(again.finished(), straight)
    assert "resumes at step" in again.text


@pytest.mark.slow
def test_torchrun_and_srun_train_the_same_run(data: Path, tmp_path: Path) -> None:
    alone = Command(settings(data, 4), tmp_path / "alone").finished()
    torchrun = ("-m", "torch.distributed.run", "--nproc-per-node=2", "-m", "rgbt.run")
    two = Command(settings(data, 4), tmp_path / "torchrun", torchrun)
    assert_same_run(two.finished(), alone)
    assert two.text.count("IoU by region") == 1
    job = {
        "SLURM_JOB_ID": str(os.getpid()),
        "SLURM_NODELIST": "127.0.0.1",
        "SLURM_NODEID": "0",
        **dict.fromkeys(("SLURM_NTASKS", "SLURM_NTASKS_PER_NODE", "SLURM_STEP_NUM_TASKS"), "2"),
    }
    words, srun = settings(data, 4), tmp_path / "srun"
    first, second = (
        Command(words, srun, environment={**job, "SLURM_PROCID": rank, "SLURM_LOCALID": rank})
        for rank in "01"
    )
    assert [first.wait(), second.wait()] == [0, 0], first.text + second.text
    assert_same_run(only_run(srun), alone)
    assert "IoU by region" in first.text
    assert second.text == ""


@pytest.mark.slow
def test_error_of_one_process_is_reported_once(tmp_path: Path) -> None:
    """An image that only process 1 reads cannot be read."""
    copy = write_data(tmp_path / "mf", IMAGES, (32, 40))
    # With batches of 1, the test images 1 and 3 are those of process 1.
    (copy / "images" / "00204N.png").write_bytes(b"no image")
    words = settings(copy, 4, "trainer.devices=2", "trainer.selection_split=val")
    command = Command(words, tmp_path / "runs")
    assert command.wait() == 2, command.text
    assert_one_sentence(command.text, "process 1 of 2: ")
    assert "00204N" in command.text
