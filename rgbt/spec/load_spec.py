"""Make the specification of a finished run from its stored settings and a user's overrides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError, nearest
from rgbt.config.compose import SEARCH_PATH, compose, flatten, register_resolvers
from rgbt.files.yaml_files import parse_yaml
from rgbt.spec.run_spec import RENAMED, RunSpec
from rgbt.spec.specify import specify

CHECKOUT = "model.checkout"
"""Setting that names the folder of another author's code."""

GROUPS = ("dataset", "metric", "prediction", "consistency")
CHANGEABLE = (
    *("dataset", "data", "metric", "prediction", "consistency", "transform.test_short_edge"),
    *("trainer.accelerator", "trainer.threads", "trainer.precision"),
    CHECKOUT,
)
"""Settings of a finished run that may be changed: the source of the images and the counting, and
where code lies."""


def load_spec(settings: Mapping[str, Any], overrides: Sequence[str] = ()) -> RunSpec:
    """The specification of a run; its weights and upstream runs are left out.

    Args:
        settings: plain values of its configuration, whose targets may be built
            (`rgbt.config.stored_config`). Settings that are newer than the run are added as they
            were when it was made, and values that were renamed get their present name.
        overrides: of `CHANGEABLE` settings. ``dataset=mfnet`` replaces the whole node by that file
            of ``conf/dataset/``; ``data.eval_batch_size=1`` changes one value.

    Raises:
        InputError: overrides that do not fit.
    """
    register_resolvers()
    config = OmegaConf.create(dict(settings))
    defaults = compose([])
    for key, value in _plain(defaults).items():
        if key not in config:
            config[key] = value
    for key, value in _plain(defaults.data).items():
        if key not in config.data:
            config.data[key] = value
    _rename(config)
    if config.trainer.threads is None:  # one thread per core
        config.trainer.threads = defaults.trainer.threads
    if "absent" not in config.dataset:
        config.dataset.absent = config.metric.get("absent", "exclude")
    _override(config, overrides)
    config.model.weights = None  # the checkpoint holds them all
    return specify(config, dependencies=())


def _rename(config: DictConfig) -> None:
    """Give values their present names, in place."""
    for key, now, before in RENAMED:
        if OmegaConf.select(config, key) == before:
            OmegaConf.update(config, key, now)


def _plain(node: DictConfig) -> dict[str, Any]:
    """Values, with every reference to others replaced; those that must be given are left out."""
    found = cast("dict[str, Any]", OmegaConf.to_container(node, resolve=True))
    return {key: value for key, value in found.items() if value != "???"}


def _override(config: DictConfig, overrides: Sequence[str]) -> None:
    """Apply overrides in place: groups first, then single values.

    Absent classes count by the convention of the data set that is measured, unless the run or
    `overrides` set ``metric.absent`` by hand. A partition of a user's own class may lack it.
    """
    absent = config.metric.get("absent")
    by_hand = absent not in (None, config.dataset.absent)
    pairs = [word.lstrip("+").partition("=")[::2] for word in overrides]
    # camera@consistency.view.camera works there. The search path holds for the whole command.
    changes = [(k, v, k.rpartition("@")[2]) for k, v in pairs if k != SEARCH_PATH]
    for key, _, path in changes:
        if not _is_changeable(path):
            raise InputError(
                f"'{key}' of a finished run cannot be changed; {nearest(key, CHANGEABLE)}."
            )
    groups = [key for key, _, _ in changes if key in GROUPS]
    for group in groups:
        own = [f"{key}={value}" for key, value, path in changes if path.split(".")[0] == group]
        composed = compose(own)[group]
        for name in OmegaConf.missing_keys(composed):
            raise InputError(f"'{name}' has no value; give one with {name}=...")
        config[group] = OmegaConf.to_container(composed, resolve=True)
    known = flatten(_plain(config))
    for key, value, path in changes:
        if path.split(".")[0] in groups:
            continue
        # A mapping such as dataset.shares is one value, and may be replaced as one.
        if key not in known and not any(each.startswith(f"{key}.") for each in known):
            open_ones = [each for each in known if _is_changeable(each)]
            near = [each for each in open_ones if each.startswith(f"{key.partition('.')[0]}.")]
            raise InputError(
                f"'{key}' is not a key of this run; {nearest(key, near or open_ones)}."
            )
        OmegaConf.update(config, key, parse_yaml(value, key))
    is_typed = "metric.absent" in [path for _, _, path in changes]
    if "absent" in config.metric and not is_typed:
        config.metric.absent = absent if by_hand else config.dataset.get("absent", "exclude")


def _is_changeable(path: str) -> bool:
    return any(path == each or path.startswith(f"{each}.") for each in CHANGEABLE)
