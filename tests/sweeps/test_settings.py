"""Settings of a sweep: the file, the checks, what only the runs resolve."""

from __future__ import annotations

from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError
from rgbt.config.compose import conf_dir
from sweeps.settings import Objective, SweepSettings, read_settings

FILE = conf_dir() / "hydra" / "sweeper" / "study.yaml"


@pytest.fixture(scope="module")
def composed() -> DictConfig:
    node = OmegaConf.load(FILE)
    assert isinstance(node, DictConfig)
    return node


def changed(node: DictConfig, **values: Any) -> DictConfig:
    changed_node = OmegaConf.create({**{str(key): node[key] for key in node}, **values})
    assert isinstance(changed_node, DictConfig)
    return changed_node


def test_sweeper_file_holds_all_settings(composed: DictConfig) -> None:
    keys = set(map(str, composed)) - {"_target_"}
    assert keys == set(SweepSettings.__dataclass_fields__)
    settings = read_settings(composed)
    assert settings.objectives == (Objective("val/mIoU", "maximize"),)
    assert (settings.workers, settings.replicates, settings.retries) == (1, 1, 0)
    assert settings.points == ()
    assert settings.pruner is None


def test_values_are_taken_as_their_types(composed: DictConfig) -> None:
    settings = read_settings(
        changed(
            composed,
            workers=3,
            gpus=[0, [1, 2]],
            hours=8,
            timeout_minutes=1.5,
            objectives=[{"metric": "test/Var", "direction": "minimize"}],
            points=[["a=1", "b=[2,3]"], ["a=4"]],
        )
    )
    assert settings.workers == 3
    assert settings.gpus == (0, (1, 2))
    assert (settings.hours, settings.timeout_minutes) == (8.0, 1.5)
    assert settings.objectives == (Objective("test/Var", "minimize"),)
    assert settings.points == (("a=1", "b=[2,3]"), ("a=4",))


def test_read_settings_keeps_interpolations(composed: DictConfig) -> None:
    space = {"masker.patch_size": {"type": "categorical", "choices": ["${px:8}", "${px:64}"]}}
    settings = read_settings(
        changed(composed, space=space, params={"a": "${px:8},2"}, points=[["a=${px:8}"]])
    )
    assert settings.space == space
    assert settings.params == {"a": "${px:8},2"}
    assert settings.points == (("a=${px:8}",),)


def objective(metric: str, **more: Any) -> dict[str, Any]:
    return {"objectives": [{"metric": metric, "direction": "maximize", **more}]}


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"worker": 2}, "did you mean 'workers'"),
        ({"workers": 0}, "workers'.*, got 0"),
        ({"workers": "two"}, "hydra.sweeper.workers"),
        ({"workers": 1.5}, "hydra.sweeper.workers"),
        ({"retries": -1}, "retries'"),
        ({"replicates": 0}, "replicates'"),
        ({"trials": 0}, "trials'"),
        ({"hours": 0}, "hours'.*, got 0"),
        ({"timeout_minutes": -2}, "timeout_minutes'"),
        ({"gpus": []}, r"gpus'"),
        ({"gpus": [[]]}, r"gpus"),
        ({"retry": "all"}, "hydra.sweeper.retry"),
        ({"executor": "ray"}, "hydra.sweeper.executor"),
        ({"submitit": {"cluster": "slurm"}}, "executor=submitit"),
        ({"executor": "submitit", "timeout_minutes": 3}, "submitit={timeout_min"),
        ({"objectives": []}, "objectives'"),
        (objective("mIoU"), "objective 'mIoU'"),
        (objective("val/mIoU", direction="up"), "hydra.sweeper.objectives"),
        (objective("val/TC/align"), "did you mean 'TC/aligned'"),
        (objective("val/mIoU", weight=1), "hydra.sweeper.objectives"),
        ({"space": ["a"]}, "'hydra.sweeper.space'"),
        ({"points": {"a": 1}}, "'hydra.sweeper.points'"),
        ({"points": ["a=1"]}, "points"),
    ],
)
def test_wrong_setting_is_reported_in_one_sentence(
    composed: DictConfig, values: dict[str, Any], said: str
) -> None:
    with pytest.raises(InputError, match=said) as error:
        read_settings(changed(composed, **values))
    assert "\n" not in str(error.value)


def test_objectives_reported_during_training() -> None:
    metrics = ("val/mIoU", "val/night/mIoU", "val/TC/aligned", "test/CA/released", "test/Var")
    followed = [Objective(metric, "maximize").is_reported for metric in metrics]
    assert followed == [True, True, False, False, False]
