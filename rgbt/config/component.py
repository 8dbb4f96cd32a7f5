"""The typed settings of one node of the configuration, from which its object is built.

The schema of a node is the constructor that its ``_target_`` names: keys and values are checked
against the constructor's signature and annotations before anything is built, so that a misspelt
key in an experiment file or after ``+`` is refused as well (Hydra lets both through). Ranges are
part of the annotations (`rgbt.ranges`).
"""

from __future__ import annotations

import functools
import inspect
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast

from hydra.errors import InstantiationException
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rgbt.checks import InputError, nearest
from rgbt.config.values import check_value
from rgbt.ranges import Text

RUN_SETTINGS: dict[str, dict[str, Any]] = {
    "model": {"weights": Text | None, "fresh": tuple[Text, ...]},
    "dataset": {"absent": Literal["released", "exclude"]},
}
"""Settings, by node, that the run reads itself and that are not passed to the constructor."""


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
    def from_node(cls, node: DictConfig, path: str = "") -> Component:
        """Check a node against the constructor that its `_target_` names.

        Args:
            node: mapping with `_target_`.
            path: its key in the configuration; "": where the node is in its configuration.

        Raises:
            InputError: missing or unknown target, unknown key, missing value, wrong type.
        """
        path = path or node._get_full_key(None) or "config"
        if not isinstance(node, DictConfig) or "_target_" not in node:
            raise InputError(
                f"'{path}' must be a mapping with `_target_`; choose a file of conf/{path}/"
            )
        target = constructor(node["_target_"], path)
        values = dict(_typed_values(node, path, target))
        plain = cast("dict[str, Any]", OmegaConf.to_container(node, resolve=True))
        return cls(path, node["_target_"], values, plain)

    def build(self, **collaborators: Any) -> Any:
        """The object; components inside are built first.

        Args:
            collaborators: objects from elsewhere (a network for a scheme); those that the
                constructor names are passed beside the values.

        Raises:
            InputError: the constructor needs a value that the node does not have.
        """
        parameters = inspect.signature(constructor(self.target, self.path)).parameters
        values = {
            key: value.build() if isinstance(value, Component) else value
            for key, value in self.values.items()
        }
        values |= {key: value for key, value in collaborators.items() if key in parameters}
        for key, parameter in parameters.items():
            if parameter.default is parameter.empty and key not in values:
                raise InputError(f"'{self.path}.{key}' has no value; {self.target} needs it.")
        try:
            return authorized(self.target, self.path)(**values)
        except InstantiationException as error:
            raise refusal(self.target, self.path, error) from error

    def canonical(self) -> dict[str, Any]:
        """Values of JSON, equal for equal settings: 4 and 4.0 are one value where 4.0 is meant."""
        from pydantic_core import to_jsonable_python

        values = {
            key: value.canonical() if isinstance(value, Component) else value
            for key, value in self.values.items()
        }
        return {"_target_": self.target, **to_jsonable_python(values)}


def build(node: DictConfig, **collaborators: Any) -> Any:
    """The object of a node, checked and built at once (see `Component`)."""
    return Component.from_node(node).build(**collaborators)


def _typed_values(node: DictConfig, path: str, target: Any) -> Iterator[tuple[str, Any]]:
    parameters = inspect.signature(target).parameters
    hints = setting_types(target)
    run_settings = RUN_SETTINGS.get(path, {})
    for key in map(str, node):
        if key == "_target_":
            continue
        if OmegaConf.is_missing(node, key):
            raise InputError(f"'{path}.{key}' has no value; give one with {path}.{key}=...")
        try:
            value = node[key]
        except OmegaConfBaseException as error:
            reason = str(error).splitlines()[0]
            raise InputError(f"'{path}.{key}' cannot be resolved: {reason}") from error
        if key in run_settings:
            check_value(f"{path}.{key}", value, run_settings[key])
        elif key not in parameters:
            known = [*run_settings, *(name for name in parameters if name in hints)]
            raise InputError(
                f"'{path}.{key}' is not a setting of {node['_target_']}; {nearest(key, known)}."
            )
        elif isinstance(value, DictConfig) and "_target_" in value:
            yield key, Component.from_node(value, f"{path}.{key}")
        else:
            yield key, check_value(f"{path}.{key}", value, hints.get(key, Any))


def constructor(target: Any, path: str) -> Any:
    """The class or function that `target` names; its module is imported.

    Args:
        target: dotted path.
        path: key in the configuration, for messages.

    Raises:
        InputError: not a dotted path, no such object, or refused by Hydra's policy (os.system,
            exec, subprocess.run and the like).
    """
    return authorized(target, path).func


def authorized(target: Any, path: str) -> functools.partial[Any]:
    """`target` as Hydra's `instantiate` returns it, which refuses what executes code.

    To be called through: Hydra looks at the arguments as well (get_object(path="os.system")).
    """
    target = check_value(f"{path}._target_", target, Text)
    try:
        if _partial(target).func is not get_object(target):  # its module was imported anew
            _partial.cache_clear()
        return _partial(target)
    except Exception as error:  # importing a user's module can raise anything
        raise refusal(target, path, error) from error


@functools.cache
def _partial(target: str) -> functools.partial[Any]:
    """Cached, because Hydra needs 2 ms and a configuration has 40 targets."""
    partial = instantiate({"_target_": target, "_partial_": True})
    assert isinstance(partial, functools.partial), "Hydra returns a partial where one is requested"
    return partial


def refusal(target: str, path: str, error: Exception) -> InputError:
    """The message for a target that cannot be imported or that Hydra's policy refuses."""
    cause = error.__cause__
    if cause is None:  # the policy's own sentences
        reason = " ".join(str(error).partition("full_key:")[0].split()).partition(". ")[0]
        return InputError(f"'{path}._target_': {reason.rstrip('.')}.")
    reason = " ".join(str(cause.__cause__ or cause).split()).rstrip(".")
    return InputError(f"'{path}._target_': cannot import {target} ({reason}).")


@functools.cache
def setting_types(target: Any) -> dict[str, Any]:
    """Types of a constructor's settings with their ranges, by key."""
    function = target.__init__ if inspect.isclass(target) else target
    hints = typing.get_type_hints(function, include_extras=True)
    hints.pop("return", None)
    return hints
