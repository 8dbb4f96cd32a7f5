"""The specification of a finished run, read from its folder, with what a user changes of it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError, nearest
from rgbt.config.compose import compose, flatten, register_resolvers
from rgbt.config.stored_config import load_config
from rgbt.files.yaml_files import parse_yaml
from rgbt.spec.run_spec import RunSpec
from rgbt.spec.specify import specify

GROUPS = ("dataset", "metric", "consistency")
CHANGEABLE = (
    *("dataset", "data", "metric", "consistency", "transform.test_short_edge"),
    *("trainer.accelerator", "trainer.threads", "trainer.precision"),
)
"""Settings of a finished run that may be changed: where images come from, how they are counted."""


def load_spec(folder: Path, overrides: Sequence[str] = (), trust: Collection[str] = ()) -> RunSpec:
    """The specification of the run in `folder`; its weights and upstream runs are left out.

    Args:
        folder: the run folder.
        overrides: of its configuration (`CHANGEABLE`). ``dataset=mfnet`` replaces the whole node by
            that file of ``conf/dataset/``; ``data.eval_batch_size=1`` changes one value.
        trust: modules that the configuration may name (`rgbt.config.stored_config`).

    Raises:
        InputError: a target that is not trusted, or overrides that do not fit.
    """
    register_resolvers()
    config = load_config(folder / "config.yaml", trust)
    _add_newer_settings(config)
    _override(config, [_pair(item) for item in overrides])
    config.model.weights = None  # the checkpoint holds them all
    return specify(config, dependencies=())


def _add_newer_settings(config: DictConfig) -> None:
    """Settings that are newer than the run, as they were when it was made."""
    defaults = compose([])
    for key, value in _plain(defaults).items():
        if key not in config:
            config[key] = value
    for key, value in _plain(defaults.data).items():
        if key not in config.data:
            config.data[key] = value
    if config.trainer.threads is None:  # one thread per core
        config.trainer.threads = defaults.trainer.threads
    if "absent" not in config.dataset:
        config.dataset.absent = config.metric.get("absent", "exclude")


def _plain(node: DictConfig) -> dict[str, Any]:
    """Values, with every reference to others replaced; those that must be given are left out."""
    found = OmegaConf.to_container(node, resolve=True)
    assert isinstance(found, dict)
    return {str(key): value for key, value in found.items() if value != "???"}


def _override(config: DictConfig, pairs: list[tuple[str, str]]) -> None:
    """Apply overrides in place: groups first, then single values.

    Absent classes count by the convention of the data set that is measured, unless the run or
    `pairs` set ``metric.absent`` by hand. A partition of a user's own class may lack the setting.
    """
    absent = config.metric.get("absent")
    by_hand = absent not in (None, config.dataset.absent)
    search = [f"{key}={value}" for key, value in pairs if key == "hydra.searchpath"]
    pairs = [pair for pair in pairs if pair[0] != "hydra.searchpath"]
    for key, _ in pairs:
        if not _is_changeable(_path_of(key)):
            raise InputError(
                f"'{key}' cannot be changed of a finished run; {nearest(key, CHANGEABLE)}."
            )
    groups = [key for key, _ in pairs if key in GROUPS]
    for group in groups:
        own = [f"{key}={value}" for key, value in pairs if _path_of(key).split(".")[0] == group]
        composed = compose([*own, *search])[group]
        for name in OmegaConf.missing_keys(composed):
            raise InputError(f"'{name}' has no value; give one with {name}=...")
        config[group] = OmegaConf.to_container(composed, resolve=True)
    known = flatten(_plain(config))
    for key, value in pairs:
        if _path_of(key).split(".")[0] in groups:
            continue
        # A mapping such as dataset.shares is one value, and may be replaced as one.
        if key not in known and not any(each.startswith(f"{key}.") for each in known):
            node = key.partition(".")[0]
            open_ones = [each for each in known if _is_changeable(each)]
            near = [each for each in open_ones if each.startswith(f"{node}.")]
            raise InputError(
                f"'{key}' is not a key of this run; {nearest(key, near or open_ones)}."
            )
        OmegaConf.update(config, key, parse_yaml(value, key))
    is_typed = "metric.absent" in [_path_of(key) for key, _ in pairs]
    if "absent" in config.metric and not is_typed:
        config.metric.absent = absent if by_hand else config.dataset.get("absent", "exclude")


def _is_changeable(path: str) -> bool:
    return any(path == each or path.startswith(f"{each}.") for each in CHANGEABLE)


def _path_of(key: str) -> str:
    """Where in the configuration an override works: camera@consistency.view.camera goes there."""
    return key.rpartition("@")[2]


def _pair(item: str) -> tuple[str, str]:
    key, _, value = item.lstrip("+").partition("=")
    return key, value
