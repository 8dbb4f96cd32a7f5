"""A driver: what is submitted when, how points end, interruptions, jobs that go on without it."""

from __future__ import annotations

import json
import signal
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import optuna
import pytest

from rgbt.files.atomic import holding
from rgbt.runs.naming import TAGS
from rgbt.runtime.signals import answered
from sweeps import attributes as names
from sweeps.point import Point
from sweeps.run import driver as drivers
from sweeps.run import running_point
from sweeps.run.job import Work
from sweeps.run.point_state import work_of
from sweeps.settings import Objective
from tests.sweeps.fakes import (
    Call,
    FakeView,
    ListDesk,
    Process,
    SearchDesk,
    fail,
    finish,
    hang,
    interrupt_when,
    lasting,
    leave,
    measure,
    nth,
    only,
    plan_of,
    scored,
)

UP = (Objective("val/mIoU", "maximize"),)
RGB, RING = ("modality=rgb",), ("modality=thermal", "regions=ring9")
PAIRS = (("frames=aligned",), ("frames=released",), ("frames=next",))


def test_points_are_run_in_order_and_a_second_call_runs_nothing(tmp_path: Path) -> None:
    most: list[int] = []
    view = FakeView(lambda running: most.append(len(running)))
    desk = ListDesk(tmp_path, 4, slots=2, view=view).run()
    assert max(most) == 2
    assert desk.executor.started() == [(f"x={x}",) for x in range(4)]
    assert set(desk.states()) == {"finished"}
    assert [state for _, state, _ in view.ends] == ["finished"] * 4
    first = {"finished": 0, "running": 2, "failed": 0, "waiting": 2}
    assert (view.counts[0], view.counts[-1]["finished"]) == (first, 4)
    again = ListDesk(tmp_path, 4).run()
    assert (again.executor.submits, again.states()) == ([], desk.states())


def test_all_free_points_are_one_submission(tmp_path: Path) -> None:
    desk = ListDesk(tmp_path, 5, slots=9)
    finish(tmp_path / desk.keys[0])
    assert desk.run().executor.submits == [desk.keys[1:]]


def test_a_failed_point_does_not_stop_the_others(tmp_path: Path) -> None:
    behaviour = only("x=0", fail, only("x=1", leave(-9)))
    desk = ListDesk(tmp_path, 4, behaviour)
    other = tmp_path / desk.keys[3]
    finish(other, dataset="another")
    assert desk.run().states() == ["failed", "failed", "finished", "failed"]
    reasons = [outcome.reason for outcome in desk.outcomes or ()]
    assert reasons[0] == "ValueError: a bad day"
    assert "SIGKILL" in reasons[1]
    assert "trained on other files" in reasons[3]
    assert [state for state, _ in desk.view.said if state == "failed"] == ["failed"]


def test_a_job_gets_what_a_point_lacks(tmp_path: Path) -> None:
    tags = {"rgbt.table/one": "row"}
    words = ("dataset.root=/x", "y=1")
    desk = ListDesk(tmp_path, [Point("p", words, {}, tags, (0, 1), (RGB, RING, *PAIRS))])
    plan = plan_of(desk.given[0])
    done, new = (tmp_path / run.key for run in plan.runs)
    finish(done)
    measure(done, RGB)
    work = work_of(plan, desk.runs, "my_lab")
    own = ("trust=my_lab", "dataset.root=/x")
    # Both protocols of virtual views are one command.
    views = [("rgbt.consistency", "frames=virtual"), ("rgbt.consistency", "frames=next")]
    more = [("rgbt.evaluate", *RING), *views]

    def measured(folder: Path, *steps: tuple[str, ...]) -> list[tuple[str, ...]]:
        return [(module, f"run={folder}", *rest, *own) for module, *rest in steps]

    training = ("rgbt.run", *words, "seed=1")
    assert list(work.steps) == [
        *measured(done, *more),
        training,
        *measured(new, ("rgbt.evaluate", *RGB), *more),
    ]
    assert {words: folder for words, folder in work.steps.items() if folder} == {training: new}
    assert json.loads(work.environment[TAGS]) == tags
    # Threads are a setting of the run: two jobs at a time give the bits of one.
    assert "OMP_NUM_THREADS" not in work.environment
    assert work.log == tmp_path / ".logs" / f"{plan.key}.log"


def test_evaluations_are_steps_of_the_job(tmp_path: Path) -> None:
    given = [Point("p", ("x=1",), evaluations=(RGB, RING))]
    desk = ListDesk(tmp_path, given, only("modality=rgb", fail)).run()
    assert [call.module for call in desk.executor.calls] == ["rgbt.run", "rgbt.evaluate"]
    assert (desk.states(), len(desk.executor.submits)) == (["failed"], 1)


@pytest.mark.parametrize(("cores", "fitting"), [(6, None), (5, 2), (3, 1)])
def test_more_threads_than_cores_are_reported_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cores: int, fitting: int | None
) -> None:
    """Three runs at a time, with two threads each; the second or the third one is too many."""
    monkeypatch.setattr(drivers, "usable_cores", lambda: cores)
    desk = ListDesk(tmp_path, 6, scored(0.5), slots=3)
    notes = [text for how, text in desk.run().view.said if how == "note"]
    assert len(notes) == (fitting is not None)
    for note in notes:
        assert f"with trainer.threads=2 share {cores} cores" in note
        assert f"more than workers={fitting} gain" in note


def test_a_point_ends_at_its_time_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = [0.0]

    def now() -> float:
        seconds[0] += 1
        return seconds[0]

    monkeypatch.setattr(running_point, "time", SimpleNamespace(monotonic=now))
    desk = ListDesk(tmp_path, 2, only("x=0", hang), timeout_minutes=1).run()
    assert desk.states() == ["failed", "finished"]
    assert "timeout_minutes" in desk.view.ends[0][2]
    assert desk.executor.stopped() == ["0"]
    again = ListDesk(tmp_path, 2).run()
    assert (again.states(), again.executor.submits) == (["failed", "finished"], [])
    assert set(ListDesk(tmp_path, 2, retry="failed").run().states()) == {"finished"}
    # Jobs that wait for their turn have no limit.
    cluster = lasting(hang)
    cluster.is_full = True
    looks = iter([False] * 100 + [True])
    view = interrupt_when(lambda _: [now(), next(looks)][1])
    with pytest.raises(KeyboardInterrupt):
        ListDesk(tmp_path / "b", 1, executor=cluster, view=view, timeout_minutes=1).run()
    assert cluster.stopped() == []


@pytest.mark.parametrize(
    ("is_lasting", "stop_jobs", "stopped"),
    [(False, False, ["0", "1"]), (True, False, []), (True, True, ["0", "1"])],
)
def test_ctrl_c_stops_jobs_that_would_end_with_the_command(
    tmp_path: Path, is_lasting: bool, stop_jobs: bool, stopped: list[str]
) -> None:
    executor, view = lasting(scored(0.4, 0.5), 2), interrupt_when(bool)
    executor.is_lasting = is_lasting
    with pytest.raises(KeyboardInterrupt):
        ListDesk(tmp_path, 3, executor=executor, view=view, stop_jobs=stop_jobs).run()
    assert executor.stopped() == stopped
    assert [job for job, found in executor.jobs.items() if found.end] == stopped
    again = ListDesk(tmp_path, 3, executor=executor).run()
    assert set(again.states()) == {"finished"}
    assert len(executor.jobs) == 3 + len(stopped)


def test_ctrl_c_while_jobs_are_started_stops_them_too(tmp_path: Path) -> None:
    """The first one takes seconds: its process imports torch."""
    desk = ListDesk(tmp_path, 2, hang, slots=2)
    submit = desk.executor.submit

    def interrupted(works: Sequence[Work]) -> list[str]:
        signal.raise_signal(signal.SIGINT)
        return submit(works)

    desk.executor.submit = interrupted  # type: ignore[method-assign]
    with answered(), pytest.raises(KeyboardInterrupt):
        desk.run()
    assert desk.executor.stopped() == ["0", "1"]


def test_without_wait_a_call_submits_and_the_next_records(tmp_path: Path) -> None:
    cluster = lasting(slots=3)
    cluster.is_full = True
    desk = ListDesk(tmp_path, 4, executor=cluster, wait=False).run()
    assert cluster.submits == [desk.keys[:3]]
    assert desk.states() == ["running"] * 3 + ["waiting"]
    assert [how for how, _ in desk.view.said] == ["queued"] * 3
    assert "job 2" in desk.view.said[2][1]
    cluster.is_full = False
    while cluster.jobs["0"].look() == "running":
        pass
    again = ListDesk(tmp_path, 4, executor=cluster, wait=False).run()
    assert again.states()[0] == "finished"
    assert len(cluster.jobs) == 4, "points that have a job keep it"
    last = ListDesk(tmp_path, 4, executor=cluster).run()
    assert set(last.states()) == {"finished"}
    assert len(cluster.calls) == 4


def test_run_of_another_process_is_left_in_place(tmp_path: Path) -> None:
    """With fresh=true, a finished run of other code is moved away, but not while it is held."""
    desk = ListDesk(tmp_path, 1)
    desk.runs.fresh = True
    folder = tmp_path / desk.keys[0]
    finish(folder).add_provenance({"code": "0" * 64, "diff": ""})
    with holding(folder / "lock"):
        work_of(plan_of(desk.given[0]), desk.runs, "")
        assert (folder / "result.json").exists()
    for calls in (1, 0):
        again = ListDesk(tmp_path, 1)
        again.runs.fresh = True
        assert len(again.run().executor.calls) == calls
    assert [path.name for path in (tmp_path / "replaced").iterdir()] == [f"{folder.name}-1"]


def test_a_hopeless_trial_is_pruned(tmp_path: Path) -> None:
    good, bad = scored(0.5, 0.75, val=0.75), scored(0.5, 0.1, end=hang)
    pruner = optuna.pruners.ThresholdPruner(lower=20.0)
    behaviour = nth(good, bad, good)
    desk = SearchDesk(tmp_path, behaviour, pruner=pruner, objectives=UP, trials=3).run()
    assert desk.states() == ["COMPLETE", "PRUNED", "COMPLETE"]
    assert desk.trials[1].intermediate_values == {2: 50.0, 4: 10.0}
    assert desk.trials[1].user_attrs[names.REASON] == "pruned at step 4"
    assert desk.trials[0].values == [75.0]
    assert desk.executor.stopped() == ["1"]
    assert ("pruned", "pruned at step 4") in [end[1:] for end in desk.view.ends]


def test_replicates_are_averaged_and_the_first_is_reported(tmp_path: Path) -> None:
    values = {"seed=0": 0.5, "seed=1": 0.25, "seed=2": 0.75}

    def by_seed(call: Call) -> Process:
        score = values[call.words[-1]]
        return (yield from scored(score, val=score)(call))

    desk = SearchDesk(tmp_path, by_seed, objectives=UP, trials=1, replicates=3).run()
    (trial,) = desk.trials
    assert (trial.values, trial.intermediate_values) == ([50.0], {2: 50.0})
    assert [call.words[-1] for call in desk.executor.calls] == list(values)
    assert len(trial.user_attrs[names.RUNS]) == 3


def test_a_storage_that_was_away_gets_what_it_missed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = SearchDesk(tmp_path, objectives=UP, trials=1)
    tell = desk.study.tell

    def away(*_: Any, **__: Any) -> None:
        raise optuna.exceptions.StorageInternalError("no route to host")

    monkeypatch.setattr(desk.study, "tell", away)
    with pytest.raises(optuna.exceptions.StorageInternalError):
        desk.run()
    monkeypatch.setattr(desk.study, "tell", tell)
    again = SearchDesk(tmp_path, storage=desk.storage, objectives=UP, trials=1).run()
    assert (again.states(), again.executor.calls) == (["COMPLETE"], [])
