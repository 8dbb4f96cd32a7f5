"""From a composed configuration to the specification of its run and of those upstream of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, cast, get_type_hints

from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError
from rgbt.config.component import Component
from rgbt.config.compose import check_keys
from rgbt.config.values import check_value
from rgbt.spec.run_spec import NODES, VALUES, WEIGHTS, Dependency, RunSpec, labels_key
from rgbt.spec.upstream import parse_reference, shared_overrides, upstream_config


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
            experiment that does not exist, or a circle of them.
    """
    check_keys(config)
    values: dict[str, Any] = {
        key: check_value(key, config[key], each) for key, each in VALUES.items()
    }
    components = {key: Component.from_node(config[key], key) for key in NODES}
    types = get_type_hints(RunSpec)
    nodes: dict[str, Any] = {
        key: node if types[key] is Component else node.build() for key, node in components.items()
    }
    if dependencies is None:
        dependencies = tuple(_dependencies(config, overrides, (*downstream, config.name)))
    plain = cast("dict[str, Any]", OmegaConf.to_container(config, resolve=True))
    return RunSpec(
        **values,
        **nodes,
        overrides=tuple(overrides),
        plain={**plain, "fresh": False},  # a request to the command, and no property of the run
        components=components,
        dependencies=tuple(dependencies),
    )


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
                raise InputError(f"{key} makes a circle of upstream runs: {circle}.")
            upstream = upstream_config(config, key, experiment)
            typed = [f"+experiment={experiment}", *shared_overrides(overrides, key)]
            run = specify(upstream, typed, downstream=downstream)
            yield Dependency(key, run, checkpoint)
