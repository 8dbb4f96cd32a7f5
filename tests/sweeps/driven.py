"""Sweeps of four real trainings whose drivers are started, killed and started again."""

from __future__ import annotations

import multiprocessing
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from rgbt.runs.folder import RunFolder
from rgbt.runs.result import RunResult
from sweeps.run.local import CWD_LAST, PRELOADED, _command
from tests.commands import logged, words_of
from tests.waiting import until

ROOT = Path(__file__).resolve().parents[2]
FORKS = multiprocessing.get_context("forkserver")


def run(words: Sequence[str], variables: Mapping[str, str], log: str) -> None:
    """In a process of its own, the leader of a group: a command in a fork of imported libraries."""
    os.setsid()
    os.environ.clear()
    _command(words, variables, log)


@dataclass
class Sweep:
    """A command that is started again and again; `words` say where it trains.

    Attributes:
        runs: the folder of its runs, and of the output of its calls.
        data: a small data set.
        steps: of each run.
        varied: what is swept.
        options: () for a command of one run.
    """

    runs: Path
    data: Path
    words: tuple[str, ...] = ()
    steps: int = 10
    varied: str = "seed=0,1,2,3"
    options: tuple[str, ...] = ("-m",)
    calls: int = 0

    def start(self, *more: str) -> BaseProcess:
        """A call of the command, in a process group of its own."""
        length = (f"trainer.max_steps={self.steps}", f"trainer.eval_every={self.steps // 2}")
        own = ("+experiment=grbm", *length, "trainer.checkpoint_minutes=0", self.varied)
        words = (*words_of(self.data, self.runs, *own), *self.words, *more)
        return self.call(("rgbt.run", *self.options, *words))

    def call(self, words: Sequence[str]) -> BaseProcess:
        """Another command about these runs."""
        FORKS.set_forkserver_preload([CWD_LAST, PRELOADED, "sweeps.sweep", "optuna"])
        self.runs.mkdir(exist_ok=True, parents=True)
        self.calls += 1
        variables = {**os.environ, "PYTHONPATH": str(ROOT)}
        process = FORKS.Process(target=run, args=(words, variables, str(self.log)))
        process.start()
        return process

    @property
    def log(self) -> Path:
        """Output of the last call."""
        return self.runs / f"call_{self.calls}.txt"

    @property
    def text(self) -> str:
        return self.log.read_text() if self.log.exists() else ""

    def end(self, process: BaseProcess) -> int:
        process.join(300)
        assert process.exitcode is not None, f"hangs: {self.text}"
        return process.exitcode

    def finish(self, *more: str) -> str:
        """What a call prints that ends well."""
        assert self.end(self.start(*more)) == 0, self.text
        return self.text

    def folders(self) -> dict[str, Path]:
        """The folders of runs by their seed."""
        found = {}
        for path in self.runs.glob("*/run.json"):
            described = RunResult(path.parent).description
            found[described.params["seed"]] = path.parent
        return found

    def until_step(self, step: int, *seeds: str) -> dict[str, Path]:
        """Wait until the runs of these seeds have trained so far; all folders."""

        def has_come() -> dict[str, Path]:
            known = self.folders()
            is_there = all(seed in known and steps(known[seed])[-1:] >= [step] for seed in seeds)
            return known if is_there else {}

        found: dict[str, Path] = until(has_come, f"step {step} of {seeds}", 0.05)
        return found

    def jobs(self) -> dict[str, str]:
        """The jobs of the points that this call has queued, by seed; of SLURM."""
        return dict(re.findall(r"queued +seed=(\d), job (\S+)", self.text))

    def log_of(self, seed: str) -> str:
        """Output of the jobs of a point."""
        return (self.runs / ".logs" / f"{self.folders()[seed].name}.log").read_text()


def steps(folder: Path) -> list[int]:
    """The training steps in the metrics of a run."""
    if not (folder / "metrics.jsonl").exists():
        return []
    return [line.step for line in RunFolder(folder).lines() if line.kind == "train"]


def facts(folder: Path) -> dict[str, Any]:
    """All of a finished run that must not depend on where and in how many parts it is trained."""
    result = dict(RunResult(folder).result)
    for name in ("seconds_of_last_process", "name"):  # the name says what is varied
        del result[name]
    lines = [
        (line["step"], {k: v for k, v in line["values"].items() if k.startswith("loss")})
        for line in logged(folder, "train")
    ]
    return {"result": result, "lines": lines}


def check(sweep: Sweep, straight: Sweep, seeds: str = "0123") -> None:
    """Every point is trained once, and its result is that of an undisturbed run."""
    folders, others = sweep.folders(), straight.folders()
    assert sorted(folders) == sorted(seeds)
    for seed, folder in folders.items():
        assert steps(folder) == list(range(1, sweep.steps + 1))
        assert facts(folder) == facts(others[seed]), seed


def resumed_at(text: str) -> list[int]:
    """Steps at which the commands in a log resumed their runs."""
    return [int(step) for step in re.findall(r"resumes at step (\d+)", text)]


def saved_at(text: str) -> list[int]:
    """Steps at which commands were stopped, by their log."""
    return [int(step) for step in re.findall(r"SIGTERM at step (\d+), and the checkpoint", text)]


def prune_a_trial(sweep: Sweep) -> None:
    """A search of one long trial, which its pruner stops at the first evaluation."""
    sweep.steps, sweep.varied = 400, "optimizer.lr=interval(1e-5,1e-4)"
    pruner = "hydra.sweeper.pruner={_target_: optuna.pruners.ThresholdPruner, lower: 101}"
    trials = ("hydra.sweeper.trials=1", "hydra.sweeper.workers=1", "trainer.eval_every=2")
    process = sweep.start(*trials, pruner)
    assert sweep.end(process) in (0, 1), sweep.text
    assert re.search(r"pruned +#0 .*pruned at step 2", sweep.text), sweep.text
