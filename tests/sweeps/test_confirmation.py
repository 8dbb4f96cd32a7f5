"""A search confirms its best points: which points, with which seeds, when it stops."""

from __future__ import annotations

import itertools
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import optuna
import pytest

import sweeps.candidates as choosing
from rgbt.checks import InputError
from rgbt.tables import TextTable
from rgbt.tracking.mlflow_store import NoTracking
from sweeps import attributes as names
from sweeps.candidates import Candidates, check_confirmable, chosen_overrides, score_file
from sweeps.confirmation import confirm, preview_line
from sweeps.report.study_data import importances, read
from sweeps.report.tables import tables
from sweeps.settings import Confirm, Objective, SweepSettings
from sweeps.space.space import parse_space
from sweeps.study import confirmation_lines
from sweeps.verdicts.best_point import ScoreFile
from sweeps.worker import driver as drivers
from sweeps.worker import point_list
from sweeps.worker.run_store import RunStore
from sweeps.worker.storage import load_study, open_storage, open_study
from sweeps.worker.trial_store import Owner, counted_trials
from tests.sweeps.fakes import Behaviour, Call, FakeExecutor, FakePlanner, Process, fail, quick
from tests.sweeps.fakes import settings as plain_settings
from tests.sweeps.verdicts.planted import finish_planted

__all__ = ["quick"]
pytestmark = pytest.mark.usefixtures("quick")

SPACE = parse_space({"x": {"type": "float", "low": 0, "high": 1}})
ACCURACY = Objective("val/pixel_accuracy", "maximize")
VAR = Objective("val/Var", "minimize")
CLEAR = {0.1: 60.0, 0.2: 70.0, 0.3: 80.0}
TIED = {0.1: 60.0, 0.2: 70.0, 0.3: 70.0}
"""x -> mean accuracy of its runs; the best of the search is x=0.2."""


@pytest.fixture(autouse=True)
def composed(monkeypatch: pytest.MonkeyPatch) -> None:
    """No configuration is composed; runs without `seed` have seed 0 and select on val."""
    trainer = SimpleNamespace(selection_split="val")
    spec = SimpleNamespace(seed=0, trainer=trainer)
    monkeypatch.setattr(choosing, "specify_run", lambda overrides: spec)
    monkeypatch.setattr(point_list, "Planner", lambda base: FakePlanner())


def settings(best: int = 3, max_seeds: int = 8, **changes: Any) -> SweepSettings:
    confirmed = Confirm(best=best, max_seeds=max_seeds)
    given = {"trials": 4, "objectives": (ACCURACY,), "confirm": confirmed, **changes}
    return plain_settings(**given)


def make_study(
    runs_dir: Path, wanted: SweepSettings, found: Mapping[float, Sequence[float]]
) -> optuna.Study:
    """A complete search with these values, and a trial that repeats its first point."""
    storage = open_storage(None, runs_dir)
    study = open_study("s", storage, wanted.objectives, {names.KIND: "search"})
    distributions = {"x": optuna.distributions.FloatDistribution(0, 1)}
    for x, values in [*found.items(), next(iter(found.items()))]:
        attributes = {names.KEY: f"key of {x}", names.SECONDS: 60.0}
        study.add_trial(
            optuna.trial.create_trial(
                params={"x": x}, distributions=distributions, values=values, user_attrs=attributes
            )
        )
    return study


FOUND = {x: [value] for x, value in ((0.1, 71.0), (0.2, 73.0), (0.3, 72.0), (0.4, 60.0))}
"""x of a trial -> its value in the search: the best is 0.2."""


def planted_runs(means: Mapping[float, float]) -> Behaviour:
    """Runs whose accuracy is planted by x and the seed."""

    def process(call: Call) -> Process:
        yield
        x = call.value("x")
        finish_planted(call.folder, means[float(x)], x, int(call.value("seed")))
        return 0

    return process


def confirmed(
    runs_dir: Path, behaviour: Behaviour, monkeypatch: pytest.MonkeyPatch, wanted: SweepSettings
) -> FakeExecutor:
    """Confirm the search of a folder; returns what ran its processes."""
    executor = FakeExecutor(runs_dir, behaviour)
    monkeypatch.setattr(drivers, "LocalExecutor", lambda workers: executor)
    study = load_study("s", open_storage(None, runs_dir))
    candidates = Candidates.of(study, ("a=1",), SPACE, wanted)
    confirm(study, candidates, RunStore(runs_dir, NoTracking()), wanted)
    return executor


def seeds_of(executor: FakeExecutor) -> dict[float, list[int]]:
    """x -> seeds of its runs, in order."""
    seeds: dict[float, list[int]] = {}
    for call in executor.calls:
        seeds.setdefault(float(call.value("x")), []).append(int(call.value("seed")))
    return {x: sorted(seeds[x]) for x in sorted(seeds)}


def table_of(runs_dir: Path) -> TextTable:
    data = read(optuna.load_study(study_name="s", storage=open_storage(None, runs_dir)))
    assert data.confirmation is not None
    assert data.confirmation in tables(data, importances(data))
    return data.confirmation


def cells(table: TextTable, name: str) -> list[str]:
    return [row[table.header.index(name)] for row in table.rows]


def test_candidates_are_the_best_distinct_points_with_unused_seeds(tmp_path: Path) -> None:
    study = make_study(tmp_path, settings(), FOUND)
    found = Candidates.of(study, ("a=1",), SPACE, settings(best=4))
    assert [each.label for each in found.points] == ["#1 x=0.2", "#2 x=0.3", "#0 x=0.1", "#3 x=0.4"]
    assert found.points[0].overrides == ("a=1", "x=0.2")
    assert found.points[0].file == ScoreFile(metric="pixel_accuracy", path="counts_val.npz")
    assert (found.points[0].found, found.trials) == (73.0, 5)
    assert found.seeds == range(1, 9)
    replicated = Candidates.of(study, (), SPACE, settings(best=2, replicates=3))
    assert (len(replicated.points), replicated.seeds) == (2, range(3, 11))


def test_candidates_of_two_objectives_are_of_the_pareto_front(tmp_path: Path) -> None:
    both = (ACCURACY, VAR)
    found = {0.1: [70.0, 5.0], 0.2: [73.0, 9.0], 0.3: [72.0, 9.5], 0.4: [60.0, 1.0]}
    study = make_study(tmp_path, settings(objectives=both), found)
    chosen = Candidates.of(study, (), SPACE, settings(best=3, objectives=both))
    assert [each.label for each in chosen.points] == ["#1 x=0.2", "#0 x=0.1", "#3 x=0.4"]


def test_chosen_overrides_leave_out_conditional_parameters() -> None:
    space = parse_space(
        {
            "loss": {"type": "categorical", "choices": ["a", "b"]},
            "alpha": {"type": "float", "low": 0, "high": 1, "when": {"loss": "b"}},
        }
    )
    kinds: Any = {"loss": optuna.distributions.CategoricalDistribution(("a", "b"))}
    trial = optuna.trial.create_trial(params={"loss": "a"}, distributions=kinds, value=1.0)
    assert chosen_overrides(trial, space) == ("loss=a",)


@pytest.mark.parametrize(
    ("metric", "score", "path"),
    [
        ("val/Var", "Var", "counts_own.npz"),
        ("val/night/mIoU", "night/mIoU", "counts_own.npz"),
        ("test/mIoU", "mIoU", "counts_test.npz"),
        ("val/TC/aligned", "TC", "evaluations/consistency_aligned_own.npz"),
        ("test/CA/released", "CA_released", "evaluations/consistency_released_test.npz"),
    ],
)
def test_score_file_of_an_objective(metric: str, score: str, path: str) -> None:
    consistency = SimpleNamespace(build=lambda: SimpleNamespace(mark=""))
    trainer = SimpleNamespace(selection_split="own")
    spec: Any = SimpleNamespace(trainer=trainer, consistency=consistency)
    assert score_file(Objective(metric, "maximize"), spec) == ScoreFile(metric=score, path=path)


@pytest.mark.parametrize(
    ("changes", "space", "said"),
    [
        ({"trials": None, "hours": 1.0}, "x", "set the number of trials"),
        ({"max_seeds": 4}, "x", "fewer than 5 seeds never show which of 3 points"),
        ({}, "seed", "remove it from the space"),
    ],
)
def test_confirmation_that_is_impossible_is_refused(
    changes: dict[str, Any], space: str, said: str
) -> None:
    parameters = parse_space({space: {"type": "int", "low": 0, "high": 1}})
    with pytest.raises(InputError, match=said):
        check_confirmable(settings(**changes), parameters)
    check_confirmable(settings(), SPACE)
    check_confirmable(settings(best=0, **changes), parameters)


def test_confirm_one_point_is_refused() -> None:
    with pytest.raises(InputError, match="expected 2 or more points"):
        Confirm(best=1, max_seeds=10)


def test_confirm_clear_points_stops_early_and_corrects_the_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = settings()
    make_study(tmp_path, wanted, FOUND)
    executor = confirmed(tmp_path, planted_runs(CLEAR), monkeypatch, wanted)
    assert seeds_of(executor) == {x: [1, 2, 3, 4, 5] for x in CLEAR}
    assert all("a=1" in call.words for call in executor.calls)
    table = table_of(tmp_path)
    assert cells(table, "point") == ["#2 x=0.3", "#1 x=0.2", "#0 x=0.1"]
    assert cells(table, "in the search") == ["72.00", "73.00", "71.00"]
    assert cells(table, "result") == ["best", "worse than #2", "worse than #2"]
    assert table.notes[0] == "Confirmed: #2 x=0.3 is better than each of the other 2 points."
    assert "97.5 % interval" in table.header
    again = confirmed(tmp_path, planted_runs(CLEAR), monkeypatch, wanted)
    assert again.calls == []


def test_confirm_tied_points_get_all_seeds_and_a_bad_one_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = settings()
    study = make_study(tmp_path, wanted, FOUND)
    executor = confirmed(tmp_path, planted_runs(TIED), monkeypatch, wanted)
    assert seeds_of(executor) == {0.1: [1, 2, 3, 4, 5], 0.2: [*range(1, 9)], 0.3: [*range(1, 9)]}
    table = table_of(tmp_path)
    assert cells(table, "further seeds") == ["8", "8", "5"]
    assert cells(table, "result")[:2] == ["undecided", "undecided"]
    assert cells(table, "result")[2].startswith("worse than #")
    assert table.notes[0].startswith("Not confirmed: 8 seeds do not show which of #1, #2 is")
    more = confirmed(tmp_path, planted_runs(TIED), monkeypatch, settings(max_seeds=9))
    assert seeds_of(more) == {0.2: [9], 0.3: [9]}, "a larger number continues"
    line = preview_line(study, settings(max_seeds=9), RunStore(tmp_path, NoTracking()))
    assert "at most 4 further runs, 4 min (23 are finished)" in line


def test_confirm_point_with_a_failed_run_is_not_extended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def behaviour(call: Call) -> Process:
        bad = call.value("x") == "0.3" and call.value("seed") == "4"
        return fail(call) if bad else planted_runs(TIED)(call)

    make_study(tmp_path, settings(), FOUND)
    executor = confirmed(tmp_path, behaviour, monkeypatch, settings())
    assert seeds_of(executor) == {x: [1, 2, 3, 4, 5] for x in TIED}
    note = table_of(tmp_path).notes[0]
    assert note.startswith("Not confirmed: of #2 x=0.3, a run failed: ValueError: a bad day")


def test_confirm_budget_spent_says_that_runs_are_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = settings(max_failures=1)
    make_study(tmp_path, wanted, FOUND)
    confirmed(tmp_path, fail, monkeypatch, wanted)
    assert table_of(tmp_path).notes[0].startswith("Not confirmed yet: further runs are needed")


def test_confirm_without_counts_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def without(call: Call) -> Process:
        code = yield from planted_runs(CLEAR)(call)
        (call.folder / "counts_val.npz").unlink()
        return code

    make_study(tmp_path, settings(), FOUND)
    executor = confirmed(tmp_path, without, monkeypatch, settings())
    assert len(executor.calls) == 15
    note = table_of(tmp_path).notes[0]
    assert note.startswith("Not confirmed: ")
    assert "counts_val.npz" in note


def test_two_drivers_share_a_confirmation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = settings()
    make_study(tmp_path, wanted, FOUND)
    executors: list[FakeExecutor] = []

    def local(workers: int) -> FakeExecutor:
        del workers
        executors.append(FakeExecutor(tmp_path, planted_runs(TIED)))
        return executors[-1]

    numbers = itertools.count()
    monkeypatch.setattr(drivers, "LocalExecutor", local)
    monkeypatch.setattr(
        point_list.Owner, "this_process", lambda: Owner(f"machine {next(numbers)}", 1, "1")
    )

    def drive() -> None:
        study = load_study("s", open_storage(None, tmp_path))
        candidates = Candidates.of(study, (), SPACE, wanted)
        confirm(study, candidates, RunStore(tmp_path, NoTracking()), wanted)

    threads = [threading.Thread(target=drive) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    every = Counter(call.words for executor in executors for call in executor.calls)
    assert set(every.values()) == {1}, "no run is made twice"
    assert 5 + 8 + 8 <= len(every) <= 6 + 8 + 8, "one seed ahead, where a worker is free"
    assert cells(table_of(tmp_path), "further seeds")[:2] == ["8", "8"]
    study = optuna.load_study(study_name="s confirmed", storage=open_storage(None, tmp_path))
    states = Counter(trial.state.name for trial in counted_trials(study))
    assert states == {"COMPLETE": len(every)}


def test_search_and_confirmation_name_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_study(tmp_path, settings(), FOUND)
    confirmed(tmp_path, planted_runs(CLEAR), monkeypatch, settings())
    storage = open_storage(None, tmp_path)
    lines = [
        confirmation_lines(read(optuna.load_study(study_name=name, storage=storage)))
        for name in ("s", "s confirmed")
    ]
    assert lines == [
        ["Runs of the confirmation: rgbt study 'name=s confirmed'"],
        ["The search that these runs confirm: rgbt study name=s"],
    ]
