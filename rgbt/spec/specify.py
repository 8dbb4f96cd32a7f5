"""Make the specification of a run and of its upstream runs from a composed configuration.

A run names an upstream run by its experiment: ``model.weights=experiment:NAME/last.pt`` starts
from the last checkpoint of that run; ``domains.target.labels=experiment:NAME/best.pt`` trains on
the predictions of its network. Both runs share seed, scale and data set
(`rgbt.spec.run_spec.SHARED`): a run of seed 2 depends on runs of seed 2.

``model.weights=common:NAME/last.pt`` names an upstream run that keeps its own data set: all methods
with the same network start from the same run. It also keeps its own seed, unless `seeds.start` says
that every seed has a start of its own.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any, NamedTuple, cast, get_args, get_type_hints

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
    SHARED_BY_COMMON,
    VALUES,
    WEIGHTS,
    CheckpointFile,
    Dependency,
    RunSpec,
    labels_key,
)

PREFIX = "experiment:"
COMMON_PREFIX = "common:"
"""Before the name of an upstream run that keeps its own seed and data set."""

CACHE = "cache_dir"
"""Setting of an embedded data set: where the generated images are."""

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
            experiment = reference.experiment
            if experiment in downstream:
                circle = " -> ".join((*downstream, experiment))
                raise InputError(f"{key} makes a cycle of upstream runs: {circle}.")
            typed = [f"+experiment={experiment}", *_shared_overrides(overrides, key, reference)]
            upstream = upstream_config(config, key, reference)
            run = specify(upstream, typed, downstream=downstream)
            if reference.is_common and OmegaConf.select(config, "seeds.start") == "run":
                run = run.with_seed(run.seed + config.seed)
            yield Dependency(key, run, reference.checkpoint, reference.is_common)


class Reference(NamedTuple):
    """An upstream run as a setting names it.

    Attributes:
        experiment: its name.
        checkpoint: the file that is taken: "best.pt" or "last.pt".
        is_common: whether it keeps its own seed and data set.
    """

    experiment: str
    checkpoint: CheckpointFile
    is_common: bool = False


def parse_reference(key: str, value: str | None) -> Reference | None:
    """What "experiment:NAME/last.pt" or "common:NAME/last.pt" names; None for any other value.

    Raises:
        InputError: the reference is not of this form, there is no such experiment, or the labels
            of a domain are those of a common run, which has other images.
    """
    if value is None or not value.startswith((PREFIX, COMMON_PREFIX)):
        return None
    prefix, _, rest = value.partition(":")
    is_common = value.startswith(COMMON_PREFIX)
    if is_common and key != WEIGHTS:
        raise InputError(
            f"{key}={value}: only {WEIGHTS} can name a common run, because its images are others; "
            "expected experiment:NAME/best.pt."
        )
    name, _, checkpoint = rest.rpartition("/")
    if checkpoint not in get_args(CheckpointFile):
        raise InputError(f"{key}={value}: expected {prefix}:NAME/best.pt or {prefix}:NAME/last.pt.")
    known = available("experiment")
    if name not in known:
        raise InputError(
            f"{key}={value}: there is no experiment '{name}'; {nearest(name, known)}. You can "
            f"also name a run by its folder: runs/<key>/{checkpoint}.{own_folder_hint()}"
        )
    return Reference(name, cast(CheckpointFile, checkpoint), is_common)


def upstream_config(config: DictConfig, key: str, reference: Reference) -> DictConfig:
    """The configuration of an upstream run: its experiment, with what both runs share.

    Shared are `SHARED`, the sizes of the scale and durations that were typed; for weights also the
    network. A common run shares `SHARED_BY_COMMON` instead of `SHARED`. Everything else is the
    experiment's own.
    """
    upstream = _composed(reference.experiment, config.scale.name)
    if key == WEIGHTS:
        own = RUN_SETTINGS["model"]
        upstream.model = {each: upstream.model._get_node(each) for each in own}
    if reference.is_common and CACHE in config.dataset and CACHE in upstream.dataset:
        upstream.dataset[CACHE] = config.dataset[CACHE]
    for each, value in _shared_settings(config, key, reference).items():
        OmegaConf.update(upstream, each, value, merge=False, force_add=True)
    return upstream


def _shared_settings(config: DictConfig, key: str, reference: Reference) -> dict[str, Any]:
    """Dotted key -> value, not resolved, of what an upstream run shares."""
    # Its experiment says whether a network has pretrained weights, the scale says all else.
    always = SHARED_BY_COMMON if reference.is_common else SHARED
    shared = [*always, *(f"scale.{each}" for each in config.scale if each != "pretrained")]
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


def _shared_overrides(overrides: Sequence[str], key: str, reference: Reference) -> list[str]:
    """The typed overrides that the upstream run of the setting `key` shares."""
    always = SHARED_BY_COMMON if reference.is_common else SHARED
    nodes = [each for each in always if each in NODES]
    # A file of conf/debug sets sizes of the scale.
    groups = ("scale", "debug", *(["model"] if key == WEIGHTS else []), *nodes)
    own = (WEIGHTS, "model.fresh", "seed", "runs_dir")

    def is_shared(path: str) -> bool:
        in_group = path.replace("/", ".").split(".")[0] in groups
        return path not in own and (path in always or in_group)

    paths = [word.partition("=")[0].lstrip("+").rpartition("@")[2] for word in overrides]
    return [word for word, path in zip(overrides, paths, strict=True) if is_shared(path)]
