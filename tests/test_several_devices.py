"""Runs that several processes train: results, endings and resumed runs, as a user sees them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from rgbt.metrics.counts import Counts
from rgbt.run import main
from rgbt.training import launcher
from tests.commands import Call, assert_one_sentence, logged, losses, only_run
from tests.conftest import write_data

IMAGES = {
    "train": [f"{n:05d}{'DN'[n % 2]}" for n in range(1, 13)],
    "val": ["00101D", "00102N", "00103D"],
    "test": ["00201D", "00202N", "00203D", "00204N", "00205D"],
}
ON_CPU = ("trainer.accelerator=cpu", "trainer.threads=1", "tracking=none")
SMALL = (
    *("+experiment=mfnet", "dataset=mfnet", "scale.batch_size=4", "scale.eval_batch_size=1"),
    *("scale.crop_hw=[32,32]", "scale.train_sizes=[32]", "scale.test_short_edge=32"),
    *("masker.patch_size=null", "data.num_workers=0", "trainer.log_every=1", *ON_CPU),
)
LASTING = 300.0
"""Seconds after which a command hangs."""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("devices") / "mf", IMAGES, (32, 40))


@dataclass
class Command:
    """``python -m rgbt.run`` in a process of its own, with its output in files."""

    words: Sequence[str]
    folder: Path
    program: Sequence[str] = ("-m", "rgbt.run")
    environment: dict[str, str] | None = None

    def __post_init__(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        self.log = self.folder / f"log_{len(list(self.folder.glob('log_*')))}"
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, *self.program, *self.words, f"runs_dir={self.folder}"],
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, **(self.environment or {})},
            )

    def wait(self) -> int:
        return self.process.wait(LASTING)

    @property
    def text(self) -> str:
        return self.log.read_text(errors="replace")

    def steps(self) -> int:
        """Number of the last step in ``metrics.jsonl``; 0 before there is any."""
        return max(
            (len(losses(path.parent)) for path in self.folder.glob("*/metrics.jsonl")), default=0
        )

    def wait_for_step(self, step: int) -> None:
        deadline = time.monotonic() + LASTING
        while self.steps() < step:
            assert self.process.poll() is None, self.text
            assert time.monotonic() < deadline, self.text
            time.sleep(0.01)

    def processes(self) -> list[int]:
        """Numbers of the processes that this one started, in order of their rank."""
        return sorted(_children(self.process.pid))


def _children(parent: int) -> Iterator[int]:
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = status.read_text().rpartition(")")[2].split()
        except OSError:
            continue  # it has ended
        if int(fields[1]) == parent:
            yield int(status.parent.name)


def is_running(number: int) -> bool:
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def assert_ended(numbers: Sequence[int]) -> None:
    deadline = time.monotonic() + 30
    while any(map(is_running, numbers)):
        assert time.monotonic() < deadline, "a process is left"
        time.sleep(0.01)


def assert_same_run(folder: Path, other: Path) -> None:
    """The loss of every step to 1e-5, and equal counts.

    The parts of the loss agree to 1e-4: a point whose uncertainty is that of another one to
    rounding may be sampled in its place.
    """
    steps, others = losses(folder), losses(other)
    assert len(steps) == len(others) > 0
    for step, (values, expected) in enumerate(zip(steps, others, strict=True)):
        assert values["loss"] == pytest.approx(expected["loss"], rel=1e-5), step
        assert values == pytest.approx(expected, rel=1e-4, abs=1e-6), step
    for split in ("val", "test"):
        one, two = (Counts.load(each / f"counts_{split}.npz") for each in (folder, other))
        assert one.names == two.names
        assert np.array_equal(one.counts, two.counts), split


def settings(data: Path, steps: int, *more: str) -> tuple[str, ...]:
    length = (f"trainer.max_steps={steps}", f"trainer.eval_every={steps // 2}")
    # A step changes the weights little: rounding then stays rounding, and is not amplified.
    return (*SMALL, f"dataset.root={data}", *length, "optimizer.lr=1e-4", *more)


@pytest.mark.slow
@pytest.mark.parametrize("more", [(), ("trainer.averaging=ema", "trainer.ema_decay=0.9")])
def test_two_processes_train_as_one(
    call: Call, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: tuple[str, ...]
) -> None:
    words = settings(data, 4, *more)
    two = Command((*words, "trainer.devices=2"), tmp_path / "two")
    code, _, err = call(main, *words, f"runs_dir={tmp_path / 'one'}")
    assert code == 0, err
    assert two.wait() == 0, two.text
    folder = only_run(tmp_path / "two")
    assert folder.name == only_run(tmp_path / "one").name, "one key for any number of devices"
    assert_same_run(folder, only_run(tmp_path / "one"))
    assert two.text.count("2 x cpu, 1 thread each") == 1
    assert two.text.count("IoU by region") == 1
    # The finished run is shown without starting processes.
    monkeypatch.setattr(launcher, "launch", None)
    code, out, err = call(main, *words, "trainer.devices=2", f"runs_dir={tmp_path / 'two'}")
    assert code == 0, err
    assert "IoU by region" in out


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("data.batch_size=3", "data.batch_size is 3, which 2 devices cannot share equally"),
        ("trainer.batch_norm_parts=4", "trainer.batch_norm_parts is 4, but a run on 2 devices"),
    ],
)
def test_wrong_devices_are_refused_before_anything_starts(
    call: Call,
    data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    word: str,
    sentence: str,
) -> None:
    monkeypatch.setattr(launcher, "launch", None)
    words = settings(data, 4, "trainer.devices=2", word, f"runs_dir={tmp_path}")
    code, _, err = call(main, *words)
    assert code == 2
    assert_one_sentence(err, sentence)
    assert list(tmp_path.iterdir()) == []


def test_processes_that_torchrun_started_must_fit_the_devices(
    call: Call, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    variables = {
        **{"RANK": "0", "WORLD_SIZE": "4", "LOCAL_RANK": "0", "LOCAL_WORLD_SIZE": "2"},
        **{"MASTER_ADDR": "node1", "MASTER_PORT": "29500"},
    }
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    code, _, err = call(main, *settings(data, 4), f"runs_dir={tmp_path}")
    assert code == 2
    assert_one_sentence(err, "trainer.devices=1, but torchrun started 2 processes on each machine")
    # Another process of the same machine leaves the message to the first.
    monkeypatch.setenv("LOCAL_RANK", "1")
    monkeypatch.setenv("RANK", "1")
    assert call(main, *settings(data, 4), f"runs_dir={tmp_path}") == (2, "", "")


EXPERIMENTS = {
    "cmx": ("optimizer.lr=1e-5",),
    "grbm": ("optimizer.lr=1e-6",),
    "crm": ("optimizer.lr=1e-6",),
    "multi_head_night": ("optimizer.lr=1e-5", "scale.critic_lr=1e-5", "model.weights=null"),
    "sh_adversarial": ("optimizer.lr=1e-5", "scale.critic_lr=1e-5", "model.weights=null"),
}
"""Batch normalisation, losses of masks with three passes, two domains and a discriminator.

With these rates a step changes the weights little, so that rounding is not amplified. Upstream
runs take their own rates, and are left out.
"""


@pytest.mark.slow
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_any_number_of_processes_trains_the_same_run(tmp_path: Path, experiment: str) -> None:
    words = (
        *(f"+experiment={experiment}", "+debug=smoke", "scale.batch_size=4", "scale.num_points=64"),
        *("trainer.max_steps=10", "trainer.eval_every=10", "data.num_workers=0", *ON_CPU),
        *("scale.crop_hw=[64,80]", "scale.train_sizes=[64]", "scale.test_short_edge=64"),
        *EXPERIMENTS[experiment],
    )
    folders = {}
    for number in (1, 2, 4):
        command = Command((*words, f"trainer.devices={number}"), tmp_path / str(number))
        assert command.wait() == 0, command.text
        folders[number] = only_run(tmp_path / str(number))
    for number in (2, 4):
        assert folders[number].name == folders[1].name
        assert_same_run(folders[number], folders[1])


@pytest.fixture(scope="module")
def straight(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of one process that nothing interrupts."""
    command = Command(lasting(data), tmp_path_factory.mktemp("straight"))
    assert command.wait() == 0, command.text
    return only_run(command.folder)


def lasting(data: Path) -> tuple[str, ...]:
    return settings(data, 60, "trainer.checkpoint_every=5")


def kill_member(rank: int) -> Callable[[Command], int]:
    def kill(command: Command) -> int:
        os.kill(command.processes()[rank], signal.SIGKILL)
        return 137

    return kill


def kill_supervisor(command: Command) -> int:
    command.process.kill()
    return -9


def signal_supervisor(command: Command) -> int:
    command.process.send_signal(signal.SIGTERM)
    return 143


ENDINGS = {
    "process 0": kill_member(0),
    "process 1": kill_member(1),
    "supervisor": kill_supervisor,
    "SIGTERM": signal_supervisor,
}


@pytest.mark.slow
@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("resumed_with", [1, 2, 4])
def test_killed_run_resumes_with_another_number(
    data: Path, straight: Path, tmp_path: Path, ending: str, resumed_with: int
) -> None:
    first = Command((*lasting(data), "trainer.devices=2"), tmp_path)
    first.wait_for_step(7)
    processes = first.processes()
    assert len(processes) == 2
    code = ENDINGS[ending](first)
    assert first.wait() == code, first.text
    assert_ended(processes)
    assert "Traceback" not in first.text
    if ending == "SIGTERM":
        assert first.text.count("stopped by SIGTERM at step") == 1
    elif ending != "supervisor":
        assert_one_sentence(first.text, f"{ending} of 2 was stopped by SIGKILL")
    again = Command((*lasting(data), f"trainer.devices={resumed_with}"), tmp_path)
    assert again.wait() == 0, again.text
    assert "resumes at step" in again.text
    assert_same_run(only_run(tmp_path), straight)


@pytest.mark.slow
def test_torchrun_trains_the_same_run(data: Path, tmp_path: Path) -> None:
    words = settings(data, 4, "trainer.devices=auto")
    torchrun = ("-m", "torch.distributed.run", "--nproc-per-node=2", "-m", "rgbt.run")
    two = Command(words, tmp_path / "two", torchrun)
    one = Command(settings(data, 4), tmp_path / "one")
    assert (one.wait(), two.wait()) == (0, 0), two.text
    assert_same_run(only_run(tmp_path / "two"), only_run(tmp_path / "one"))
    assert two.text.count("2 x cpu") == 1
    assert two.text.count("IoU by region") == 1


@pytest.mark.slow
def test_tasks_of_srun_train_the_same_run(data: Path, tmp_path: Path) -> None:
    words = settings(data, 4, "trainer.devices=2")
    variables = {
        **{"SLURM_JOB_ID": str(os.getpid()), "SLURM_STEP_ID": "0", "SLURM_STEP_NUM_TASKS": "2"},
        **{"SLURM_STEP_TASKS_PER_NODE": "2", "SLURM_STEP_NODELIST": "127.0.0.1"},
    }
    tasks = []
    for rank in "01":
        environment = {**variables, "SLURM_PROCID": rank, "SLURM_LOCALID": rank}
        tasks.append(Command(words, tmp_path, environment=environment))
    assert [task.wait() for task in tasks] == [0, 0], tasks[0].text + tasks[1].text
    assert "IoU by region" in tasks[0].text
    assert tasks[1].text == ""
    one = Command(settings(data, 4), tmp_path / "one")
    assert one.wait() == 0, one.text
    assert_same_run(only_run(tmp_path), only_run(tmp_path / "one"))


@pytest.mark.slow
def test_error_of_one_process_is_reported_once(data: Path, tmp_path: Path) -> None:
    """An image that only process 1 reads cannot be read."""
    copy = write_data(tmp_path / "mf", IMAGES, (32, 40))
    # With batches of 1 image, the test images 1 and 3 are those of process 1.
    (copy / "images" / "00204N.png").write_bytes(b"no image")
    command = Command(
        settings(copy, 4, "trainer.devices=2", "trainer.selection_split=val"), tmp_path / "runs"
    )
    assert command.wait() == 2, command.text
    assert_one_sentence(command.text, "process 1 of 2: ")
    assert "00204N" in command.text


@pytest.mark.slow
def test_trial_of_a_sweep_uses_several_devices(data: Path, tmp_path: Path) -> None:
    words = settings(data, 2, "-m", "seed=0,1", "trainer.devices=2")
    command = Command(words, tmp_path)
    assert command.wait() == 0, command.text
    folders = [path.parent for path in tmp_path.glob("*/result.json")]
    assert len(folders) == 2
    assert all(len(logged(folder, "train")) == 2 for folder in folders)
    logs = [path.read_text() for path in tmp_path.glob(".logs/*.log")]
    assert all("2 x cpu" in log for log in logs)
