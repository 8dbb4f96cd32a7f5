"""Import the code of another author's checkout, and build a network with it."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import nn

from rgbt.checks import InputError, described, one_line
from rgbt.files.adapters import adapter_of

_python = importlib.import_module("random")
_numpy = np.random.mtrand._rand  # NumPy's global generator

_held: set[Path] = set()
"""The folder whose modules this process has imported: modules of two could have one name."""


class Namespace(dict[str, Any]):
    """Settings that can be read as attributes and as keys, as many configurations are."""

    def __getattr__(self, key: str) -> Any:
        if key not in self:
            raise AttributeError(f"the namespace has no value '{key}'")
        return self[key]


def namespace(values: Mapping[str, Any]) -> Namespace:
    """The mapping and all mappings in it as namespaces."""
    return Namespace(
        {k: namespace(each) if isinstance(each, Mapping) else each for k, each in values.items()}
    )


@contextmanager
def seeded(seed: int, device: torch.device) -> Iterator[None]:
    """Within it, the global generators begin at `seed`; afterwards they are as before.

    Those of Python, NumPy, torch on the CPU and torch on `device`; `seed` from 0 to 2^32 - 1.
    """
    states = _python.getstate(), _numpy.get_state()
    try:
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.random.manual_seed(seed)
            _python.seed(seed)
            _numpy.seed(seed)
            yield
    finally:
        _python.setstate(states[0])
        _numpy.set_state(states[1])


def build(folder: Path, constructor: str, arguments: Mapping[str, Any]) -> nn.Module:
    """The network on the CPU, with the random weights that the global generator of torch gives.

    Args:
        folder: that is put on the path of modules.
        constructor: "module:name" of the checkout, or "file.py:name" of an adapter.
        arguments: of the constructor.

    Raises:
        InputError: it cannot be imported or built; the process holds another checkout.
    """
    if not folder.is_dir():
        raise InputError(f"model.checkout: no such folder: {folder}")
    if _held - {folder}:
        raise InputError(
            f"model.checkout={folder}: this process has imported modules of {next(iter(_held))}, "
            "which may have the same names; use another process."
        )
    _held.add(folder)
    setting = f"model.constructor={constructor}"
    seed = int(torch.randint(2**31, (), generator=torch.default_generator, device="cpu"))
    sys.path.insert(0, str(folder))
    try:
        # Sizes of stages are read from tensors, which have none on the device "meta".
        with redirect_stdout(sys.stderr), seeded(seed, cpu := torch.device("cpu")), cpu:
            network = _function(folder, constructor)(**arguments)
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        raise InputError(f"{setting}: {type(error).__name__}: {one_line(error)}.") from error
    finally:
        # Networks may import when they are called, but nothing of ours finds modules there first.
        sys.path.remove(str(folder))
        sys.path.append(str(folder))
    if not isinstance(network, nn.Module):
        raise InputError(f"{setting} returned {described(network)}; expected a torch.nn.Module.")
    return network


def _function(folder: Path, constructor: str) -> Callable[..., Any]:
    """The class or function that builds the network."""
    name, _, attribute = constructor.partition(":")
    adapter = adapter_of(constructor)
    if adapter is not None:
        spec = importlib.util.spec_from_file_location(f"adapter_{adapter.stem}", adapter)
        assert spec is not None, "of a file that ends in .py"
        assert spec.loader is not None, "as above"
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    else:
        module = importlib.import_module(name)
        if not _lies_in(module, folder):
            raise InputError(
                f"model.constructor={constructor}: {name} is not a module of {folder}, but "
                f"{getattr(module, '__file__', 'of Python')}."
            )
    found: Callable[..., Any] = getattr(module, attribute)
    return found


def _lies_in(module: ModuleType, folder: Path) -> bool:
    file = getattr(module, "__file__", None)
    return file is not None and Path(file).resolve().is_relative_to(folder)
