"""Points of ``-m`` from overrides and settings: grids, lists and searches, without running them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hydra
import pytest
from hydra.core.global_hydra import GlobalHydra
from omegaconf import open_dict

import sweeps.sweep as sweeping
from rgbt.checks import InputError, RunError
from rgbt.config.compose import conf_dir, register_resolvers
from sweeps.point import Outcome, Point
from sweeps.search import Search
from sweeps.settings import SweepSettings
from sweeps.sweep import study_command, sweep
from sweeps.worker import point_list
from sweeps.worker.point_list import PointList


class RecordedCalls:
    """What would have been run."""

    def __init__(self) -> None:
        self.lists: list[PointList] = []
        self.searches: list[Search] = []
        self.outcomes: list[Outcome] = []


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> RecordedCalls:
    found = RecordedCalls()

    def run_points(wanted: PointList, settings: SweepSettings, *, strict: bool) -> list[Outcome]:
        assert strict, "a wrong point of a grid is refused"
        del settings
        found.lists.append(wanted)
        return found.outcomes or [Outcome(point, "finished") for point in wanted.points]

    def preview_points(wanted: PointList, settings: SweepSettings) -> list[Outcome]:
        del settings
        return found.outcomes or [Outcome(p, "waiting", keys=("k",)) for p in wanted.points]

    monkeypatch.setattr(sweeping, "run_points", run_points)
    monkeypatch.setattr(sweeping, "preview_points", preview_points)
    monkeypatch.setattr(sweeping, "search", lambda wanted, settings: found.searches.append(wanted))
    return found


def call(runs: Path, *words: str, **settings: Any) -> None:
    """What Hydra does with ``-m`` and these words, up to our sweeper."""
    register_resolvers()
    task = [f"runs_dir={runs}", "tracking=none", *words]
    single = [word for word in task if "," not in word and "interval" not in word]
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        config = hydra.compose("config", ["hydra/sweeper=study", *single], return_hydra_config=True)
        with open_dict(config):
            for key, value in settings.items():
                config.hydra.sweeper[key] = value
        sweep(task, config, loader)


def test_a_grid_is_all_combinations_each_with_its_parameters(
    calls: RecordedCalls, tmp_path: Path
) -> None:
    call(tmp_path, "+experiment=grbm", "masker.sigma_div=1,2", "seed=0,3")
    (wanted,) = calls.lists
    assert [point.label for point in wanted.points] == [
        *("sigma_div=1 seed=0", "sigma_div=1 seed=3", "sigma_div=2 seed=0", "sigma_div=2 seed=3"),
    ]
    assert wanted.points[3].params == {"masker.sigma_div": 2, "seed": 3}
    assert "+experiment=grbm" in wanted.points[0].overrides
    assert set(wanted.distributions or {}) == {"masker.sigma_div", "seed"}
    assert wanted.kind == "grid"


def test_points_are_run_for_every_value_of_the_grid(calls: RecordedCalls, tmp_path: Path) -> None:
    points = [["masker.sigma_div=1", "masker.patch_size=8"], ["masker.sigma_div=4"]]
    call(tmp_path, "+experiment=grbm", "seed=0,1", points=points)
    (wanted,) = calls.lists
    assert wanted.kind == "list"
    assert [point.label for point in wanted.points] == [
        *("seed=0 sigma_div=1 patch_size=8", "seed=0 sigma_div=4"),
        *("seed=1 sigma_div=1 patch_size=8", "seed=1 sigma_div=4"),
    ]


def test_sweep_params_of_file_equal_typed(calls: RecordedCalls, tmp_path: Path) -> None:
    params = {"masker.sigma_div": "1,2", "model.weights": None, "seed": 5}
    call(tmp_path, "+experiment=grbm", params=params)
    (wanted,) = calls.lists
    assert len(wanted.points) == 2
    assert {"model.weights=null", "seed=5"} <= set(wanted.points[0].overrides)


def test_sweep_name_is_independent_of_paths(calls: RecordedCalls, tmp_path: Path) -> None:
    words = ("+experiment=grbm", "masker.sigma_div=1,2")
    call(tmp_path / "a", *words)
    call(tmp_path / "b", *words, "fresh=true", "dataset.cache_dir=/c")
    call(tmp_path / "a", *words, "trainer.max_steps=3")
    first, moved, other = (wanted.study for wanted in calls.lists)
    assert first == moved != other
    assert first.startswith("grbm-sigma_div-")


def test_sweep_fresh_is_not_passed_to_runs(calls: RecordedCalls, tmp_path: Path) -> None:
    call(tmp_path, "+experiment=grbm", "masker.sigma_div=1,2", "fresh=true")
    (wanted,) = calls.lists
    assert wanted.runs.fresh
    assert not any(word.startswith("fresh") for point in wanted.points for word in point.overrides)


def test_sweep_search_name_ignores_order(calls: RecordedCalls, tmp_path: Path) -> None:
    words = ("+experiment=grbm", "masker.sigma_div=interval(1,4)", "seed=1", "trainer.max_steps=3")
    call(tmp_path, *words, trials=3)
    call(tmp_path, *reversed(words), "fresh=true", trials=3)
    call(tmp_path, *words, trials=3, replicates=2)
    first, same, other = calls.searches
    assert first.study == same.study != other.study
    assert first.identity == same.identity
    assert "trainer.max_steps=3" in first.identity


def test_sweep_search_file_runs_are_single(calls: RecordedCalls, tmp_path: Path) -> None:
    call(tmp_path, "+search=grbm", "masker.sigma_div=4")
    (wanted,) = calls.searches
    keys = [parameter.key for parameter in wanted.parameters]
    assert keys == ["masker.patch_size", "loss.spatial.alpha"]
    assert "hydra.mode=RUN" in wanted.fixed
    assert "masker.sigma_div=4" in wanted.fixed
    call(tmp_path, "+search=grbm", "masker.sigma_div=1,2")
    assert not [word for word in calls.searches[1].fixed if "sigma_div" in word]


@pytest.mark.parametrize(
    "settings",
    [
        *({"trials": 3}, {"hours": 3}, {"replicates": 2}, {"pruner": {"kind": "median"}}),
    ],
)
def test_sweep_search_settings_of_grid_are_refused(
    calls: RecordedCalls, tmp_path: Path, settings: dict[str, Any]
) -> None:
    said = f"hydra.sweeper.{next(iter(settings))} is for searches"
    with pytest.raises(InputError, match=said):
        call(tmp_path, "+experiment=grbm", "seed=0,1", **settings)
    assert calls.lists == []


def test_mistake_is_reported_before_any_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A slow machine plans one point in the usual 2 s.
    monkeypatch.setattr(point_list, "PLANNED_FIRST_S", 60.0)
    with pytest.raises(InputError, match="masker=squre: there is no masker 'squre'"):
        call(tmp_path, "+experiment=grbm", "masker=square,squre")
    assert not any(tmp_path.iterdir())


def test_failed_points_end_in_an_error_after_the_table(
    calls: RecordedCalls, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calls.outcomes = [
        Outcome(Point("a", ()), "finished", keys=("k1",)),
        Outcome(Point("b", ()), "failed", "out of memory", keys=("k2",)),
    ]
    with pytest.raises(RunError, match="1 of 2 points failed, first b: out of memory"):
        call(tmp_path, "+experiment=grbm", "seed=0,1")
    assert "out of memory" in capsys.readouterr().out


def test_a_preview_runs_nothing(
    calls: RecordedCalls, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call(tmp_path, "+experiment=grbm", "seed=0,1,2", dry_run=True)
    assert calls.lists == []
    assert "3 of 3 points would be run" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("runs_dir", "storage", "rest"),
    [
        ("runs", None, ""),
        ("/data/my runs", None, " 'runs_dir=/data/my runs'"),
        ("runs", "postgresql://me:Secret@host/db", " 'storage=postgresql://me:***@host/db'"),
    ],
)
def test_the_command_that_draws_a_study_finds_it(
    runs_dir: str, storage: str | None, rest: str
) -> None:
    command = study_command("grbm-1", Path(runs_dir), storage)
    assert command == f"rgbt study name=grbm-1{rest}"
