"""Drivers that are killed or stopped at any instant: every point once, nothing lost.

Real processes that share a storage; only their runs are fakes. Heartbeats take a second here.
"""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from multiprocessing import active_children, get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import optuna
import pytest

from sweeps import attributes as names
from sweeps.run import driver as drivers
from sweeps.run import storage as stores
from sweeps.run.storage import open_storage
from tests.sweeps.fakes import list_desk, points, scored, search_desk, until

pytestmark = pytest.mark.slow

DRIVER = "driver of a test"


def drive(runs: Path, kind: str, count: int, looks: int, url: str) -> None:
    """In a process of its own: a driver of `count` points whose runs end after so many looks."""
    drivers.HEARTBEAT_S, drivers.POLL_S, drivers.CLAIM_S = 1, 0.005, 0.05
    stores.HEARTBEAT_S, stores.STALE_S = 1, 3
    run = scored(*([0.5] * looks), val=0.5)
    both: Any = {"storage": open_storage(url, runs), "workers": 2, "wait": True}
    if kind == "list":
        list_desk(runs, points(count), run, **both).run()
    else:
        search_desk(runs, run, trials=count, **both).run()


@pytest.fixture(autouse=True)
def end_of_drivers() -> Iterator[None]:
    """A driver that a failed test has left stopped would never end, nor what it keeps open."""
    yield
    for process in active_children():
        if process.name == DRIVER:
            process.kill()
            process.join()


def start(*arguments: Any) -> BaseProcess:
    process = get_context("fork").Process(target=drive, args=arguments, name=DRIVER)
    process.start()
    return process


def end(process: BaseProcess) -> int | None:
    process.join(600)  # the machine may be busy
    return process.exitcode


def trials_of(runs: Path, url: str) -> list[Any]:
    storage = open_storage(url, runs)
    return (
        optuna.load_study(study_name="study", storage=storage).trials
        if "study" in optuna.get_all_study_names(storage)
        else []
    )


def until_running(runs: Path, url: str) -> None:
    """A driver has noted two trials; it writes nothing until one of them ends."""

    def noted() -> int:
        trials = [t for t in trials_of(runs, url) if t.state.name == "RUNNING"]
        return sum(names.LABEL in trial.user_attrs for trial in trials)

    until(lambda: noted() >= 2, "two trials")


def stop(process: BaseProcess, database: Path) -> None:
    """Stop a driver, but not while it locks the SQLite file: no other could write to it."""
    assert process.pid is not None
    pid = process.pid

    def is_stopped() -> bool:
        os.kill(pid, signal.SIGSTOP)
        os.waitpid(pid, os.WUNTRACED)
        try:
            with closing(sqlite3.connect(database, timeout=0.1)) as connection:
                connection.execute("BEGIN EXCLUSIVE")
        except sqlite3.OperationalError:
            os.kill(pid, signal.SIGCONT)
            return False
        return True

    until(is_stopped, "an instant without a lock")


def check(runs: Path, url: str, count: int) -> None:
    """Every point has one trial that counts, and every point that was noted is finished."""
    trials = trials_of(runs, url)
    assert all(trial.state.is_finished() for trial in trials)
    counted = [t for t in trials if t.state.name != "FAIL" or names.REASON in t.user_attrs]
    assert [trial.state.name for trial in counted] == ["COMPLETE"] * count
    keys = Counter(trial.user_attrs[names.KEY] for trial in counted)
    assert set(keys.values()) == {1}
    noted = {t.user_attrs[names.KEY] for t in trials if names.LABEL in t.user_attrs}
    assert noted == set(keys), "a point was lost"
    assert {path.parent.name for path in runs.glob("*/result.json")} == set(keys)


def survive(runs: Path, kind: str, url: str, draw: random.Random, count: int = 12) -> None:
    """Two drivers, one of which is killed; then the other ends alone."""
    both = [start(runs, kind, count, 20, url) for _ in range(2)]
    until_running(runs, url)
    time.sleep(draw.uniform(0.0, 1.0))
    victim, other = both if draw.random() < 0.5 else both[::-1]
    victim.kill()
    assert end(other) == 0
    check(runs, url, count)


@pytest.mark.parametrize("kind", ["list", "search"])
@pytest.mark.parametrize("series", range(2))
def test_one_of_two_drivers_killed_at_random(tmp_path: Path, kind: str, series: int) -> None:
    survive(tmp_path, kind, f"sqlite:///{tmp_path / 'studies.db'}", random.Random(series))


@pytest.mark.parametrize("kind", ["list", "search"])
def test_third_driver_finishes_after_both_are_killed(tmp_path: Path, kind: str) -> None:
    url = f"sqlite:///{tmp_path / 'studies.db'}"
    both = [start(tmp_path, kind, 6, 60, url) for _ in range(2)]
    until_running(tmp_path, url)
    for driver in both:
        driver.kill()
        driver.join()
    assert end(start(tmp_path, kind, 6, 2, url)) == 0
    check(tmp_path, url, 6)


@pytest.mark.parametrize("kind", ["list", "search"])
def test_driver_stopped_for_longer_than_grace_continues(tmp_path: Path, kind: str) -> None:
    url = f"sqlite:///{tmp_path / 'studies.db'}"
    first = start(tmp_path, kind, 6, 60, url)
    until_running(tmp_path, url)
    stop(first, tmp_path / "studies.db")
    assert end(start(tmp_path, kind, 6, 2, url)) == 0
    check(tmp_path, url, 6)
    assert first.pid is not None
    os.kill(first.pid, signal.SIGCONT)
    assert end(first) == 0
    check(tmp_path, url, 6)


def test_two_drivers_share_two_hundred_points(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'studies.db'}"
    both = [start(tmp_path, "list", 200, 0, url) for _ in range(2)]
    assert [end(driver) for driver in both] == [0, 0]
    check(tmp_path, url, 200)
