"""Settings of a sweep: the file, the checks, what is left for the runs to resolve."""

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


def test_sweeper_file_explains_every_setting() -> None:
    lines = [line for line in FILE.read_text().splitlines() if line[:1].isalpha()]
    silent = [line.partition(":")[0] for line in lines if "#" not in line]
    assert silent in ([], ["sampler"])


def test_values_are_taken_as_their_types(composed: DictConfig) -> None:
    settings = read_settings(
        changed(
            composed,
            workers=3,
            gpus=[0, 1],
            hours=8,
            timeout_minutes=1.5,
            objectives=[{"metric": "test/Var", "direction": "minimize"}],
            points=[["a=1", "b=[2,3]"], ["a=4"]],
        )
    )
    assert settings.workers == 3
    assert settings.gpus == (0, 1)
    assert (settings.hours, settings.timeout_minutes) == (8.0, 1.5)
    assert settings.objectives == (Objective("test/Var", "minimize"),)
    assert settings.points == (("a=1", "b=[2,3]"), ("a=4",))


def test_read_settings_keeps_interpolations(
    composed: DictConfig,
) -> None:
    space = {"masker.patch_size": {"type": "categorical", "choices": ["${px:8}", "${px:64}"]}}
    settings = read_settings(
        changed(composed, space=space, params={"a": "${px:8},2"}, points=[["a=${px:8}"]])
    )
    assert settings.space == space
    assert settings.params == {"a": "${px:8},2"}
    assert settings.points == (("a=${px:8}",),)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"worker": 2}, "'hydra.sweeper.worker' is not a setting; did you mean 'workers'"),
        ({"workers": 0}, "workers' must be a whole number from 1 to 1024 .*, got 0"),
        ({"workers": "two"}, "hydra.sweeper.workers"),
        ({"workers": 1.5}, "hydra.sweeper.workers"),
        ({"retries": -1}, "retries' must be a whole number from 0"),
        ({"replicates": 0}, "replicates' must be a whole number from 1"),
        ({"threads": 1}, "'hydra.sweeper.threads' is not a setting"),
        ({"trials": 0}, "trials' must be a whole number from 1"),
        ({"hours": 0}, "hours' must be a number above 0 .*, or null, got 0"),
        ({"timeout_minutes": -2}, "timeout_minutes' must be a number above 0"),
        (
            {"gpus": []},
            r"gpus' must be a list of 1 to 1024, each a .*, or null, got \[\]",
        ),
        ({"retry": "all"}, "hydra.sweeper.retry"),
        ({"executor": "ray"}, "hydra.sweeper.executor"),
        ({"submitit": {"cluster": "slurm"}}, "executor=submitit"),
        ({"objectives": []}, "objectives' must be a list of 1 to 10, each a mapping with metric"),
        ({"objectives": [{"metric": "mIoU", "direction": "maximize"}]}, "objective 'mIoU'"),
        ({"objectives": [{"metric": "val/mIoU", "direction": "up"}]}, "hydra.sweeper.objectives"),
        (
            {"objectives": [{"metric": "val/TC/align", "direction": "maximize"}]},
            "did you mean 'TC/aligned'",
        ),
        (
            {"objectives": [{"metric": "val/mIoU", "direction": "maximize", "weight": 1}]},
            "hydra.sweeper.objectives",
        ),
        ({"objectives": [{"metric": "val/mIoU"}]}, "hydra.sweeper.objectives"),
        ({"space": ["a"]}, "'hydra.sweeper.space' must be a mapping"),
        ({"points": {"a": 1}}, "'hydra.sweeper.points' must be a list"),
    ],
)
def test_a_wrong_setting_is_told_in_one_sentence(
    composed: DictConfig, values: dict[str, Any], said: str
) -> None:
    with pytest.raises(InputError, match=said) as error:
        read_settings(changed(composed, **values))
    assert "\n" not in str(error.value)


def test_objectives_that_are_told_while_a_run_trains() -> None:
    followed = {
        metric: Objective(metric, "maximize").is_reported
        for metric in (
            "val/mIoU",
            "val/night/mIoU",
            "val/TC/aligned",
            "test/CA/released",
            "test/Var",
        )
    }
    assert list(followed.values()) == [True, True, False, False, False]


@pytest.mark.parametrize("key", ["workers", "points"])
def test_a_missing_setting_is_told(composed: DictConfig, key: str) -> None:
    left = OmegaConf.create({name: composed[name] for name in composed if name != key})
    assert isinstance(left, DictConfig)
    with pytest.raises(InputError, match=key):
        read_settings(left)


def test_points_that_are_no_lists_are_refused(composed: DictConfig) -> None:
    with pytest.raises(InputError, match="points"):
        read_settings(changed(composed, points=["a=1"]))
