"""Fakes of everything that trains: plans, runs, jobs, and what runs a list or a search of them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np
import optuna
import pytest
from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError
from rgbt.config.compose import conf_dir
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import number_of_regions
from rgbt.runs.folder import Description, RunFolder, counts_name, is_finished
from rgbt.runs.needs import Lacking
from rgbt.runs.result import RunResult
from rgbt.tracking.tracker import Tracking
from sweeps.plan.measurement import Words, measurement_of
from sweeps.plan.planner import PlannedPoint
from sweeps.point import Outcome, Point
from sweeps.run import driver as drivers
from sweeps.run import point_list
from sweeps.run.job import SAYS, STARTED, Work, how_ended
from sweeps.run.optuna_study import open_study
from sweeps.run.point_list import PointList
from sweeps.run.run_store import RunStore
from sweeps.run.running_point import RunningPoint
from sweeps.run.search_source import SearchSource
from sweeps.settings import Objective, SweepSettings, read_settings
from sweeps.space import parse_space
from tests.measured import measurement

DATASET = "fingerprint-of-the-data"


def hydra_node(sweeper: Any, launcher: str = "basic", **options: Any) -> DictConfig:
    """The node ``hydra`` as far as a sweep reads it."""
    choices = {"choices": {"hydra/launcher": launcher}}
    return OmegaConf.create({"sweeper": sweeper, "launcher": options, "runtime": choices})


def settings(**changes: Any) -> SweepSettings:
    """Settings of a sweep, as in study.yaml but for `changes` and the first two."""
    file = OmegaConf.load(conf_dir() / "hydra" / "sweeper" / "study.yaml")
    objectives = (Objective("test/mIoU", "maximize"),)
    sampler = {"_target_": "optuna.samplers.RandomSampler", "seed": 0}
    plain = read_settings(hydra_node(file))
    return replace(plain, **{"objectives": objectives, "sampler": sampler, **changes})


def key_of(overrides: Sequence[str]) -> str:
    """Stands for the config key."""
    return hashlib.sha256("\n".join(overrides).encode()).hexdigest()[:12]


def plan_of(point: Point, steps: int = 4) -> PlannedPoint:
    """What `Planner.plan` makes, without a configuration."""
    runs: Any = tuple(
        SimpleNamespace(
            key=key_of(words),
            overrides=words,
            plain={},
            trainer=SimpleNamespace(max_steps=steps, threads=2, accelerator="cpu"),
            scale=SimpleNamespace(pixel_factor=1.0),
        )
        for words in point.runs()
    )
    whole = [word for words in point.runs() for word in words] + [str(point.evaluations)]
    is_one = len(runs) == 1 and not point.evaluations
    fingerprints = {run.key: DATASET for run in runs}
    return PlannedPoint(point, runs[0].key if is_one else key_of(whole), runs, fingerprints)


def points(count: int, **point: Any) -> list[Point]:
    """That many points: x=0, x=1, ..."""
    return [Point(f"x={x}", (f"x={x}",), {"x": x}, **point) for x in range(count)]


class FakePlanner:
    """Stands for `Planner`; points with "wrong" do not fit."""

    def plan(self, point: Point) -> PlannedPoint:
        if {"wrong", "data", "checkout"} & set(point.overrides):
            raise InputError("wrong=1 is no key.")
        return plan_of(point)

    def composed(self, point: Point) -> Any:
        return None

    def lacking(self, point: Point) -> Lacking:
        """Points with "data" lack their data set, those with "checkout" the code of an author."""
        return {word: f"no {word}" for word in ("data", "checkout") if word in point.overrides}


def counts(right: int = 3, dataset: str = DATASET) -> Counts:
    """One image of one region and two classes."""
    array = np.array([[[[right, 4 - right], [0, 4]]]])
    named = {"names": ("00001D",), "night": None, "classes": ("road", "car")}
    return Counts(
        counts=array, **named, measurement=measurement(partition="ring1", dataset=dataset)
    )


def measure(folder: Path, words: Words, right: int = 2) -> None:
    """Write the counts of a measurement of a finished run, as its command does."""
    made, found = counts(right), measurement_of(words, RunResult(folder).counts().measurement)
    rows = number_of_regions(found.partition) or 3  # of pairs: a label of two classes, or none
    array = np.repeat(made.counts, rows, axis=1)
    path = folder / "evaluations" / f"{' '.join(words)}.npz"
    path.parent.mkdir(exist_ok=True)
    replace(made, counts=array, measurement=found).save(path)


def finish(
    folder: Path,
    *,
    test: Mapping[str, float | None] | None = None,
    val: Mapping[str, float | None] | None = None,
    dataset: str = DATASET,
    tags: Mapping[str, str] | None = None,
) -> RunFolder:
    """Write what a finished run leaves."""
    run = RunFolder(folder)
    run.describe(Description(f"fake {folder.name}", {"rgbt.key": folder.name, **(tags or {})}, {}))
    counts(dataset=dataset).save(run.path / counts_name("test"))
    scores = {
        "val": {"mIoU": 0.5} if val is None else dict(val),
        "test": {"mIoU": 0.25, "Var": 9.0} if test is None else dict(test),
    }
    known = {"name": f"fake {folder.name}", "key": folder.name, "dataset": dataset}
    run.finish({**known, "steps": 4, "best_step": 4, "seconds_of_last_process": 2.5, **scores})
    return run


@dataclass(frozen=True)
class Call:
    """A command of a job, and the folder of the run that it trains."""

    module: str
    words: tuple[str, ...]
    trained: Path | None
    log: Path

    @property
    def folder(self) -> Path:
        assert self.trained is not None, "it trains nothing"
        return self.trained

    def value(self, name: str) -> str:
        (found,) = [word.partition("=")[2] for word in self.words if word.startswith(f"{name}=")]
        return found


Process = Generator[None, None, int]
Behaviour = Callable[[Call], Process]


def scored(
    *scores: float, val: float | None = None, end: Callable[[Call], Process] | None = None
) -> Behaviour:
    """A run with these validations that then ends, by default finished with score `val`."""

    def process(call: Call) -> Process:
        run = RunFolder(call.folder)
        for index, score in enumerate(scores):
            yield
            run.append(2 * index + 2, "val", {"mIoU": score})
        if end is not None:
            return (yield from end(call))
        finish(call.folder, val=None if val is None else {"mIoU": val})
        return 0

    return process


succeed = scored(0.2, 0.4)
"""A run of two validations."""


def leave(code: int, text: str = "") -> Behaviour:
    """Says this and ends."""

    def process(call: Call) -> Process:
        yield
        with call.log.open("a") as file:
            file.write(text)
        return code

    return process


fail = leave(1, "Traceback (most recent call last):\n  File x\nValueError: a bad day\n")


def hang(call: Call) -> Generator[None, None, NoReturn]:
    """Runs until it is stopped."""
    RunFolder(call.folder)
    while True:
        yield


def nth(*behaviours: Behaviour) -> Behaviour:
    """The n-th command behaves as the n-th says."""
    left = iter(behaviours)
    return lambda call: next(left)(call)


def only(word: str, behaviour: Behaviour, others: Behaviour = succeed) -> Behaviour:
    """Runs with that override behave so, the others otherwise."""
    return lambda call: behaviour(call) if word in call.words else others(call)


class FakeJob:
    """Goes one step further with every look at it."""

    def __init__(self, work: Work, executor: FakeExecutor) -> None:
        self.work, self.is_stopped, self.end = work, False, ""
        self._executor, self._process = executor, self._execute()

    def _say(self, text: str) -> None:
        self.work.log.parent.mkdir(parents=True, exist_ok=True)
        with self.work.log.open("a") as log:
            log.write(f"{SAYS}{text}\n")

    def _execute(self) -> Generator[None, None, None]:
        self._say(f"{STARTED} on fake")
        code = 0
        for (module, *words), trained in self.work.steps.items():
            if trained is None or not is_finished(trained):
                call = Call(module, tuple(words), trained, self.work.log)
                self._executor.calls.append(call)
                code = yield from self._executor.behaviour(call)
            if code:
                break
        self._say(how_ended(code))

    def look(self) -> str:
        if self.is_stopped and self.end != "ended":
            self._say(how_ended(143))
            self.end = "ended"
        elif next(self._process, "ended"):
            self.end = "ended"
        return self.end or "running"


class FakeExecutor:
    """Simulates jobs; `submits` are the keys of every submission, `calls` all commands."""

    def __init__(self, behaviour: Behaviour = succeed, slots: int = 1) -> None:
        self.behaviour, self.slots, self.is_lasting = behaviour, slots, False
        self.is_full, self.looks = False, 0  # whether jobs wait
        self.submits: list[list[str]] = []
        self.calls: list[Call] = []
        self.jobs: dict[str, FakeJob] = {}

    def submit(self, works: Sequence[Work]) -> list[str]:
        self.submits.append([work.key for work in works])
        return [self._job(work) for work in works]

    def _job(self, work: Work) -> str:
        known = [job for job, one in self.jobs.items() if one.work.key == work.key and not one.end]
        job = known[0] if known and self.is_lasting else str(len(self.jobs))
        self.jobs.setdefault(job, FakeJob(work, self))
        return job

    def state(self, job: str) -> str:
        self.looks += 1
        assert self.looks < 2000, "nobody ends this job"
        is_queued = self.is_full and not self.jobs[job].is_stopped
        return "queued" if is_queued else self.jobs[job].look()

    def cancel(self, job: str) -> None:
        self.jobs[job].is_stopped = True

    def started(self) -> list[tuple[str, ...]]:
        return [call.words for call in self.calls]

    def stopped(self) -> list[str]:
        return [name for name, job in self.jobs.items() if job.is_stopped]


def lasting(behaviour: Behaviour = succeed, slots: int = 9) -> FakeExecutor:
    """A cluster: its jobs continue without the driver."""
    made = FakeExecutor(behaviour, slots)
    made.is_lasting = True
    return made


Look = Callable[[Sequence[RunningPoint]], object]


class FakeView:
    """Records its calls; `look` is called at every update with the running points."""

    def __init__(self, look: Look = len) -> None:
        self.ends: list[tuple[str, str, str]] = []
        self.said: list[tuple[str, str]] = []
        self.counts: list[Mapping[str, int]] = []
        self._look = look

    def __enter__(self) -> None: ...

    def __exit__(self, *error: object) -> None: ...

    def begin(self, where: str) -> None: ...

    def ended(self, point: RunningPoint, outcome: Outcome) -> None:
        self.ends.append((point.plan.point.label, outcome.state, outcome.reason))

    def say(self, how: str, text: str) -> None:
        self.said.append((how, text))

    def update(self, running: Sequence[RunningPoint], counts: Mapping[str, int]) -> None:
        self.counts.append(dict(counts))
        self._look(running)


def interrupt_when(condition: Look) -> FakeView:
    """A view that acts like a user who presses Ctrl-C."""

    def look(running: Sequence[RunningPoint]) -> None:
        if condition(running):
            raise KeyboardInterrupt

    return FakeView(look)


@contextmanager
def driven_by(executor: FakeExecutor, view: FakeView) -> Any:
    """Drivers have this executor and this view, and look again at once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drivers, "POLL_S", 0.0)
        patch.setattr(drivers, "open_executor", lambda *_: executor)
        patch.setattr(point_list, "ProgressView", lambda _: view)
        yield


class Desk:
    """A driver with all that it needs; `slots` are those of an executor that is not given."""

    def __init__(
        self,
        runs_dir: Path,
        behaviour: Behaviour = succeed,
        *,
        executor: FakeExecutor | None = None,
        view: FakeView | None = None,
        slots: int = 1,
        planner: Any = None,
        **changes: Any,
    ) -> None:
        self.executor, self.view = executor or FakeExecutor(behaviour, slots), view or FakeView()
        launcher = "submitit_slurm" if self.executor.is_lasting else "basic"
        self.settings = settings(**{"launcher": launcher, **changes})
        self.runs = RunStore(runs_dir, Tracking())
        self.planner: Any = planner or FakePlanner()


class ListDesk(Desk):
    """A driver of a list of points, or of so many (x=0, x=1, ...)."""

    def __init__(
        self,
        runs_dir: Path,
        given: Sequence[Point] | int,
        behaviour: Behaviour = succeed,
        *,
        study: str = "study",
        more: Any = None,
        rank: Any = None,
        **others: Any,
    ) -> None:
        super().__init__(runs_dir, behaviour, **others)
        self.given = tuple(points(given) if isinstance(given, int) else given)
        self.keys = [plan_of(point).key for point in self.given]
        what = (self.given, self.runs, self.planner, more, rank)
        self.points = PointList(study, study, *what)
        self.outcomes: list[Outcome] | None = None

    def run(self, *, strict: bool = False) -> ListDesk:
        with driven_by(self.executor, self.view):
            self.outcomes = point_list.run_points(self.points, self.settings, strict=strict)
        return self

    def states(self) -> list[str]:
        return [outcome.state for outcome in self.outcomes or ()]


class SearchDesk(Desk):
    """A driver of a search over x in 0..1, or over `space`."""

    def __init__(
        self,
        runs_dir: Path,
        behaviour: Behaviour = succeed,
        *,
        space: Mapping[str, Any] | None = None,
        storage: Any = None,
        pruner: Any = None,
        **others: Any,
    ) -> None:
        super().__init__(runs_dir, behaviour, pruner=pruner and {"_target_": "given"}, **others)
        self.storage = storage or optuna.storages.InMemoryStorage()
        self.study = open_study("study", self.storage, self.settings.objectives, {})
        self.study.pruner = pruner or optuna.pruners.NopPruner()
        searched = parse_space(space or {"x": {"type": "float", "low": 0, "high": 1}})
        given = ((), searched, self.study, self.settings, self.runs, self.view.say)
        self.source = SearchSource(*given, self.planner)

    def run(self) -> SearchDesk:
        with driven_by(self.executor, self.view):
            drivers.drive(self.view, self.source, self.runs, self.settings)  # type: ignore[arg-type]
        return self

    def next(self) -> PlannedPoint:
        plan = self.source.next()
        assert plan is not None
        return plan

    @property
    def trials(self) -> list[Any]:
        return self.study.get_trials(deepcopy=False)

    def states(self) -> list[str]:
        return [trial.state.name for trial in self.trials]
