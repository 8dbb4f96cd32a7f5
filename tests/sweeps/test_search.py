"""A search: what is refused before the first trial, what must not change, how it ends."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import sweeps.search as searching
from rgbt.checks import InputError, RunError
from rgbt.config.compose import compose
from sweeps import attributes as names
from sweeps.search import Search, _probe, search
from sweeps.settings import Objective, SweepSettings
from sweeps.space.space import parse_space
from sweeps.worker.run_store import open_run_store
from sweeps.worker.storage import load_study, open_storage
from sweeps.worker.trial_store import TrialStore
from tests.sweeps.fakes import settings as plain_settings

SPACE = {"masker.sigma_div": {"type": "float", "low": 1, "high": 4}}
SMALL = ("dataset.num_train=4", "dataset.num_val=2", "dataset.num_test=2")


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> str:
    return f"dataset.cache_dir={tmp_path_factory.mktemp('cache')}"


@pytest.fixture
def wanted(tmp_path: Path, cache: str) -> Search:
    place = (f"runs_dir={tmp_path}", "tracking=none", cache)
    fixed = ("+experiment=grbm", *SMALL, *place)
    return Search("s", fixed, parse_space(SPACE), open_run_store(compose(place)), [])


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The states that the driver leaves trials in, instead of running them."""
    states: list[str] = ["COMPLETE"]

    def drive(wanted: Search, settings: SweepSettings, store: TrialStore) -> None:
        del wanted, settings
        for state in states:
            trial = store.ask(None)
            assert trial is not None
            trial.suggest_float("masker.sigma_div", 1, 4)
            if state == "COMPLETE":
                store.complete(trial.number, [1.0], {names.RUNS: ["k"]})
            else:
                store.fail(trial.number, "no memory", {})

    monkeypatch.setattr(searching, "_drive", drive)
    monkeypatch.setattr(searching, "report", lambda *_: [("report", "here")])
    return states


def settings(**changes: Any) -> SweepSettings:
    objectives = (Objective("val/mIoU", "maximize"),)
    return plain_settings(**{"trials": 3, "objectives": objectives, **changes})


def test_search_creates_study_with_its_attributes(
    wanted: Search, ends: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.orig_argv", ["python", "x=postgresql://me:secret@host/db"])
    search(wanted, settings())
    study = load_study("s", open_storage(None, tmp_path))
    assert study.user_attrs[names.KIND] == "search"
    assert "secret" not in study.user_attrs[names.COMMAND]
    search(wanted, settings(trials=9))  # a larger budget is the same study
    assert len(study.trials) == 2


@pytest.mark.parametrize("other", ["space", "identity", "data", "objectives"])
def test_search_with_other_identity_is_refused(wanted: Search, ends: list[str], other: str) -> None:
    search(wanted, settings())
    space = {"masker.sigma_div": {"type": "float", "low": 1, "high": 8}}
    changed: dict[str, dict[str, Any]] = {
        "space": {"parameters": parse_space(space)},
        "identity": {"identity": ["trainer.max_steps=3"]},
        "data": {"fixed": (*wanted.fixed, "dataset.num_test=3")},
        "objectives": {},
    }
    kept = {"objectives": (Objective("val/Var", "minimize"),)} if other == "objectives" else {}
    with pytest.raises(InputError, match="a study 's' with"):
        search(replace(wanted, **changed[other]), settings(**kept))


TC = (Objective("val/TC/aligned", "maximize"),)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"trials": None}, "needs a budget"),
        ({"retry": "failed"}, "retry=failed is for grids"),
        ({"sampler": {"seed": 1}}, "sampler: 'kind' has no value"),
        ({"sampler": {"kind": "tpe", "seed": "x"}}, "sampler.seed: expected a whole number"),
        ({"objectives": TC, "pruner": {"kind": "median"}}, "known only at the end"),
        ({"objectives": TC}, r"add consistency=views 'consistency.splits=\[val,test\]'"),
    ],
)
def test_search_invalid_settings_raise_before_study_exists(
    wanted: Search, ends: list[str], tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(InputError, match=said):
        search(wanted, settings(**changes))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("low", "high", "refused"), [(-1, 4, "low"), (1, 10**6, "high"), (0.5, 32, None)]
)
def test_search_range_outside_setting_raises(
    wanted: Search, low: float, high: float, refused: str | None
) -> None:
    space = {"masker.sigma_div": {"type": "float", "low": low, "high": high}}
    search = replace(wanted, parameters=parse_space(space))
    if refused is None:
        assert _probe(search, settings()).key
        return
    with pytest.raises(InputError, match=r"'masker.sigma_div'"):
        _probe(search, settings())


def test_search_without_finished_trial_raises(
    wanted: Search, ends: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    ends[:] = ["FAIL", "FAIL"]
    with pytest.raises(RunError, match="no trial of s has finished"):
        search(wanted, settings())
    assert "trial 1 failed: no memory" in capsys.readouterr().err


def test_preview_shows_missing_points_and_writes_nothing(
    wanted: Search, ends: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    search(wanted, settings(dry_run=True))
    assert list(tmp_path.iterdir()) == []
    assert "3 of 3 trials would be run" in capsys.readouterr().out
    search(wanted, settings())
    capsys.readouterr()
    search(wanted, settings(dry_run=True))
    assert "2 of 3 trials would be run" in capsys.readouterr().out
