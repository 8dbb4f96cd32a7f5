"""Draws that drivers and resumed searches never repeat; pruners on reports of validations."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import optuna
import pytest
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from rgbt.checks import InputError
from sweeps.space.per_trial import trial_seed
from sweeps.space.samplers import PRUNERS, SAMPLERS, build_pruner, build_sampler
from sweeps.space.space import parse_space, suggest

SPACE = parse_space(
    {
        "kind": {"type": "categorical", "choices": ["a", "b"]},
        "x": {"type": "float", "low": 0.01, "high": 10, "log": True},
        "n": {"type": "int", "low": 1, "high": 40, "when": {"kind": "b"}},
    }
)
EARLY = {
    "tpe": {"n_startup_trials": 3},
    "gp": {"n_startup_trials": 3},
    "nsga2": {"population_size": 3},
}


@pytest.fixture(autouse=True)
def _quiet() -> Any:
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        yield


def study_on(storage: Any, kind: str, objectives: int = 1) -> optuna.Study:
    """What a driver opens: a study of its own on a storage that all share."""
    return optuna.create_study(
        storage=storage,
        study_name="s",
        load_if_exists=True,
        directions=["minimize"] * objectives,
        sampler=build_sampler({"kind": kind, "seed": 7, **EARLY.get(kind, {})}, objectives),
    )


def step(study: optuna.Study) -> None:
    trial = study.ask()
    values = suggest(trial, SPACE)
    x, n = float(values["x"]), float(values.get("n", 0))  # type: ignore[arg-type]
    study.tell(trial, [x, -x + n][: len(study.directions)])


def points(study: optuna.Study) -> list[dict[str, Any]]:
    return [trial.params for trial in study.get_trials()]


@pytest.mark.parametrize(
    ("kind", "objectives"),
    [
        *(("tpe", 1), ("tpe", 2), ("random", 1), ("nsga2", 1), ("nsga2", 2)),
        *(pytest.param("gp", count, marks=pytest.mark.slow) for count in (1, 2)),
    ],
)
def test_sampler_resumed_search_repeats_draws(kind: str, objectives: int) -> None:
    whole = study_on(optuna.storages.InMemoryStorage(), kind, objectives)
    for _ in range(8):
        step(whole)
    storage = optuna.storages.InMemoryStorage()
    for trials in (2, 1, 3, 2):
        resumed = study_on(storage, kind, objectives)
        for _ in range(trials):
            step(resumed)
    assert points(resumed) == points(whole)
    assert len({point["x"] for point in points(whole)}) > 4


@pytest.mark.parametrize("kind", ["tpe", "random"])
def test_sampler_shared_seed_draws_differ(kind: str, tmp_path: Path) -> None:
    path = str(tmp_path / "journal")
    journals = [JournalFileBackend(path) for _ in range(3)]
    drivers = [study_on(optuna.storages.JournalStorage(one), kind) for one in journals]
    for _ in range(6):
        running = [(study, study.ask()) for study in drivers]
        for study, trial in running:
            study.tell(trial, float(suggest(trial, SPACE)["x"]))  # type: ignore[arg-type]
    assert len({point["x"] for point in points(drivers[0])}) == 18


def test_sampler_concurrent_trials_keep_own_draws() -> None:
    """Asked together or one by one, told in any order: random points are those of their numbers."""
    together, single = (study_on(optuna.storages.InMemoryStorage(), "random") for _ in range(2))
    running = [together.ask() for _ in range(4)]
    for trial in reversed(running):
        suggest(trial, SPACE)
    for trial in running[2:] + running[:2]:
        together.tell(trial, 1.0)
    for _ in range(4):
        step(single)
    assert points(together) == points(single)


def test_sampler_ends_trial_of_other_driver() -> None:
    storage = optuna.storages.InMemoryStorage()
    number = study_on(storage, "tpe").ask().number
    adopter = study_on(storage, "tpe")
    adopter.tell(number, 1.0)
    assert adopter.trials[number].state == TrialState.COMPLETE


def test_seeds_differ_and_are_reproducible() -> None:
    seeds = {trial_seed(seed, number) for seed in range(30) for number in range(30)}
    assert len(seeds) == 900
    assert all(0 <= seed < 2**32 for seed in seeds)
    assert trial_seed(0, 0) == 0x8E2D0AA6  # printf 0:trial:0 | sha256sum


@pytest.mark.parametrize(
    ("build", "kind", "options", "word"),
    [
        (build_sampler, "tpee", {}, "'tpe'"),
        (build_sampler, "qmc", {}, "not a valid choice"),
        (build_sampler, "tpe", {"n_startup": 3}, "'n_startup_trials'"),
        (build_sampler, "tpe", {"seed": "x"}, "sampler.seed"),
        (build_sampler, "tpe", {"gamma": 3}, "sampler.gamma"),
        (build_sampler, "tpe", {"n_startup_trials": "ten"}, "expected int"),
        (build_sampler, "tpe", {"multivariate": 1}, "expected bool | null"),
        (build_sampler, "tpe", {"group": True, "multivariate": False}, "does not accept"),
        (build_sampler, "random", {"n_startup_trials": 3}, "it has none"),
        (build_sampler, "nsga2", {"population_size": 1}, "does not accept"),
        (build_pruner, "medain", {}, "'median'"),
        (build_pruner, "median", {"warmup": 3}, "'n_warmup_steps'"),
        (build_pruner, "percentile", {}, "needs the option 'percentile'"),
        (build_pruner, "percentile", {"percentile": 200.0}, "does not accept"),
        (build_pruner, "patient", {"patience": 1.5}, "expected int"),
        (build_pruner, "patient", {"patience": 1, "wrapped_pruner": None}, "is not an option"),
        (build_pruner, "none", {"n_startup_trials": 3}, "it has none"),
    ],
)
def test_sampler_and_pruner_mistakes_are_refused(
    build: Any, kind: str, options: dict[str, Any], word: str
) -> None:
    with pytest.raises(InputError) as error:
        build({"kind": kind, **options})
    assert word in str(error.value)


def test_cmaes_is_an_extra_for_one_objective(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="pip install cmaes"):
        build_sampler({"kind": "cmaes"})
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    with pytest.raises(InputError, match="supports one objective, but this search has 2"):
        build_sampler({"kind": "cmaes"}, objectives=2)


def test_options_reach_optuna() -> None:
    sampler = build_sampler({"kind": "nsga2", "population_size": 6})
    assert sampler.make(0).population_size == 6  # type: ignore[attr-defined]
    pruner = build_pruner({"kind": "median", "n_startup_trials": 9})
    assert pruner._n_startup_trials == 9  # type: ignore[attr-defined]
    assert set(SAMPLERS) == {"tpe", "random", "gp", "nsga2", "cmaes"}


OPTIONS: dict[str, dict[str, Any]] = {
    "median": {"n_startup_trials": 2},
    "percentile": {"percentile": 40.0, "n_startup_trials": 2},
    "successive_halving": {"min_resource": 120},
    "hyperband": {"min_resource": 120, "max_resource": 960},
    "patient": {"patience": 2},
    "none": {},
}


def curve(quality: int, at: int, kind: str) -> float:
    """A score at a step: what is good rises, what is bad falls after its third report."""
    return (
        quality - at / 100 if kind == "patient" and at > 360 and quality < 0 else quality + at / 100
    )


@pytest.mark.parametrize("kind", sorted(PRUNERS))
def test_pruners_stop_bad_trials_at_validation_steps(kind: str) -> None:
    """Reports every 120 steps: the good trials end, of the bad ones some do not."""
    study = optuna.create_study(
        direction="maximize", study_name="p", pruner=build_pruner({"kind": kind, **OPTIONS[kind]})
    )
    states: dict[int, list[TrialState]] = {}
    for number in range(24):
        trial, quality = study.ask(), 50 if number % 4 == 0 else -number
        steps = iter(range(120, 961, 120))
        pruned = False
        while not pruned and (at := next(steps, None)):
            trial.report(curve(quality, at, kind), at)
            pruned = trial.should_prune()
        study.tell(trial, None if pruned else quality, TrialState.PRUNED if pruned else None)
        states.setdefault(quality == 50, []).append(study.trials[-1].state)
    assert set(states[True]) == {TrialState.COMPLETE}
    assert (TrialState.PRUNED in states[False]) == (kind != "none")


def test_pruners_need_one_objective() -> None:
    with pytest.raises(InputError, match="this search has 2 objectives"):
        build_pruner({"kind": "median"}, objectives=2)
    assert isinstance(build_pruner(None, objectives=2), optuna.pruners.NopPruner)


def test_the_modules_are_light() -> None:
    """What a command imports to say --help or to show a mistake loads neither optuna nor torch."""
    code = (
        "import sys, sweeps.space.space;"
        "import sweeps.space.grid, sweeps.space.samplers;"
        "print([name for name in ('optuna', 'torch', 'mlflow') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
