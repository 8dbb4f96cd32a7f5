"""Trainings that are killed repeatedly give the same result as an uninterrupted one."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from mlflow.tracking import MlflowClient

from rgbt.engine.checkpoint import load_checkpoint
from rgbt.runs.folder import RunFolder
from rgbt.runs.result import RunResult
from sweeps.run.local import CWD_LAST, PRELOADED, _command
from tests.checkpoints.test_torch_files import same
from tests.commands import only_run
from tests.conftest import write_data

pytestmark = pytest.mark.slow

STEPS, EVAL_EVERY = 9, 3
IMAGES = {
    "train": [f"{n:05d}{'DN'[n % 2]}" for n in range(1, 5)],
    "val": ["00101D", "00102N"],
    "test": ["00201D", "00202N"],
}
SETTINGS = (
    *("+experiment=mfnet", "dataset=mfnet", "scale.batch_size=2", "scale.eval_batch_size=2"),
    *("scale.crop_hw=[64,64]", "scale.train_sizes=[64]", "scale.test_short_edge=64"),
    *(f"trainer.max_steps={STEPS}", f"trainer.eval_every={EVAL_EVERY}"),
    *("trainer.log_every=1", "trainer.accelerator=cpu", "trainer.threads=1"),
    "masker.patch_size=null",
)
ENDINGS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
TIMES = ("time", "images_per_s", "wait_share", "peak_memory_mib", "seconds_left")

FORKS = multiprocessing.get_context("forkserver")


def run(words: Sequence[str], variables: Mapping[str, str], log: str) -> None:
    """In a process of its own, the leader of a group: a command as that of a local job."""
    os.setsid()
    _command(words, variables, log)


@dataclass
class Training:
    """One command that is rerun after every kill."""

    place: Path
    minutes: str = "0"

    def __post_init__(self) -> None:
        self.log = self.place / "log"
        self.place.mkdir(exist_ok=True)

    def start(self, instant: str = "-") -> BaseProcess:
        root = self.place.parent
        words = (
            *(f"tracking.uri=sqlite:///{root / 'mlflow.db'}", f"dataset.root={root / 'mf'}"),
            *(f"tracking.experiment={self.place.name}", f"runs_dir={self.place}"),
            *("data.num_workers=0", f"trainer.checkpoint_minutes={self.minutes}"),
        )
        command = ("tests.dying", instant, "rgbt.run", *SETTINGS, *words)
        process = FORKS.Process(target=run, args=(command, {"OMP_NUM_THREADS": "1"}, str(self.log)))
        process.start()
        return process

    def wait_for_training(self, process: BaseProcess) -> None:
        """Until the process holds the lock of its run folder, or has ended."""
        while process.exitcode is None:
            if any(
                f"process {process.pid} " in lock.read_text() for lock in self.place.glob("*/lock")
            ):
                return
            time.sleep(0.005)

    def end(self, process: BaseProcess) -> int:
        process.join(300)
        assert process.exitcode is not None, "hangs"
        return process.exitcode

    def finish(self) -> Path:
        assert self.end(self.start()) == 0, self.log.read_text()[-3000:]
        return only_run(self.place)


class Bench(NamedTuple):
    root: Path
    undisturbed: Path
    seconds: float


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    root = tmp_path_factory.mktemp("kills")
    write_data(root / "mf", IMAGES, (64, 64))
    FORKS.set_forkserver_preload([CWD_LAST, PRELOADED])
    Training(root / "first").finish()  # starts the fork server and makes the store
    began = time.monotonic()
    straight = Training(root / "straight").finish()
    return Bench(root, straight, time.monotonic() - began)


def lines(folder: Path) -> list[Any]:
    plain = [{**vars(line), **line.values, "values": None} for line in RunFolder(folder).lines()]
    return [{name: line[name] for name in line if name not in TIMES} for line in plain]


def files(folder: Path) -> set[Path]:
    """All but the changes of the code at each start."""
    found = {path for path in folder.rglob("*") if path.is_file() and path.suffix != ".patch"}
    return {path.relative_to(folder) for path in found}


def comparable(path: Path) -> dict[str, Any]:
    """A checkpoint without learning rates: each step sets its own, a process without steps none."""
    found: dict[str, Any] = load_checkpoint(path)
    for optimizer in found.get("optimizers", {}).values():
        for group in optimizer["param_groups"]:
            del group["lr"]
    return found


def check(bench: Bench, place: Path) -> None:
    """The run in `place` is as the undisturbed one, and nothing else is left."""
    folder, straight = only_run(place), bench.undisturbed
    result, expected = (RunResult(run).result for run in (folder, straight))
    for one in (result, expected):
        del one["seconds_of_last_process"], one["name"]  # the name says how many workers
    assert result == expected
    assert lines(folder) == lines(straight)
    for name in ("best.pt", "last.pt"):
        assert same(*(comparable(run / name) for run in (folder, straight))), name
    assert load_checkpoint(folder / "best.pt")["step"] == result["best_step"]
    for split in ("val", "test"):
        one, other = (RunResult(run).counts(split).counts for run in (folder, straight))
        assert np.array_equal(one, other)
    assert files(folder) == files(straight)
    store = MlflowClient(tracking_uri=f"sqlite:///{bench.root / 'mlflow.db'}")
    experiment = store.get_experiment_by_name(place.name)
    (run,) = store.search_runs([experiment.experiment_id])
    assert (run.data.tags.get("rgbt.key"), run.info.status) == (folder.name, "FINISHED")
    steps = [metric.step for metric in store.get_metric_history(run.info.run_id, "train/loss")]
    assert steps == list(range(1, STEPS + 1))


@pytest.mark.parametrize("minutes", ["0", "1e-5", "10"])
def test_killed_at_random_instants(bench: Bench, minutes: str) -> None:
    """Six kills, of the process or its whole group; while a thread writes, too."""
    draw = random.Random(float(minutes))
    training = Training(bench.root / f"random_{minutes}", minutes)
    inside = float(RunResult(bench.undisturbed).result["seconds_of_last_process"])
    for _ in range(6):
        process = training.start()
        assert process.pid is not None
        number = draw.choice(ENDINGS)
        trains = draw.random() < 0.8  # killed while it trains, else at any moment
        if trains:
            training.wait_for_training(process)
        time.sleep(draw.uniform(0.0, 1.0) * (inside if trains else bench.seconds))
        is_group = draw.random() < 0.5
        with suppress(ProcessLookupError):  # before it leads a group, or when it has ended
            (os.killpg if is_group else os.kill)(process.pid, number)
        code = training.end(process)
        # Before the command answers signals: as the system does, or Python for Ctrl-C.
        early = {-number, 1} if number == signal.SIGINT else {-number}
        assert code in {0, 128 + number} | early, training.log.read_text()[-3000:]
    training.finish()
    check(bench, training.place)


INSTANTS = (
    *("before config.yaml 1", "after run.json 1", "after mlflow.json 1", "before metrics.jsonl 1"),
    *("after counts_val.npz 1", "before best.pt 1", "before last.pt 2", "before result.json 1"),
    *("after last.pt 3", "before best.pt 2", "before counts_val.npz 2"),  # those of step 3
)


@pytest.mark.parametrize("instant", INSTANTS)
def test_killed_between_two_writes(bench: Bench, instant: str) -> None:
    name = instant.replace(" ", "_").replace("/", "_")
    training = Training(bench.root / name)
    code = training.end(training.start(instant))
    assert code == -signal.SIGKILL, training.log.read_text()[-3000:]
    training.finish()
    check(bench, training.place)
