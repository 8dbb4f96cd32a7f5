"""Make the specification of a run and of its upstream runs from a composed configuration.

A run names an upstream run by its experiment: ``model.weights=experiment:NAME/last.pt`` starts
from the last checkpoint of that run; ``domains.target.labels=experiment:NAME/best.pt`` trains on
the predictions of its network. Both runs share seed, scale and data set
(`rgbt.spec.run_spec.SHARED`): a run of seed 2 depends on runs of seed 2.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any, cast, get_args, get_type_hints

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rgbt.checks import InputError, nearest
from rgbt.config.component import RUN_SETTINGS, Component
from rgbt.config.compose import available, check_keys, compose
from rgbt.config.hydra_messages import own_folder_hint
from rgbt.config.values import check_value
from rgbt.spec.run_spec import (
    NODES,
    SHARED,
    VALUES,
    WEIGHTS,
    CheckpointFile,
    Dependency,
    RunSpec,
    labels_key,
)

PREFIX = "experiment:"

TARGETS = re.compile(r"'_target_': '(\w*)")
"""First part of every target in the text of a node."""

MOST_NODES = 4096
"""Checked nodes that are kept; more of them empty the cache."""

_checked: dict[tuple[str, str], Component] = {}


def specify(
    config: DictConfig,
    overrides: Sequence[str] = (),
    *,
    dependencies: Sequence[Dependency] | None = None,
    downstream: tuple[str, ...] = (),
) -> RunSpec:
    """Check a composed configuration and describe its run.

    Args:
        config: composed by Hydra, or read from a run folder.
        overrides: as typed, for the name of the run.
        dependencies: upstream runs; None: those that the configuration names.
        downstream: names of the experiments whose upstream run this is.

    Raises:
        InputError: an unknown key, a missing value, a value of a wrong type, an upstream
            experiment that does not exist, or a cycle of them.
    """
    check_keys(config)
    values: dict[str, Any] = {
        key: check_value(key, config[key], each) for key, each in VALUES.items()
    }
    plain = _resolved(config)
    components = {key: _component(config, key, plain.get(key)) for key in NODES}
    types = _types()
    nodes: dict[str, Any] = {
        key: node if types[key] is Component else node.build() for key, node in components.items()
    }
    if dependencies is None:
        dependencies = tuple(_dependencies(config, overrides, (*downstream, config.name)))
    return RunSpec(
        **values,
        **nodes,
        overrides=tuple(overrides),
        plain={**plain, "fresh": False},  # a request to the command, and no property of the run
        components=components,
        dependencies=tuple(dependencies),
    )


@cache
def _types() -> dict[str, Any]:
    """Types of the attributes of a specification."""
    return get_type_hints(RunSpec)


def _resolved(config: DictConfig) -> dict[str, Any]:
    """Plain values, with every reference to others replaced.

    Raises:
        InputError: a reference that leads nowhere, named by the node that has it.
    """
    try:
        return cast("dict[str, Any]", OmegaConf.to_container(config, resolve=True))
    except OmegaConfBaseException:
        for key in NODES:
            Component.from_node(config[key], key)
        raise


def _component(config: DictConfig, key: str, plain: Any) -> Component:
    """The checked node at `key`; nodes of rgbt that were checked before are not checked again.

    Rows of a table differ in few nodes. A user's own class may have changed since the last check.
    """
    text = repr(plain)
    if not set(TARGETS.findall(text)) <= {"rgbt"}:
        return Component.from_node(config[key], key)
    if (key, text) not in _checked:
        if len(_checked) >= MOST_NODES:
            _checked.clear()
        _checked[key, text] = Component.from_node(config[key], key)
    return _checked[key, text]


def _dependencies(
    config: DictConfig, overrides: Sequence[str], downstream: tuple[str, ...]
) -> Iterator[Dependency]:
    """The upstream runs that a configuration names, each with those upstream of it."""
    for key in (WEIGHTS, labels_key("source"), labels_key("target")):
        reference = parse_reference(key, OmegaConf.select(config, key))
        if reference is not None:
            experiment, checkpoint = reference
            if experiment in downstream:
                circle = " -> ".join((*downstream, experiment))
                raise InputError(f"{key} makes a cycle of upstream runs: {circle}.")
            typed = [f"+experiment={experiment}", *_shared_overrides(overrides, key)]
            upstream = upstream_config(config, key, experiment)
            run = specify(upstream, typed, downstream=downstream)
            yield Dependency(key, run, checkpoint)


def parse_reference(key: str, value: str | None) -> tuple[str, CheckpointFile] | None:
    """Experiment and checkpoint that "experiment:NAME/last.pt" names; None for any other value.

    Raises:
        InputError: the reference is not of this form, or there is no such experiment.
    """
    if value is None or not value.startswith(PREFIX):
        return None
    name, _, checkpoint = value.removeprefix(PREFIX).rpartition("/")
    if checkpoint not in get_args(CheckpointFile):
        raise InputError(
            f"{key}={value}: expected experiment:NAME/best.pt or experiment:NAME/last.pt."
        )
    known = available("experiment")
    if name not in known:
        raise InputError(
            f"{key}={value}: there is no experiment '{name}'; {nearest(name, known)}. You can "
            f"also name a run by its folder: runs/<key>/{checkpoint}.{own_folder_hint()}"
        )
    return name, cast(CheckpointFile, checkpoint)


def upstream_config(config: DictConfig, key: str, experiment: str) -> DictConfig:
    """The configuration of an upstream run: its experiment, with what both runs share.

    Shared are `SHARED`, the sizes of the scale and durations that were typed; for weights also the
    network. Everything else is the experiment's own.
    """
    upstream = _composed(experiment, config.scale.name)
    if key == WEIGHTS:
        own = RUN_SETTINGS["model"]
        upstream.model = {each: upstream.model._get_node(each) for each in own}
    for each, value in _shared_settings(config, key).items():
        OmegaConf.update(upstream, each, value, merge=False, force_add=True)
    return upstream


def _shared_settings(config: DictConfig, key: str) -> dict[str, Any]:
    """Dotted key -> value, not resolved, of what an upstream run shares."""
    # Its experiment says whether a network has pretrained weights, the scale says all else.
    shared = [*SHARED, *(f"scale.{each}" for each in config.scale if each != "pretrained")]
    if key == WEIGHTS:
        own = RUN_SETTINGS["model"]
        shared += [f"model.{each}" for each in config.model if each not in own]
    values = {}
    for each in shared:
        *parents, last = each.split(".")
        mine: Any = OmegaConf.select(config, ".".join(parents)) if parents else config
        node = mine._get_node(last)
        values[each] = OmegaConf.to_container(node) if OmegaConf.is_config(node) else node._value()
    return values


def _composed(experiment: str, scale: str) -> DictConfig:
    chosen = compose([f"+experiment={experiment}"])  # often composed already, for a row of a table
    if chosen.scale.name == scale:
        return chosen
    return compose([f"+experiment={experiment}", f"scale={scale}"])


def _shared_overrides(overrides: Sequence[str], key: str) -> list[str]:
    """The typed overrides that the upstream run of the setting `key` shares."""
    groups = ("scale", "dataset", "metric", *(("model",) if key == WEIGHTS else ()))
    own = (WEIGHTS, "model.fresh", "seed", "runs_dir")

    def is_shared(path: str) -> bool:
        in_group = path.replace("/", ".").split(".")[0] in groups
        return path not in own and (path in SHARED or in_group or path.startswith("data."))

    paths = [word.partition("=")[0].lstrip("+").rpartition("@")[2] for word in overrides]
    return [word for word, path in zip(overrides, paths, strict=True) if is_shared(path)]
