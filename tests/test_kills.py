"""Trainings that are killed repeatedly give the same result as an uninterrupted one."""

from __future__ import annotations

import json
import os
import random
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rgbt.engine.checkpoint import load_checkpoint
from rgbt.metrics.counts import Counts
from rgbt.tracking.run_files import read_result
from sweeps.worker.executors import LocalExecutor, LocalJob
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
    *("trainer.checkpoint_every=2", "trainer.log_every=1", "trainer.accelerator=cpu"),
    *("trainer.threads=1", "masker.patch_size=null"),
)
ENDINGS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
TIMES = ("images_per_s", "wait_share", "peak_memory_mib")


@dataclass
class Training:
    """One command that is rerun after every kill."""

    place: Path
    root: Path
    executor: LocalExecutor
    num_workers: int = 0
    started: int = 0

    @property
    def log(self) -> Path:
        return self.place / "log"

    def start(self, instant: str = "-") -> LocalJob:
        self.started += 1
        words = (
            *SETTINGS,
            *(f"dataset.root={self.root / 'mf'}", f"runs_dir={self.place}"),
            *(f"tracking.uri=sqlite:///{self.root / 'mlflow.db'}",),
            *(f"tracking.experiment={self.place.name}", f"data.num_workers={self.num_workers}"),
        )
        environment = {"OMP_NUM_THREADS": "1"}
        return self.executor.start(
            ("tests.dying", instant, "rgbt.run", *words), environment, self.log
        )

    def wait_for_training(self, job: LocalJob, pid: int) -> None:
        """Until the process holds the lock of its run folder, or has ended."""
        while job.poll() is None:
            if any(f"process {pid} " in lock.read_text() for lock in self.place.glob("*/lock")):
                return
            time.sleep(0.005)

    def finish(self) -> Path:
        assert ended(self.start()) == 0, self.log.read_text()[-3000:]
        return only_run(self.place)


def ended(job: LocalJob) -> int:
    deadline = time.monotonic() + 300
    while (code := job.poll()) is None:
        assert time.monotonic() < deadline, "hangs"
        time.sleep(0.005)
    return code


@dataclass
class Bench:
    root: Path
    executor: LocalExecutor
    undisturbed: Path
    seconds: float

    @property
    def training_seconds(self) -> float:
        result = json.loads((self.undisturbed / "result.json").read_text())
        return float(result["seconds_of_last_process"])


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    root = tmp_path_factory.mktemp("kills")
    write_data(root / "mf", IMAGES, (64, 64))
    executor = LocalExecutor()
    first = Training(root / "first", root, executor)
    first.finish()  # starts the fork server and makes the store
    straight = Training(root / "straight", root, executor)
    began = time.monotonic()
    return Bench(root, executor, straight.finish(), time.monotonic() - began)


def lines(folder: Path) -> list[tuple[str, int, dict[str, Any]]]:
    texts = (folder / "metrics.jsonl").read_text().splitlines()
    found = [json.loads(text) for text in texts]
    for line in found:
        line["values"] = {k: v for k, v in line["values"].items() if k not in TIMES}
    return [(line["kind"], line["step"], line["values"]) for line in found]


def files(folder: Path) -> set[Path]:
    """All but the changes of the code at each start."""
    found = {path for path in folder.rglob("*") if path.is_file() and path.suffix != ".patch"}
    return {path.relative_to(folder) for path in found}


def check(bench: Bench, place: Path) -> None:
    """The run in `place` is as the undisturbed one, and nothing else is left."""
    folder, straight = only_run(place), bench.undisturbed
    result, expected = (read_result(each) for each in (folder, straight))
    assert result is not None
    assert expected is not None
    for one in (result, expected):
        del one["seconds_of_last_process"], one["name"]  # the name says how many workers
    assert result == expected
    assert lines(folder) == lines(straight)
    for name in ("best.pt", "last.pt"):
        assert (folder / name).read_bytes() == (straight / name).read_bytes(), name
    assert load_checkpoint(folder / "best.pt")["step"] == result["best_step"]
    for split in ("val", "test"):
        one, other = (Counts.load(f / f"counts_{split}.npz") for f in (folder, straight))
        assert np.array_equal(one.counts, other.counts)
    assert files(folder) == files(straight)
    runs = sent(bench.root, place.name)
    assert [(run.data.tags.get("rgbt.key"), run.info.status) for run in runs] == [
        (folder.name, "FINISHED")
    ]
    steps = shown_steps(bench.root, runs[0].info.run_id)
    assert steps == sorted(set(steps)) == list(range(1, STEPS + 1))


def store(root: Path) -> Any:
    from mlflow.tracking import MlflowClient

    return MlflowClient(tracking_uri=f"sqlite:///{root / 'mlflow.db'}")


def sent(root: Path, experiment: str) -> list[Any]:
    client = store(root)
    found = client.get_experiment_by_name(experiment)
    return list(client.search_runs([found.experiment_id]))


def shown_steps(root: Path, run_id: str) -> list[int]:
    return [metric.step for metric in store(root).get_metric_history(run_id, "train/loss")]


@pytest.mark.parametrize("series", range(10))
def test_killed_at_random_instants(bench: Bench, series: int) -> None:
    """Six kills each, sixty in all; by the process or its whole group, with workers or without."""
    draw = random.Random(series)
    training = Training(
        bench.root / f"random_{series}", bench.root, bench.executor, num_workers=series % 2
    )
    for _ in range(6):
        job = training.start()
        pid = job._process.pid
        assert pid is not None
        number = draw.choice(ENDINGS)
        if draw.random() < 0.8:  # while it trains, else at any moment
            training.wait_for_training(job, pid)
            time.sleep(draw.uniform(0.0, 1.0) * bench.training_seconds)
        else:
            time.sleep(draw.uniform(0.0, 1.0) * bench.seconds)
        if draw.random() < 0.5:
            job._signal(number)
        elif job.poll() is None:
            os.kill(pid, number)
        code = ended(job)
        # Before the command answers signals: as the system does, or Python for Ctrl-C.
        early = {-number, 1} if number == signal.SIGINT else {-number}
        assert code in {0, 128 + number} | early, training.log.read_text()[-3000:]
    training.finish()
    check(bench, training.place)


INSTANTS = (
    *("before config.yaml 1", "after run.json 1", "after mlflow.json 1", "before mlflow.json 2"),
    *("after dataset.json 1", "after provenance.json 1", "before metrics.jsonl 1"),
    *("after checkpoints/3/counts_val.npz 1", "before checkpoints/3/best.pt 1"),
    *("after checkpoints/3/best.pt 1", "before last.pt 2", "after last.pt 2"),
    *("after .last_previous.pt.partial 1", "after last_previous.pt 2", "before best.pt 1"),
    *("after best.pt 1", "before last.pt 6", "after counts_test.npz 1", "before result.json 1"),
    "after result.json 1",
)


@pytest.mark.parametrize("instant", INSTANTS)
def test_killed_between_two_writes(bench: Bench, instant: str) -> None:
    name = instant.replace(" ", "_").replace("/", "_")
    training = Training(bench.root / name, bench.root, bench.executor)
    assert ended(training.start(instant)) == -signal.SIGKILL, training.log.read_text()[-3000:]
    training.finish()
    check(bench, training.place)
