"""Settings of a sweep: the file, the checks, what only the runs resolve."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import pytest
from omegaconf import OmegaConf

from rgbt.checks import InputError
from rgbt.config.compose import conf_dir
from sweeps import settings as checks
from sweeps.settings import Objective, SweepSettings, read_settings
from tests.sweeps.fakes import hydra_node

FILE = conf_dir() / "hydra" / "sweeper" / "study.yaml"


def changed(**values: Any) -> SweepSettings:
    node = OmegaConf.load(FILE)
    changed = OmegaConf.create({**{str(key): node[key] for key in node}, **values})
    return read_settings(hydra_node(changed, num_gpus=0.25))


def test_sweeper_file_holds_all_settings() -> None:
    keys = set(map(str, OmegaConf.load(FILE))) - {"_target_", "_recursive_"}
    assert keys == {field.name for field in fields(SweepSettings)} - {
        "launcher",
        "launcher_options",
    }
    settings = changed()
    assert settings.objectives == (Objective("val/mIoU", "maximize"),)
    assert (settings.workers, settings.points, settings.pruner, settings.trust) == (
        None,
        (),
        None,
        "",
    )
    assert (settings.wait, settings.stop_jobs, settings.commands) == (True, False, None)
    assert (settings.launcher, settings.launcher_options) == ("basic", {"num_gpus": 0.25})


def test_read_settings_converts_and_resolves() -> None:
    settings = changed(
        gpus=[0, [1, 2]],
        hours=8,
        study="${sweeper.storage}",
        storage="sqlite:///a.db",
        objectives=[{"metric": "test/Var", "direction": "minimize"}],
        points=[["a=1", "b=[2,3]"], ["a=${px:8}"]],
        space={"a": {"choices": ["${px:8}"]}},
        params={"a": "${px:8},2"},
    )
    assert settings.gpus == (0, (1, 2))
    assert (settings.hours, settings.study) == (8.0, "sqlite:///a.db")
    assert settings.objectives == (Objective("test/Var", "minimize"),)
    # Those of the runs are kept.
    assert settings.points == (("a=1", "b=[2,3]"), ("a=${px:8}",))
    assert settings.space == {"a": {"choices": ["${px:8}"]}}
    assert settings.params == {"a": "${px:8},2"}


def objective(metric: str) -> dict[str, Any]:
    return {"objectives": [{"metric": metric, "direction": "maximize"}]}


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"worker": 2}, "hydra.sweeper.worker'"),
        ({"workers": 0}, "hydra.sweeper.workers'"),
        (objective("mIoU"), "objective 'mIoU'"),
        (objective("val/TC/align"), "did you mean 'TC/aligned'"),
        ({"points": ["a=1"]}, r"hydra.sweeper.points\[0\]"),
    ],
)
def test_read_settings_names_wrong_setting(values: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        changed(**values)


def test_objectives_reported_during_training() -> None:
    metrics = ("val/night/mIoU", "val/region/2", "val/TC/aligned", "test/Var")
    followed = [Objective(metric, "maximize").is_reported for metric in metrics]
    assert followed == [True, True, False, False]


def test_jobs_of_this_machine_are_waited_for() -> None:
    with pytest.raises(InputError, match=r"hydra\.sweeper\.wait=false: runs of this machine"):
        changed(wait=False)


def test_a_time_limit_needs_a_command_that_waits() -> None:
    with pytest.raises(InputError, match=r"timeout_minutes needs hydra\.sweeper\.wait=true"):
        changed(wait=False, timeout_minutes=5)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("joblib", r"works with .*, ray \(its n_jobs is hydra\.sweeper\.workers\)\.$"),
        ("rq", r"=rq: a sweep works with basic, submitit_local, submitit_slurm, ray\.$"),
        ("ray", r"ray: it needs pip install 'rgbt\[ray\]'"),
    ],
)
def test_other_and_missing_launchers_are_refused(
    monkeypatch: pytest.MonkeyPatch, name: str, said: str
) -> None:
    monkeypatch.setattr(checks, "find_spec", lambda _: None)
    changed()
    with pytest.raises(InputError, match=said):
        read_settings(hydra_node(OmegaConf.load(FILE), name))
