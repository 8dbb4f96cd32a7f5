"""Tools for adapters, which build the networks of odd repositories.

An adapter is a function that returns the network: ours are in `rgbt/models/external/adapters.py`, a
user's in a Python file beside their recipe. It imports
modules of the checkout, and keeps constructors from reading weights of files, so that a run starts
from the weights that its configuration names.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import module_from_spec
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import MagicMock

import torch
from torch import nn


def skip_init(*names: str) -> None:
    """Let packages of the checkout be imported without executing their ``__init__.py``."""
    for name in names:
        spec = ModuleSpec(name, None, is_package=True)
        spec.submodule_search_locations = [str(Path(sys.path[0], *name.split(".")))]
        sys.modules.setdefault(name, module_from_spec(spec))


def stand_in(name: str, **attributes: Any) -> None:
    """Let a package be imported that may be missing: itself, or else a mock with `attributes`."""
    try:
        import_module(name)
        return
    except ImportError:  # also where it does not fit what is installed
        parts = name.split(".")
    for length in range(1, len(parts) + 1):
        part = ".".join(parts[:length])
        spec = ModuleSpec(part, None, is_package=True)
        sys.modules.setdefault(part, MagicMock(__path__=[], __spec__=spec))
    for key, value in attributes.items():
        setattr(sys.modules[name], key, value)


def replace_in(owner: Any, **attributes: Any) -> None:
    """Put other objects under some names of the module that defines a class or function."""
    vars(sys.modules[owner.__module__]).update(attributes)


def replaced(module: ModuleType, **attributes: Any) -> ModuleType:
    """Copy a module with other objects under some names; the module itself stays as it is.

    ``replace_in(Net, torch=replaced(torch, load=lambda *_: {}))`` lets one module load nothing.
    """
    copy = ModuleType(module.__name__)
    vars(copy).update(vars(module) | attributes)
    return copy


class Untrained:
    """Makes functions of a module, such as ``torchvision.models``, ignore ``pretrained=True``."""

    def __init__(self, module: ModuleType) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        function = getattr(self._module, name)
        return lambda *given, **more: function(*given, **{**more, "pretrained": False})


def allow_cpu() -> None:
    """Let ``.cuda()`` return its tensor or module unchanged on a machine without a GPU."""
    if not torch.cuda.is_available():
        for kind in (torch.Tensor, nn.Module):
            setattr(kind, "cuda", lambda self, *_, **__: self)  # noqa: B010 - not a type's method
