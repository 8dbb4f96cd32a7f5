"""A device that does not exist: tensors on it are kept by the CPU, but may not meet its own.

Code that runs on it is checked as by a GPU: an operation on tensors of both devices raises, and so
does NumPy on a tensor of the device. Every operation for which the host waits for a GPU is noted
with the line of our code that asks for it. The numbers are those of the CPU.

The device is called "meta", the one name that PyTorch knows everywhere and that has no arithmetic
of its own. What depends on the name "cuda" is not simulated: kernels, their precision, pinned
memory, random numbers of the device.
"""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

import rgbt

DEVICE = torch.device("meta")

PACKAGE = Path(rgbt.__file__).parent
"""The code that is measured: not the tests, also where the repository is in a folder `rgbt`."""

READS = ("_local_scalar_dense", "equal", "is_nonzero")
"""Operations that give the host a number."""

SIZED_BY_VALUES = ("nonzero", "masked_select", "unique", "_unique2", "unique_dim", "bincount",
                   "repeat_interleave", "argwhere")  # fmt: skip
"""Operations whose result has a size that depends on values."""

INDEXING = ("index", "index_put", "index_put_", "_unsafe_index", "_index_put_impl_")
"""Operations that take indices on the host."""


class DeviceMismatchError(AssertionError):
    """An operation on tensors of both devices."""


class Placed(Tensor):
    """A tensor on the device; `kept` holds its values."""

    kept: Tensor

    @staticmethod
    def __new__(cls, kept: Tensor) -> Placed:
        made: Placed = Tensor._make_wrapper_subclass(
            cls,
            kept.shape,
            strides=kept.stride(),
            storage_offset=kept.storage_offset(),
            dtype=kept.dtype,
            device=DEVICE,
        )
        made.kept = kept
        return made

    def __repr__(self, **_: Any) -> str:
        return f"Placed({self.kept!r})"

    @classmethod
    def __torch_dispatch__(
        cls,
        func: Any,
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        raise AssertionError(f"{func} on a tensor of the simulated device outside of `simulation`")


class _Generator(torch.Generator):
    """A generator of the CPU that says it is one of the device."""

    @property
    def device(self) -> torch.device:  # type: ignore[override]
        return DEVICE


class _Functions(TorchFunctionMode):
    """What PyTorch does before it dispatches: tensors of Python numbers."""

    def __torch_function__(
        self,
        func: Any,
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        kwargs = dict(kwargs or {})
        if func is torch.tensor and _is_there(kwargs.get("device")):
            device = kwargs.pop("device")
            return torch.tensor(*args, **kwargs).to(device)
        if func is Tensor.new_tensor and isinstance(args[0], Placed):
            kwargs.setdefault("dtype", args[0].dtype)
            return torch.tensor(*args[1:], **kwargs).to(DEVICE)
        if func is Tensor.tolist and isinstance(args[0], Placed):  # refuses subclasses
            return args[0].to("cpu").tolist()
        return func(*args, **kwargs)


class _Operations(TorchDispatchMode):
    """Runs every operation on the CPU, and notes what the host waits for."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: Counter[str] = Counter()

    def __torch_dispatch__(
        self,
        func: Any,
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        kwargs = dict(kwargs or {})
        name = func.overloadpacket.__name__
        leaves = [each for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)]
        placed = [each for each in leaves if isinstance(each, Placed)]
        there = bool(placed)
        if "device" in kwargs and kwargs["device"] is not None:
            there = _is_there(kwargs["device"])
            kwargs["device"] = torch.device("cpu")
        elif not placed and leaves:
            there = False
        self._note(name, args, leaves, placed, there, waits=not kwargs.get("non_blocking"))
        result = func(*tree_map(_kept, args), **tree_map(_kept, kwargs))
        if name in READS:
            return result
        if name == "copy_":  # a tensor of the host stays one
            return args[0]
        if not there:
            return result
        wrapped = tree_map(lambda x: Placed(x) if isinstance(x, Tensor) else x, result)
        if not placed or name == "_to_copy":
            return wrapped
        return return_and_correct_aliasing(func, args, kwargs, wrapped)

    def _note(
        self,
        name: str,
        args: Any,
        leaves: list[Tensor],
        placed: list[Tensor],
        there: bool,
        *,
        waits: bool,
    ) -> None:
        """Count what the host waits for; raise where devices meet."""
        host = [each for each in leaves if not isinstance(each, Placed)]
        if name in ("_to_copy", "copy_"):
            to_host = isinstance(leaves[0], Placed) and not there
            if (to_host or (host and there)) and (waits or to_host):
                self._waits(name, "to the host" if to_host else "to the device")
            return
        if placed:
            self._note_operation(name, args, host)

    def _note_operation(self, name: str, args: Any, host: list[Tensor]) -> None:
        """The same for an operation on at least one tensor of the device."""
        if name in READS or name in SIZED_BY_VALUES:
            self._waits(name, "a value of the device")
        if name in INDEXING:
            indices = [x for x in tree_leaves(args[1]) if isinstance(x, Tensor)]
            if any(each.dtype in (torch.bool, torch.uint8) for each in indices):
                self._waits(name, "the size of a mask")
            if any(not isinstance(each, Placed) for each in indices):
                self._waits(name, "indices of the host")
            host = [each for each in host if all(each is not index for index in indices)]
        # PyTorch takes single numbers of the host as constants, but not in a list of tensors.
        strangers = [each for each in host if each.dim() or name in ("cat", "stack")]
        if strangers:
            shapes = [tuple(each.shape) for each in strangers]
            raise DeviceMismatchError(f"{name}: tensors of the CPU {shapes} at {line_of_ours()}")

    def _waits(self, name: str, what: str) -> None:
        self.waits[f"{line_of_ours()} {name}: {what}"] += 1


def line_of_ours() -> str:
    """File, line and function of the last frame in our code."""
    for frame in reversed(traceback.extract_stack()):
        path = Path(frame.filename)
        if path.is_relative_to(PACKAGE):
            return f"{path.relative_to(PACKAGE.parent)}:{frame.lineno} {frame.name}"
    return "elsewhere"


def _kept(value: Any) -> Any:
    return value.kept if isinstance(value, Placed) else value


def _is_there(device: Any) -> bool:
    return device is not None and torch.device(device).type == DEVICE.type


def _generator(device: torch.device | str = "cpu") -> torch.Generator:
    return _Generator() if _is_there(device) else _GENERATOR(device=device)


_GENERATOR, _AUTOCAST = torch.Generator, torch.autocast


def _autocast(device_type: str, *args: Any, **kwargs: Any) -> Any:
    return _AUTOCAST("cpu" if device_type == DEVICE.type else device_type, *args, **kwargs)


def _inference_mode(mode: bool = True) -> Any:
    """No gradients: tensors of inference mode cannot be wrapped."""
    return torch.no_grad() if mode else nullcontext()


@contextmanager
def simulation() -> Iterator[Counter[str]]:
    """Simulate the device within; what the host waits for, by line, with the number of times."""
    operations = _Operations()
    with (
        patch("torch.Generator", _generator),
        patch("torch.autocast", _autocast),
        patch("torch.inference_mode", _inference_mode),
        _Functions(),
        operations,
    ):
        try:
            yield operations.waits
        finally:
            forget_sizes()


def forget_sizes() -> None:
    """Empty the memory of tensors that depend on sizes alone: those of the device stay behind."""
    import sys

    for name, module in list(sys.modules.items()):
        if name.startswith("rgbt.models"):
            for each in vars(module).values():
                clear: Callable[[], None] | None = getattr(each, "cache_clear", None)
                if clear is not None:
                    clear()
