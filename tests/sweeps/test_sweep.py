"""Grids, lists and searches of ``-m``: what would be run, what is refused, how a search ends."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import hydra
import pytest
from hydra.core.global_hydra import GlobalHydra
from omegaconf import open_dict
from optuna.exceptions import StorageInternalError
from optuna.trial import TrialState

import sweeps.sweep as sweeping
from rgbt.checks import InputError, RunError
from rgbt.config.compose import compose, conf_dir, register_resolvers
from rgbt.metrics.counts import Counts
from sweeps import attributes as names
from sweeps.point import Outcome, Point
from sweeps.run import point_list
from sweeps.run.optuna_study import driving, known_studies
from sweeps.run.point_list import PointList
from sweeps.run.run_store import open_run_store
from sweeps.settings import Objective, SweepSettings
from sweeps.space import parse_space
from sweeps.sweep import Search, probe, search, sweep
from tests.commands import SPLITS, short, words_of
from tests.conftest import write_data
from tests.sweeps.fakes import settings as plain_settings

GRID = ("+experiment=grbm", "masker.sigma_div=1,2", "seed=0,3")
MEDIAN = {"_target_": "optuna.pruners.MedianPruner"}


@dataclass
class RecordedCalls:
    """What would have been run."""

    lists: list[PointList] = field(default_factory=list)
    searches: list[Search] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)

    def run_points(self, wanted: PointList, settings: Any, *, strict: bool) -> list[Outcome]:
        assert strict, "a wrong point of a grid is refused"
        self.lists.append(wanted)
        return self.outcomes or [Outcome(point, "finished") for point in wanted.points]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> RecordedCalls:
    found = RecordedCalls()
    monkeypatch.setattr(point_list, "run_points", found.run_points)
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


def test_grid_is_all_combinations_with_parameters(calls: RecordedCalls, tmp_path: Path) -> None:
    call(tmp_path, *GRID, "fresh=true")
    (wanted,) = calls.lists
    assert [point.label for point in wanted.points] == [
        *("sigma_div=1 seed=0", "sigma_div=1 seed=3", "sigma_div=2 seed=0", "sigma_div=2 seed=3"),
    ]
    assert wanted.points[3].params == {"masker.sigma_div": 2, "seed": 3}
    assert wanted.points[0].overrides[-3:] == ("+experiment=grbm", "masker.sigma_div=1", "seed=0")
    assert wanted.runs.fresh
    assert not any(word.startswith("fresh") for point in wanted.points for word in point.overrides)


def test_list_is_run_for_every_value_of_the_grid(calls: RecordedCalls, tmp_path: Path) -> None:
    points = [["masker.sigma_div=1", "masker.patch_size=8"], ["masker.sigma_div=4"]]
    params = {"seed": "0,1", "model.weights": None, "trainer.max_steps": 5}
    call(tmp_path, "+experiment=grbm", points=points, params=params)
    (wanted,) = calls.lists
    assert {"model.weights=null", "trainer.max_steps=5"} <= set(wanted.points[0].overrides)
    assert [point.label for point in wanted.points] == [
        *("seed=0 sigma_div=1 patch_size=8", "seed=0 sigma_div=4"),
        *("seed=1 sigma_div=1 patch_size=8", "seed=1 sigma_div=4"),
    ]


def test_name_of_grid_is_independent_of_paths(calls: RecordedCalls, tmp_path: Path) -> None:
    call(tmp_path / "a", *GRID)
    call(tmp_path / "b", *GRID, "fresh=true", "dataset.cache_dir=/c")
    call(tmp_path / "a", *GRID, "trainer.max_steps=3")
    first, moved, other = (wanted.study for wanted in calls.lists)
    assert first == moved != other
    assert first.startswith("grbm-sigma_div-seed-")


def test_name_of_search_is_independent_of_order(calls: RecordedCalls, tmp_path: Path) -> None:
    words = ("+experiment=grbm", "masker.sigma_div=interval(1,4)", "seed=1", "trainer.max_steps=3")
    call(tmp_path, *words, trials=3)
    call(tmp_path / "b", *reversed(words), "fresh=true", trials=3)
    for changes in ({"replicates": 2}, {"space": {"seed": {"type": "int", "low": 1, "high": 2}}}):
        call(tmp_path, *words[:2], *words[3:], trials=3, **changes)
    call(tmp_path, words[0], "masker.sigma_div=interval(1,8)", *words[2:], trials=3)
    first, same, *others = calls.searches
    assert (first.study, first.identity) == (same.study, same.identity)
    assert len({each.identity for each in calls.searches}) == 1 + len(others)


def test_search_file_runs_are_single(calls: RecordedCalls, tmp_path: Path) -> None:
    call(tmp_path, "+search=grbm", "masker.sigma_div=4")
    (wanted,) = calls.searches
    assert list(wanted.space) == ["masker.patch_size", "loss.spatial.alpha"]
    assert {"hydra.mode=RUN", "masker.sigma_div=4"} <= set(wanted.fixed)


@pytest.mark.parametrize(
    ("key", "value"), [("trials", 3), ("replicates", 2), ("storage", "sqlite:///x.db")]
)
def test_search_settings_of_grid_are_refused(tmp_path: Path, key: str, value: Any) -> None:
    with pytest.raises(InputError, match=f"hydra.sweeper.{key}"):
        call(tmp_path, *GRID, **{key: value})


def test_failed_points_end_in_error_after_table(
    calls: RecordedCalls, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calls.outcomes = [Outcome(Point("a", ()), "finished"), Outcome(Point("b", ()), "failed", "oom")]
    with pytest.raises(RunError, match="1 of 2 points failed, first b: oom"):
        call(tmp_path, *GRID)
    assert "oom" in capsys.readouterr().out


def test_preview_and_commands_of_a_grid_run_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call(tmp_path, *GRID, dry_run=True)
    assert list(tmp_path.iterdir()) == []
    assert "4 of 4 points" in capsys.readouterr().err
    call(tmp_path, *GRID, commands=str(tmp_path / "all"))
    assert [path.name for path in tmp_path.iterdir()] == ["all"]
    assert (tmp_path / "all").read_text().count(" -m rgbt.run ") == 4


def test_a_grid_that_another_process_drives_ends_quietly(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with driving(tmp_path, "mine"):
        call(tmp_path, *GRID, study="mine")
    said = capsys.readouterr()
    assert "study mine is driven by process" in said.err
    assert not said.out


def sigma(low: float, high: float) -> Any:
    return parse_space({"masker.sigma_div": {"type": "float", "low": low, "high": high}})


@pytest.fixture
def wanted(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Search:
    small = ("dataset.num_train=4", "dataset.num_val=2", "dataset.num_test=2")
    cache = f"dataset.cache_dir={tmp_path_factory.mktemp('cache')}"
    place = (f"runs_dir={tmp_path}", "tracking=none", cache)
    fixed = ("+experiment=grbm", *small, *place)
    return Search("s", fixed, sigma(1, 4), open_run_store(compose(place)), "identity")


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The states that the driver leaves trials in, instead of running them."""
    states: list[str] = ["COMPLETE"]

    def drive(view: Any, source: Any, *rest: Any) -> None:
        study = source.study
        for state in states:
            trial = study.ask(dict(source.space))
            trial.set_user_attr(names.REASON, "no memory")
            study.tell(trial, 1.0 if state == "COMPLETE" else None, TrialState[state])

    monkeypatch.setattr(sweeping, "drive", drive)
    monkeypatch.setattr(sweeping, "publish_study", lambda *_: None)
    return states


def settings(**changes: Any) -> SweepSettings:
    objectives = (Objective("val/mIoU", "maximize"),)
    return plain_settings(**{"trials": 3, "objectives": objectives, **changes})


def test_search_creates_study_and_previews_it(
    wanted: Search, ends: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    search(wanted, settings(dry_run=True))
    assert list(tmp_path.iterdir()) == []
    assert "0 of 3 trials" in capsys.readouterr().out
    search(wanted, settings())
    study = known_studies(None, tmp_path)["s"]
    assert study.user_attrs[names.COMMAND]
    search(wanted, settings(dry_run=True))
    assert "1 of 3 trials" in capsys.readouterr().out
    search(wanted, settings(trials=9))  # a larger budget is the same study
    assert len(study.trials) == 2


def test_search_with_other_identity_is_refused(wanted: Search, ends: list[str]) -> None:
    search(wanted, settings())
    for other in (
        replace(wanted, identity="other"),
        replace(wanted, fixed=(*wanted.fixed, "dataset.num_test=3")),
    ):
        with pytest.raises(InputError, match="choose another name"):
            search(other, settings())
    with pytest.raises(InputError, match="choose another name"):
        search(wanted, settings(objectives=(Objective("val/Var", "minimize"),)))


FAR = ("ray", "submitit_slurm")
TC, UP = (Objective(metric, "maximize") for metric in ("val/TC/aligned", "val/mIoU"))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"trials": None}, "hydra.sweeper.trials"),
        ({"sampler": {"_target_": "optuna.samplers.TPE"}}, "hydra.sweeper.sampler"),
        ({"objectives": (UP, UP), "pruner": MEDIAN}, "hydra.sweeper.pruner"),
        ({"objectives": (TC,)}, "val/TC/aligned'.*consistency.splits"),
        ({"commands": "file"}, "hydra.sweeper.commands is for grids"),
        *(({"launcher": name}, f"{name} needs hydra.sweeper.workers") for name in FAR),
    ],
)
def test_search_invalid_settings_raise_before_study_exists(
    wanted: Search, ends: list[str], tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(InputError, match=said):
        search(wanted, settings(**changes))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("low", "high"), [(-1, 4), (1, 10**6)])
def test_probe_range_outside_setting_raises(wanted: Search, low: float, high: float) -> None:
    with pytest.raises(InputError, match=r"'masker.sigma_div'"):
        probe(replace(wanted, space=sigma(low, high)), settings())


def test_a_search_that_another_process_drives_ends_quietly(
    wanted: Search, ends: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with driving(tmp_path, "s"):
        search(wanted, settings())
    assert "study s is driven by process" in capsys.readouterr().err
    assert known_studies(None, tmp_path) == {}
    url = f"sqlite:///{tmp_path}/all.db"
    for name in ("s", "t"):
        search(replace(wanted, study=name), settings(storage=url))
    assert sorted(known_studies(url, tmp_path)) == ["s", "t"]


def test_a_storage_that_is_away_ends_the_command(
    wanted: Search, ends: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def drive(*_: Any) -> None:
        raise StorageInternalError("no route to host\nmore")

    monkeypatch.setattr(sweeping, "drive", drive)
    with pytest.raises(RunError, match="storage: no route to host; rerun the command"):
        search(wanted, settings())


def test_search_without_finished_trial_raises(wanted: Search, ends: list[str]) -> None:
    ends[:] = ["FAIL", "FAIL"]
    with pytest.raises(RunError, match="no trial of s has finished"):
        search(wanted, settings())


@pytest.mark.slow
def test_workers_and_cores_do_not_change_counts(tmp_path: Path) -> None:
    """With one thread instead of two, the counts of this experiment are others."""
    data = write_data(tmp_path / "mf", SPLITS, (48, 64))
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    one_core = ["taskset", "-c", str(min(os.sched_getaffinity(0)))]

    def counts(name: str, *words: str, before: tuple[str, ...] = ()) -> list[bytes]:
        chosen = ("+experiment=cmx", "masker.patch_size=null", "trainer.threads=2", *short(4))
        typed = words_of(data, tmp_path / name, *chosen, *words)
        command = [*before, sys.executable, "-m", "rgbt.run", *typed]
        subprocess.run(command, check=True, capture_output=True, env=environment)
        found = sorted((tmp_path / name).glob("*/counts_test.npz"))
        return [Counts.load(path).counts.tobytes() for path in found]

    (plain,) = counts("plain", "seed=0")
    assert counts("core", "seed=0", before=tuple(one_core)) == [plain]
    one = counts("one", "-m", "seed=0,1")
    two = counts("two", "-m", "seed=0,1", "hydra.sweeper.workers=2")
    assert len(one) == 2
    assert plain in one
    assert one == two
    assert counts("threads", "seed=0", "trainer.threads=1") != [plain]
