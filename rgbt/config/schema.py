"""Configuration: where it lies, how it is checked, how a node becomes an object.

The schema of a node is the constructor that its ``_target_`` names: keys and values are checked
against the constructor's signature and annotations before anything is built, so that a misspelt
key in an experiment file or after ``+`` is refused as well (Hydra lets both through). Ranges are
part of the annotations (`rgbt.ranges`).
"""

from __future__ import annotations

import functools
import inspect
import typing
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

from hydra.errors import InstantiationException
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rgbt.checks import InputError, nearest
from rgbt.config.values import check_value
from rgbt.ranges import Seed, Text

TOP_LEVEL: dict[str, Any] = {
    **{"seed": Seed, "name": Text, "runs_dir": Text, "out": Text | None, "pretrained": Text | None},
    "fresh": bool,
}
"""Keys of the configuration that are plain values; every other one is a node with `_target_`."""

NODES = (
    *("scale", "recipe", "dataset", "domains", "data", "transform", "masker", "model", "loss"),
    *("scheme", "optimizer", "schedule", "trainer", "metric", "consistency", "tracking"),
)


OF_THE_RUN: dict[str, dict[str, Any]] = {
    "model": {"weights": Text | None, "fresh": tuple[Text, ...]},
    "dataset": {"absent": typing.Literal["released", "exclude"]},
}
"""Keys of a node that the run reads itself and the constructor does not take, by node."""


def check(config: DictConfig) -> None:
    """Refuse a configuration with unknown keys, missing values or values of a wrong type.

    Raises:
        InputError: naming the first key that is wrong, with the nearest known name.
    """
    known = [*TOP_LEVEL, *NODES]
    for key in config:
        if key not in known:
            raise InputError(
                f"'{key!s}' is not a key of the configuration; {nearest(str(key), known)}."
            )
    for key, annotation in TOP_LEVEL.items():
        check_value(key, config[key], annotation)
    for key in NODES:
        check_node(config[key], key)


def check_node(node: DictConfig, path: str) -> None:
    """Check one node against the constructor its ``_target_`` names (see the module docstring).

    Args:
        node: mapping with `_target_`.
        path: its key in the configuration, for messages.

    Raises:
        InputError: missing or unknown target, unknown key, missing value, wrong type.
    """
    typed(node, path, check_node)


def build(node: DictConfig, **offered: Any) -> Any:
    """The object that a checked node describes.

    Args:
        node: mapping with `_target_`; nested nodes are built first.
        offered: objects from elsewhere (a network for a scheme); those that the constructor names
            are passed beside the node's own values.

    Returns:
        the constructed object; values are converted to the annotated types (lists to tuples).

    Raises:
        InputError: a value that the constructor needs is not in the node.
    """
    path = node._get_full_key(None) or "config"
    target = _target(node, path)
    values = typed(node, path, lambda child, _: build(child))
    parameters = inspect.signature(target).parameters
    values |= {key: value for key, value in offered.items() if key in parameters}
    needed = [key for key, parameter in parameters.items() if parameter.default is parameter.empty]
    missing = [key for key in needed if key not in values]
    if missing:
        raise InputError(f"'{path}.{missing[0]}' has no value; {node['_target_']} needs it.")
    # Called through Hydra, which looks at the arguments as well: get_object(path="os.system").
    call = _authorized(node["_target_"], path)
    try:
        return call(**values)
    except InstantiationException as error:
        raise _refused(node["_target_"], path, error) from error


def typed(node: DictConfig, path: str, nested: Callable[[DictConfig, str], Any]) -> dict[str, Any]:
    """Values of a node as its constructor takes them; `nested` turns a node inside it into one."""
    target = _target(node, path)
    parameters = inspect.signature(target).parameters
    hints = setting_types(target)
    values = {}
    for key, value in _items(node, path):
        if key in OF_THE_RUN.get(path, {}):
            check_value(f"{path}.{key}", value, OF_THE_RUN[path][key])
            continue
        if key not in parameters:
            known = [*OF_THE_RUN.get(path, ()), *(name for name in parameters if name in hints)]
            raise InputError(
                f"'{path}.{key}' is not a setting of {node['_target_']}; {nearest(key, known)}."
            )
        if isinstance(value, DictConfig) and "_target_" in value:
            values[key] = nested(value, f"{path}.{key}")
        else:
            values[key] = check_value(f"{path}.{key}", value, hints.get(key, Any))
    return values


def _target(node: DictConfig, path: str) -> Any:
    if not isinstance(node, DictConfig) or "_target_" not in node:
        raise InputError(
            f"'{path}' must be a mapping with `_target_`; choose a file of conf/{path}/"
        )
    return constructor(node["_target_"], path)


def constructor(target: Any, path: str) -> Any:
    """The class or function that `target` names, unless Hydra's policy refuses it.

    Args:
        target: dotted path; its module is imported.
        path: key in the configuration, for messages.

    Raises:
        InputError: not a dotted path, no such object, or refused (os.system, exec, subprocess.run
            and the like).
    """
    return _authorized(target, path).func


def _authorized(target: Any, path: str) -> functools.partial[Any]:
    """`target` as Hydra's `instantiate` returns it; what executes code is refused there."""
    target = check_value(f"{path}._target_", target, Text)
    try:
        found = _partial(target)
        if found.func is not get_object(target):  # its module was imported anew
            _partial.cache_clear()
            found = _partial(target)
    except Exception as error:  # a module of the user's may fail in any way as it is imported
        raise _refused(target, path, error) from error
    return found


@functools.cache
def _partial(target: str) -> functools.partial[Any]:
    """Cached, because Hydra needs 2 ms and a configuration has 40 targets."""
    found = instantiate({"_target_": target, "_partial_": True})
    assert isinstance(found, functools.partial), "Hydra returns a partial where one is requested"
    return found


def _refused(target: str, path: str, error: Exception) -> InputError:
    cause = error.__cause__
    if cause is None:  # the policy's own sentences
        reason = " ".join(str(error).partition("full_key:")[0].split()).partition(". ")[0]
        return InputError(f"'{path}._target_': {reason.rstrip('.')}.")
    said = " ".join(str(cause.__cause__ or cause).split()).rstrip(".")
    return InputError(f"'{path}._target_': cannot import {target} ({said}).")


@cache
def setting_types(target: Any) -> dict[str, Any]:
    """What the settings of a constructor take, by key: types with their ranges."""
    function = target.__init__ if inspect.isclass(target) else target
    hints = typing.get_type_hints(function, include_extras=True)
    hints.pop("return", None)
    return hints


def _items(node: DictConfig, path: str) -> Iterator[tuple[str, Any]]:
    for key in node:
        if key == "_target_":
            continue
        if OmegaConf.is_missing(node, key):
            raise InputError(f"'{path}.{key!s}' has no value; give one with {path}.{key!s}=...")
        try:
            yield str(key), node[key]
        except OmegaConfBaseException as error:
            reason = str(error).splitlines()[0]
            raise InputError(f"'{path}.{key!s}' cannot be resolved: {reason}") from error
