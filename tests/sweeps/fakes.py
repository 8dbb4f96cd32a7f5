"""Fakes of everything that trains: plans, runs, processes, a driver and its view."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np
import pytest
import sqlalchemy

from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import number_of_regions
from rgbt.runs.folder import Description, RunFolder, counts_name
from rgbt.runs.result import RunResult
from rgbt.tracking.mlflow_store import NoTracking
from sweeps import attributes as names
from sweeps.evaluation import Words, measurement_of
from sweeps.point import Point
from sweeps.settings import Objective, SweepSettings
from sweeps.space import build_sampler, parse_space
from sweeps.run import driver as drivers
from sweeps.run.driver import Driver
from sweeps.run.planner import PlannedPoint
from sweeps.run.point_list import ListSource, PointList
from sweeps.run.run_store import RunStore
from sweeps.run.running_trial import RunningTrial
from sweeps.run.storage import STALE_S, TrialStore, open_storage, open_study
from sweeps.run.trial_sources import SamplerSource
from tests.measured import measurement

DATASET = "fingerprint-of-the-data"
DEADLINE_S = 180.0
"""Generous: the machine may be busy. Nothing waits for it but a test that fails."""


def settings(**changes: Any) -> SweepSettings:
    """Settings of a sweep, as in study.yaml but for `changes`."""
    none = ("storage", "gpus", "timeout_minutes", "study", "pruner", "trials")
    plain: dict[str, Any] = {
        **dict.fromkeys((*none, "hours")),
        "workers": 1,
        "retry": "none",
        "wait": False,
        "dry_run": False,
        "params": {},
        "points": (),
        "space": {},
        "objectives": (Objective("test/mIoU", "maximize"),),
        "sampler": {"_target_": "optuna.samplers.RandomSampler", "seed": 0},
        "replicates": 1,
        "trust": "",
    }
    return SweepSettings(**{**plain, **changes})


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
        if "wrong" in point.overrides:
            raise InputError("wrong=1 is no key.")
        return plan_of(point)


class PickyPlanner:
    """Takes no point."""

    def plan(self, point: Point) -> PlannedPoint:
        raise InputError("x does not fit.")


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
    run.finish(
        {
            "name": f"fake {folder.name}",
            "key": folder.name,
            "dataset": dataset,
            "steps": 4,
            "best_step": 4,
            "seconds_of_last_process": 2.5,
            "val": {"mIoU": 0.5} if val is None else dict(val),
            "test": {"mIoU": 0.25, "Var": 9.0} if test is None else dict(test),
        }
    )
    return run


@dataclass
class Call:
    """A requested process, and the folder of the run that it trains."""

    module: str
    words: tuple[str, ...]
    environment: dict[str, str]
    log: Path
    folder: Path
    attempt: int
    stops: int = 0

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


def first(*behaviours: Behaviour) -> Behaviour:
    """The n-th process of a run behaves as the n-th says; later ones as the last."""
    return lambda call: behaviours[min(call.attempt, len(behaviours) - 1)](call)


def only(word: str, behaviour: Behaviour, others: Behaviour = succeed) -> Behaviour:
    """Runs with that override behave so, the others otherwise."""
    return lambda call: behaviour(call) if word in call.words else others(call)


class FakeJob:
    """Goes one step further with every look at it."""

    def __init__(self, call: Call, process: Process) -> None:
        self.call = call
        self._process = process
        self._code: int | None = None

    def poll(self) -> int | None:
        if self._code is None and self.call.stops:
            self._code = -15
        if self._code is None:
            try:
                next(self._process)
            except StopIteration as end:
                self._code = end.value
        return self._code

    def stop(self) -> None:
        self.call.stops += 1


class FakeExecutor:
    """Makes fake processes; `calls` are all requested ones, in order."""

    def __init__(self, runs_dir: Path, behaviour: Behaviour = succeed) -> None:
        self.runs_dir = runs_dir
        self.behaviour = behaviour
        self.calls: list[Call] = []
        self.jobs: list[FakeJob] = []

    def start(self, command: Sequence[str], environment: Mapping[str, str], log: Path) -> FakeJob:
        module, *words = command
        folder = self.runs_dir / key_of(words)
        attempt = sum(call.words == tuple(words) for call in self.calls)
        call = Call(module, tuple(words), dict(environment), log, folder, attempt)
        self.calls.append(call)
        log.parent.mkdir(parents=True, exist_ok=True)
        log.touch()
        self.jobs.append(FakeJob(call, self.behaviour(call)))
        return self.jobs[-1]

    def started(self) -> list[tuple[str, ...]]:
        return [call.words for call in self.calls]


Look = Callable[[Sequence[RunningTrial]], None]


class FakeView:
    """Records its calls; `look` is called at every update with the works."""

    def __init__(self, look: Look = lambda works: None) -> None:
        self.ends: list[tuple[str, str, str]] = []
        self.said: list[tuple[str, str]] = []
        self.update = look

    def ended(self, work: RunningTrial, how: str, reason: str) -> None:
        self.ends.append((work.plan.point.label, how, reason))

    def say(self, how: str, text: str) -> None:
        self.said.append((how, text))


def interrupt_when(condition: Callable[[Sequence[RunningTrial]], bool]) -> FakeView:
    """A view that acts like a user who presses Ctrl-C."""

    def look(works: Sequence[RunningTrial]) -> None:
        if condition(works):
            raise KeyboardInterrupt

    return FakeView(look)


@dataclass
class Desk:
    """A driver with all that it needs; `plans` are those of a list."""

    driver: Driver
    store: TrialStore
    executor: FakeExecutor
    runs: RunStore
    view: FakeView
    plans: list[PlannedPoint] = field(default_factory=list)

    @property
    def source(self) -> Any:
        return self.driver.source

    def run(self) -> Desk:
        self.driver.run()
        return self

    def states(self) -> dict[str, list[str]]:
        """States of trials that count, by label of the point."""
        found: dict[str, list[str]] = {}
        for trial in self.store.trials():
            found.setdefault(trial.user_attrs["rgbt.label"], []).append(trial.state.name)
        return found

    def numbers(self, state: str) -> list[int]:
        return [trial.number for trial in self.store.trials() if trial.state.name == state]


def memory() -> Any:
    """A storage of its own, of one thread."""
    return open_storage("sqlite://", Path("unused"))


def store_on(
    storage: Any, wanted: SweepSettings | None = None, kind: str = "list", **study: Any
) -> TrialStore:
    """The study "study" of a storage; with `sampler` and `pruner` as of a search."""
    objectives = (wanted or settings()).objectives
    began = open_study("study", storage, objectives, {names.KIND: kind}, **study)
    return TrialStore(began, storage)


def silence(storage: Any, seconds: float = 2 * STALE_S) -> None:
    """No trial was heard of for so long."""
    change = f"UPDATE trial_heartbeats SET heartbeat = datetime('now', '-{seconds} seconds')"
    with storage.engine.begin() as connection:
        connection.execute(sqlalchemy.text(change))


def list_desk(
    runs_dir: Path,
    given: Sequence[Point],
    behaviour: Behaviour = succeed,
    *,
    storage: Any = None,
    view: FakeView | None = None,
    more: Any = None,
    **changes: Any,
) -> Desk:
    """A driver of a list of points, which are planned."""
    wanted, runs = settings(**changes), RunStore(runs_dir, NoTracking())
    wished = PointList("study", "s", "list", tuple(given), runs, FakePlanner(), more)  # type: ignore[arg-type]
    source = ListSource(wished, wanted)
    source.store = store_on(memory() if storage is None else storage, wanted)
    executor, seen = FakeExecutor(runs_dir, behaviour), view or FakeView()
    driver = Driver(source, runs, executor, wanted, seen)  # type: ignore[arg-type]
    return Desk(driver, source.store, executor, runs, seen, [plan_of(point) for point in given])


def search_desk(
    runs_dir: Path,
    behaviour: Behaviour = succeed,
    *,
    space: Mapping[str, Any] | None = None,
    storage: Any = None,
    view: FakeView | None = None,
    planner: Any = None,
    pruner: Any = None,
    **changes: Any,
) -> Desk:
    """A driver of a search over x in 0..1, or over `space`."""
    wanted = settings(pruner=None if pruner is None else {"_target_": "given"}, **changes)
    sampler = build_sampler(wanted.sampler)
    storage = memory() if storage is None else storage
    store = store_on(storage, wanted, "search", sampler=sampler, pruner=pruner)
    runs = RunStore(runs_dir, NoTracking())
    searched = parse_space(space or {"x": {"type": "float", "low": 0, "high": 1}})
    executor, seen = FakeExecutor(runs_dir, behaviour), view or FakeView()
    planner = planner or FakePlanner()
    source = SamplerSource((), searched, store, planner, wanted, seen.say)
    driver = Driver(source, runs, executor, wanted, seen)  # type: ignore[arg-type]
    return Desk(driver, store, executor, runs, seen)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drivers that look again at once."""
    monkeypatch.setattr(drivers, "POLL_S", 0.001)
    monkeypatch.setattr(drivers, "CLAIM_S", 0.002)


def until(condition: Callable[[], Any], what: str) -> Any:
    """What `condition` answers once it is true; fails after `DEADLINE_S`."""
    end = time.monotonic() + DEADLINE_S
    while time.monotonic() < end:
        found = condition()
        if found:
            return found
        time.sleep(0.01)
    raise AssertionError(f"waited {DEADLINE_S:g} s in vain for {what}")


def is_alive(pid: int) -> bool:
    """Whether a process of this machine runs; a zombie does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False
