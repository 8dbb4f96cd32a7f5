"""The typed settings of one node of the configuration, from which its object is built.

The schema of a node is the constructor that its ``_target_`` names, with ranges as annotations.
"""

from __future__ import annotations

import collections.abc
import functools
import importlib
import inspect
import typing
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

from hydra.errors import InstantiationException
from hydra.utils import get_object, instantiate
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rgbt.checks import InputError, nearest, one_line
from rgbt.config.values import check_value
from rgbt.ranges import Text

# Settings, by node, that the run reads itself and that are not passed to the constructor.
RUN_SETTINGS: dict[str, dict[str, Any]] = {
    "model": {"weights": Text | None, "fresh": tuple[Text, ...]},
    "dataset": {"absent": Literal["released", "exclude"]},
}
# Text after the message that a setting has no value.
PAGES = {
    "dataset.root": " (docs/how-to/prepare-data-sets.md says where the images come from)",
}


@dataclass(frozen=True)
class Component:
    """A class or function with checked values for its parameters; nothing is built yet.

    Attributes:
        path: key of the node in the configuration, for messages.
        target: dotted path of the class or function.
        values: by parameter, converted to the annotated types; components inside are `Component`.
        plain: the node as resolved YAML values, with its `_target_`.
    """

    path: str
    target: str
    values: Mapping[str, Any]
    plain: Mapping[str, Any]

    @classmethod
    def from_node(cls, node: Any, path: str = "") -> Component:
        """Check a node, plain or of OmegaConf, whose key in the configuration is `path`.

        InputError names a target or key that is unknown, or a value that is missing or wrong.
        """
        try:
            path = path or (node._get_full_key(None) if OmegaConf.is_config(node) else "config")
            node = OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
        except OmegaConfBaseException as error:
            raise InputError(f"'{path}': {str(error).splitlines()[0]}.") from error
        if not isinstance(node, Mapping) or "_target_" not in node:
            raise InputError(f"'{path}' must be a mapping with `_target_`.")
        target = constructor(node["_target_"], path)
        kinds, parameters = setting_types(target), inspect.signature(target).parameters
        run_settings = RUN_SETTINGS.get(path, {})
        values: dict[str, Any] = {}
        for key, value in node.items():
            name = f"{path}.{key}"
            if key == "_target_":
                continue
            if value == "???":
                raise InputError(
                    f"'{name}' has no value; give one with {name}=...{PAGES.get(name, '')}"
                )
            if key in run_settings:
                check_value(name, value, run_settings[key])
            elif key not in parameters:
                known = [
                    *run_settings,
                    *(parameter for parameter in parameters if parameter in kinds),
                ]
                hint = nearest(str(key), known)
                raise InputError(f"'{name}' is not a setting of {node['_target_']}; {hint}.")
            elif isinstance(value, Mapping) and "_target_" in value:
                values[key] = cls.from_node(value, name)
            else:
                values[key] = check_value(name, value, kinds.get(key, Any))
        return cls(path, node["_target_"], values, dict(node))

    def build(self, **collaborators: Any) -> Any:
        """Return the object, with those `collaborators` (a network for a scheme) that it takes.

        Components inside get those that they take, too.
        """
        parameters = inspect.signature(constructor(self.target, self.path)).parameters
        values = {
            key: value.build(**collaborators) if isinstance(value, Component) else value
            for key, value in self.values.items()
        }
        values |= {key: value for key, value in collaborators.items() if key in parameters}
        for key, parameter in parameters.items():
            if parameter.default is parameter.empty and key not in values:
                raise InputError(f"'{self.path}.{key}' has no value; {self.target} needs it.")
        try:
            # Hydra's policy looks at the arguments as well: get_object(path="os.system").
            return _authorized(self.target, self.path)(**values)
        except InstantiationException as error:
            raise InputError(f"'{self.path}._target_': {one_line(error)}.") from error


_checked: dict[tuple[str, str], Component] = {}


def checked_nodes(
    plain: Mapping[str, Any], names: Iterable[str], built: Collection[str] = ()
) -> dict[str, Any]:
    """Check nodes of a configuration, and return them by name; those in `built` as their objects.

    A node is checked once per process, unless it names a user's class, which may have changed.
    """
    found: dict[str, Any] = {}
    for name in names:
        text = repr(plain[name])
        component = _checked.get((name, text)) or Component.from_node(plain[name], name)
        if text.count("'_target_': 'rgbt.") == text.count("_target_"):
            _checked[name, text] = component
        found[name] = component.build() if name in built else component
    return found


def objects(parts: Mapping[str, Any], collaborators: Mapping[str, Any]) -> dict[str, Any]:
    """Return the objects of components by name, and all other values as they are."""
    return {
        name: part.build(**collaborators) if isinstance(part, Component) else part
        for name, part in parts.items()
    }


def build(node: Any, **collaborators: Any) -> Any:
    """Return the object of a node, checked and built at once (see `Component`)."""
    return Component.from_node(node).build(**collaborators)


def constructor(target: Any, path: str) -> Any:
    """Return the class or function that `target` names; its module is imported.

    InputError where there is none, or Hydra's policy refuses it (os.system).
    """
    return _authorized(target, path).func


def _authorized(target: Any, path: str) -> functools.partial[Any]:
    """Return `target` from Hydra's `instantiate`, which refuses what executes code."""
    target = check_value(f"{path}._target_", target, Text)
    try:
        if _partial(target).func is not get_object(target):  # its module was imported anew
            _partial.cache_clear()
        return _partial(target)
    except Exception as error:  # importing a user's module can raise anything
        cause = error.__cause__
        reason = one_line((cause and cause.__cause__) or cause or error)
        raise InputError(f"'{path}._target_': {reason}.") from error


@functools.cache
def _partial(target: str) -> functools.partial[Any]:
    """Keep a target: Hydra needs 2 ms, and a configuration has 40 targets."""
    if target.startswith("rgbt."):  # Hydra would look for an attribute of each package first
        with suppress(ImportError):
            importlib.import_module(target.rpartition(".")[0])
    partial: functools.partial[Any] = instantiate({"_target_": target, "_partial_": True})
    return partial


@functools.cache
def setting_types(target: Any) -> dict[str, Any]:
    """Return the types of a constructor's settings with their ranges, by key.

    A name that its module imports for a type checker only, as Optuna's do, is any type.
    """
    function = target.__init__ if inspect.isclass(target) else target
    absent: dict[str, Any] = {}
    while True:
        try:
            hints = typing.get_type_hints(function, localns=absent, include_extras=True)
        except NameError as error:
            name = str(error.name)
            absent[name] = getattr(collections.abc, name, Any)
        else:
            return {key: kind for key, kind in hints.items() if key != "return"}
