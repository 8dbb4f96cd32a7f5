"""Draws that drivers and resumed searches never repeat; nodes of samplers and pruners."""

from __future__ import annotations

import warnings
from typing import Any

import optuna
import pytest

from rgbt.checks import InputError
from sweeps.space import build_pruner, build_sampler, parse_space, trial_seed

SPACE = parse_space(
    {
        "kind": {"type": "categorical", "choices": ["a", "b"]},
        "x": {"type": "float", "low": 0.01, "high": 10, "log": True},
        "n": {"type": "int", "low": 1, "high": 40},
    }
)
START = {"n_startup_trials": 3}
EARLY = {"TPE": START, "GP": START, "NSGAII": {"population_size": 3}}


@pytest.fixture(autouse=True)
def _quiet() -> Any:
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        yield


def node(name: str, **options: Any) -> dict[str, Any]:
    """Of "TPESampler" or "MedianPruner"."""
    room = "samplers" if name.endswith("Sampler") else "pruners"
    return {"_target_": f"optuna.{room}.{name}", **options}


def search_on(storage: Any, objectives: int = 1) -> optuna.Study:
    """What a driver opens: a study of a storage."""
    directions = ["minimize"] * objectives
    study: optuna.Study = optuna.create_study(
        storage=storage, study_name="s", load_if_exists=True, directions=directions
    )
    return study


def ask(study: optuna.Study, name: str) -> optuna.Trial:
    sampler = node(f"{name}Sampler", seed=7, **EARLY.get(name, {}))
    study.sampler = build_sampler(sampler, len(study.trials))
    return study.ask(SPACE)


@pytest.mark.parametrize(
    ("name", "objectives"),
    [
        *(("TPE", 1), ("TPE", 2), ("Random", 1), ("NSGAII", 1), ("NSGAII", 2)),
        *(pytest.param("GP", count, marks=pytest.mark.slow) for count in (1, 2)),
    ],
)
def test_sampler_resumed_search_repeats_draws(name: str, objectives: int) -> None:
    def step(study: optuna.Study) -> None:
        trial = ask(study, name)
        values = trial.params
        study.tell(trial, [values["x"], values["n"] - values["x"]][:objectives])

    whole = search_on(None, objectives)
    for _ in range(8):
        step(whole)
    storage = optuna.storages.InMemoryStorage()
    for trials in (2, 1, 3, 2):
        resumed = search_on(storage, objectives)
        for _ in range(trials):
            step(resumed)
    found, repeated = ([trial.params for trial in study.trials] for study in (whole, resumed))
    assert found == repeated
    assert len({point["x"] for point in found}) > 4


def test_sampler_concurrent_trials_differ_and_keep_own_draws() -> None:
    """Asked together or one by one, told in any order: random points are those of their numbers."""
    together, single = search_on(None), search_on(None)
    running = [ask(together, "Random") for _ in range(4)]
    for trial in running[2:] + running[:2]:
        together.tell(trial, 1.0)
    for _ in range(4):
        single.tell(ask(single, "Random"), 1.0)
    assert [trial.params for trial in together.trials] == [trial.params for trial in single.trials]
    assert len({trial.params["x"] for trial in single.trials}) == 4


def test_trial_seed_differs_by_seed_and_number() -> None:
    assert len({trial_seed(seed, number) for seed in range(30) for number in range(30)}) == 900
    assert trial_seed(0, 0) == 0x8E2D0AA6  # printf 0:trial:0 | sha256sum


@pytest.mark.parametrize(
    ("wrong", "key"),
    [
        (node("QMCSampler"), "_target_"),
        (node("TPESampler", n_startup=3), "n_startup"),
        (node("TPESampler", seed="x"), "seed"),
        (node("TPESampler", group=True, multivariate=False), ""),
        (node("MeanPruner"), "_target_"),
        (node("PercentilePruner"), "percentile"),
        (node("PercentilePruner", percentile=200.0), ""),
    ],
)
def test_sampler_and_pruner_mistakes_are_refused(wrong: dict[str, Any], key: str) -> None:
    what = "pruner" if "Pruner" in wrong.get("_target_", "") else "sampler"
    with pytest.raises(InputError, match=f"hydra.sweeper.{what}.{key}"):
        build_pruner(wrong) if what == "pruner" else build_sampler(wrong, 0)


def test_options_reach_optuna() -> None:
    sampler: Any = build_sampler(node("NSGAIISampler", population_size=6, seed=3), 0)
    assert sampler.population_size == 6
    inner = node("MedianPruner", n_startup_trials=9)
    pruner: Any = build_pruner(node("PatientPruner", patience=1, wrapped_pruner=inner))
    assert pruner._wrapped_pruner._n_startup_trials == 9
    assert isinstance(build_pruner(None), optuna.pruners.NopPruner)
