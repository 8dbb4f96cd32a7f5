"""The classes and functions that a configuration names, imported under Hydra's policy."""

from __future__ import annotations

import functools
import inspect
import typing
from functools import cache
from typing import Any

from hydra.utils import get_object, instantiate

from rgbt.checks import InputError
from rgbt.config.values import check_value
from rgbt.ranges import Text


def constructor(target: Any, path: str) -> Any:
    """The class or function that `target` names, unless Hydra's policy refuses it.

    Args:
        target: dotted path; its module is imported.
        path: key in the configuration, for messages.

    Raises:
        InputError: not a dotted path, no such object, or refused (os.system, exec, subprocess.run
            and the like).
    """
    return authorized(target, path).func


def authorized(target: Any, path: str) -> functools.partial[Any]:
    """`target` as Hydra's `instantiate` returns it, which refuses what executes code.

    To be called through: Hydra looks at the arguments as well (get_object(path="os.system")).
    """
    target = check_value(f"{path}._target_", target, Text)
    try:
        found = _partial(target)
        if found.func is not get_object(target):  # its module was imported anew
            _partial.cache_clear()
            found = _partial(target)
    except Exception as error:  # a module of the user's may fail in any way as it is imported
        raise refusal(target, path, error) from error
    return found


@functools.cache
def _partial(target: str) -> functools.partial[Any]:
    """Cached, because Hydra needs 2 ms and a configuration has 40 targets."""
    found = instantiate({"_target_": target, "_partial_": True})
    assert isinstance(found, functools.partial), "Hydra returns a partial where one is requested"
    return found


def refusal(target: str, path: str, error: Exception) -> InputError:
    """The sentence for a target that cannot be imported, or that Hydra's policy refuses."""
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
