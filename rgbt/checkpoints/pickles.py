"""Read pickles as data with Python's unpickler and a fixed table of names instead of imports.

A name in a file is never imported, looked up or called. It becomes a `Name`. A call of a known
name returns what its entry in `BUILDERS` makes of the arguments, or an `Inert`. Unknown names are
refused.

Python's unpickler in C is not used, because a memo index of 2^31, in a file of ten bytes, makes it
allocate gigabytes. Neither is torch.load, which takes sizes of storages from the pickle.
"""

from __future__ import annotations

import os
import pickle
import re
import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import IO, Any, Literal

import numpy as np
import torch
from torch import Tensor

from rgbt.checkpoints.names import BUILTINS, DTYPES, PLAIN_NAMES, STAND_INS

Persistent = Callable[[Any], Any]

GROWTH, SMALL = 8, 1_000_000
"""What may be copied while reading: so many times the bytes of the file, and a little more."""

UNKNOWN = b"".join(
    (pickle.EXT1, pickle.EXT2, pickle.EXT4)
    + (pickle.NEWOBJ_EX, pickle.NEXT_BUFFER, pickle.READONLY_BUFFER)
)
"""Opcodes of Python's registry of classes, calls with keywords, memory outside the file."""

SIZED = (str, bytes, bytearray, list, tuple, dict, set, frozenset)


class RefusedError(Exception):
    """Content that is refused; the message follows the file name."""

    @classmethod
    def code(cls, name: str) -> RefusedError:
        """For a name outside the known ones."""
        return cls(
            f"refers to {printable(name)}, which would execute code while the file is read. The "
            "file was not read; give one that holds only tensors and plain values, such as a "
            "saved state_dict()."
        )

    @classmethod
    def greedy(cls) -> RefusedError:
        """The error for content that would need far more memory than its size."""
        return cls("would need far more memory than its size; it is damaged or malicious.")


class DamagedError(Exception):
    """A file that is truncated, overwritten, or of another format than its first bytes indicate."""


DAMAGE = (
    *(DamagedError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError),
    *(RuntimeError, MemoryError, RecursionError, EOFError, struct.error, pickle.UnpicklingError),
)
"""Exceptions that damaged or invented bytes can cause."""


def printable(text: str, limit: int = 100) -> str:
    """`text` from a file for a terminal, without control characters and shortened."""
    shown = text if text.isprintable() else text.encode("unicode_escape").decode("ascii")
    return shown if len(shown) <= limit else f"{shown[: limit - 3]}..."


@dataclass(frozen=True)
class Name:
    """A name in a file, such as ``torch.FloatStorage``."""

    full: str


class Inert(dict[Any, Any]):
    """The keys and attributes of an object of a configuration class."""

    def extend(self, items: object) -> None:
        """Ignore elements of lists of configurations."""

    append = extend


@dataclass(eq=False)
class NumberType:
    """A NumPy dtype of plain numbers, whose state in a file gives the byte order."""

    dtype: np.dtype[Any]


def unpickle(
    stream: IO[bytes], persistent: Persistent | None = None, extra: Mapping[str, Any] | None = None
) -> Any:
    """The value of the next pickle in `stream`; the stream is left right behind it.

    Args:
        stream: bytes, read from its position.
        persistent: makes a value of what the file refers to outside the pickle; None: it may not.
        extra: further names that the file may call -> what answers them.

    Raises:
        RefusedError: a name that is not among the known ones, or more memory than the file has.
        Exception: one of `DAMAGE`.
    """
    return _Unpickler(stream, persistent, {**BUILDERS, **(extra or {})}).load()


PYTHONS: Any = pickle._Unpickler  # its stack and its steps are unknown to type checkers


class _Unpickler(PYTHONS):  # type: ignore[misc]
    """What Python's does on each opcode, less what calls, imports, hashes or copies unchecked."""

    def __init__(
        self, stream: IO[bytes], persistent: Persistent | None, builders: Mapping[str, Any]
    ) -> None:
        # Text of Python 2 is bytes; latin1 keeps each of them.
        super().__init__(stream, encoding="latin1")
        start = stream.tell()
        stream.seek(0, os.SEEK_END)
        self.budget = GROWTH * stream.tell() + SMALL
        stream.seek(start)
        self.builders = builders
        if persistent is not None:
            self.persistent_load = persistent

    def find_class(self, module: str, name: str) -> Name:
        full = f"{module}.{name}"
        if full not in self.builders and full not in PLAIN_NAMES and full not in STAND_INS:
            raise RefusedError.code(full)
        return Name(full)

    def call(self) -> None:
        """REDUCE and NEWOBJ: a name and a tuple of arguments."""
        arguments, callee = self.stack.pop(), self.stack.pop()
        if type(arguments) is not tuple:
            raise TypeError("arguments are a tuple")
        self._instantiate(callee, arguments)

    def _instantiate(self, callee: object, arguments: Iterable[Any]) -> None:
        """Push what answers a call; INST and OBJ end here too."""
        if type(callee) is not Name:
            raise TypeError("only names are called")
        arguments = tuple(arguments)
        self.spend(arguments)
        if callee.full in STAND_INS:
            self.append(Inert())
        elif callee.full in self.builders:
            self.append(self.builders[callee.full](*arguments))
        else:
            raise RefusedError.code(callee.full)

    def build(self) -> None:
        """BUILD: set the state of the value below it; few values accept one."""
        state, target = self.stack.pop(), self.stack[-1]
        self.spend(state if type(state) is tuple else (state,))
        if type(target) is Inert:
            target.update(state if type(state) is dict else {})
        elif type(target) is NumberType:
            if state[1] in ("<", ">"):
                target.dtype = target.dtype.newbyteorder(state[1])
        elif isinstance(target, Tensor):
            target.data = _array(*state[-4:])
        elif type(target) is not dict:  # attributes of an ordered dictionary mean nothing here
            raise TypeError(f"{type(target).__name__} takes no state")

    def spend(self, values: Iterable[Any]) -> None:
        """Count the bytes to copy, because a file may request the same copy many times."""
        self.budget -= sum(len(value) for value in values if isinstance(value, SIZED))
        if self.budget < 0:
            raise RefusedError.greedy()

    def dictionary(self) -> None:
        """DICT: keys and values above the mark."""
        items = self.pop_mark()  # before `append` is looked up, which it exchanges
        self.append(_pairs(items))

    def set_item(self) -> None:
        """SETITEM: one key and value."""
        items = self.stack[-2:]
        del self.stack[-2:]
        self._update(items)

    def set_items(self) -> None:
        """SETITEMS: those above the mark."""
        self._update(self.pop_mark())

    def _update(self, items: list[Any]) -> None:
        if type(self.stack[-1]) not in (dict, Inert):
            raise TypeError("only dictionaries have keys")
        self.stack[-1].update(_pairs(items))

    def add_items(self) -> None:
        """ADDITEMS, to a set."""
        items, target = self.pop_mark(), self.stack[-1]
        if type(target) is not set:
            raise TypeError("only sets are added to")
        target.update(_set(items))

    def frozen_set(self) -> None:
        """FROZENSET: what is above the mark."""
        items = self.pop_mark()
        self.append(frozenset(_set(items)))

    def byte_array(self) -> None:
        """BYTEARRAY8: as many bytes as there are, before memory is taken for them."""
        (size,) = struct.unpack("<Q", self.read(8))
        self.append(bytearray(self.read(size)))

    dispatch = {
        **{code: step for code, step in PYTHONS.dispatch.items() if code not in UNKNOWN},
        pickle.REDUCE[0]: call,
        pickle.NEWOBJ[0]: call,
        pickle.BUILD[0]: build,
        pickle.DICT[0]: dictionary,
        pickle.SETITEM[0]: set_item,
        pickle.SETITEMS[0]: set_items,
        pickle.ADDITEMS[0]: add_items,
        pickle.FROZENSET[0]: frozen_set,
        pickle.BYTEARRAY8[0]: byte_array,
    }


PLAIN_KEYS = (str, int, float, bool, bytes, type(None), Name)


def _checked(key: Any) -> Any:
    """`key`, if it is plain: hashing or printing nested tuples may take unlimited time."""
    inner = key if type(key) is tuple else (key,)
    if not all(type(each) in PLAIN_KEYS for each in inner):
        raise TypeError("a key must be plain")
    return key


def _pairs(items: list[Any]) -> dict[Any, Any]:
    """Of key, value, key, value, ..."""
    return {_checked(k): v for k, v in zip(items[::2], items[1::2], strict=True)}


def _set(items: Iterable[Any] = ()) -> set[Any]:
    return {_checked(item) for item in items}


def _dictionary(content: Any = ()) -> dict[Any, Any]:
    pairs = content.items() if type(content) is dict else content
    return {_checked(key): value for key, value in pairs}


def _sizes(values: Any) -> tuple[int, ...]:
    if type(values) is not tuple or any(type(n) is not int or n < 0 for n in values):
        raise TypeError("sizes must be whole numbers from 0")
    return values


def _tensor(storage: Any, offset: Any, size: Any, stride: Any, *_ignored: Any) -> Tensor:
    """torch._utils._rebuild_tensor and _v2; gradients and hooks mean nothing here."""
    if not isinstance(storage, Tensor) or type(offset) is not int or offset < 0:
        raise TypeError("not a tensor")
    steps = zip(_sizes(size), _sizes(stride), strict=True)
    if 0 in size:
        return torch.empty(size, dtype=storage.dtype)
    if offset + sum((n - 1) * step for n, step in steps) >= len(storage):
        raise DamagedError("a tensor reaches outside its storage")
    return storage.as_strided(size, stride, storage.storage_offset() + offset)


def _tensor_v3(*arguments: Any) -> Tensor:
    """The same for a storage of bytes; the dtype is the seventh argument."""
    storage, *others, kind = arguments[:7]
    return _tensor(storage.view(DTYPES[kind.full]), *others)


def _parameter(data: Any, *_ignored: Any) -> Tensor:
    if not isinstance(data, Tensor):
        raise TypeError("not a parameter")
    return data


def _number_type(code: Any, *_ignored: Any) -> NumberType:
    if type(code) is not str or not re.fullmatch(r"[<>=|]?([iu][1248]|f[248]|b1)", code):
        raise RefusedError("holds an array whose elements are not plain numbers.")
    return NumberType(np.dtype(code))


def _array(shape: Any, kind: Any, fortran: Any, data: Any) -> Tensor:
    """The numbers of a NumPy array, a copy."""
    if type(data) is list:
        raise RefusedError("holds an array of Python objects; only arrays of numbers are read.")
    if type(data) is str:  # Python 2 knew no bytes
        data = data.encode("latin1")
    if type(kind) is not NumberType or type(data) not in (bytes, bytearray):
        raise TypeError("not the state of an array")
    order: Literal["C", "F"] = "F" if fortran in (True, "F") else "C"
    array = np.frombuffer(data, kind.dtype).reshape(_sizes(shape), order=order)
    return torch.from_numpy(np.array(array, kind.dtype.newbyteorder("="), order="C"))


def _encoded(text: Any, encoding: Any) -> bytes:
    """How protocols before 3 write bytes."""
    if type(text) is not str or encoding not in ("latin1", "latin-1"):
        raise TypeError("not bytes")
    return text.encode("latin1")


def _bytes(content: Any = b"", *encoding: Any) -> bytearray:
    if type(content) is str:
        return bytearray(_encoded(content, *encoding))
    if type(content) is not bytes:
        raise TypeError("not bytes")
    return bytearray(content)


BUILDERS: Mapping[str, Callable[..., Any]] = {
    **dict.fromkeys(("collections.OrderedDict", "collections.Counter"), _dictionary),
    "collections.defaultdict": lambda *_: {},
    "torch._utils._rebuild_tensor": _tensor,
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch._utils._rebuild_tensor_v3": _tensor_v3,
    "torch._utils._rebuild_parameter": _parameter,
    "torch._utils._rebuild_parameter_with_state": _parameter,
    "torch.Size": lambda sizes=(): tuple(sizes),
    "torch.device": lambda *_: Inert(),
    "numpy.dtype": _number_type,
    "_codecs.encode": _encoded,
    **{
        f"numpy.{core}.{name}": made
        for core in ("core", "_core")
        for name, made in (
            # Declared first, filled by its state.
            ("multiarray._reconstruct", lambda *_: torch.empty(0)),
            ("multiarray.scalar", lambda *_: Inert()),
            ("numeric._frombuffer", lambda data, kind, *form: _array(form[0], kind, form[1], data)),
        )
    },
    **{
        f"{module}.{name}": made
        for module in BUILTINS
        for name, made in (
            ("bytearray", _bytes),
            ("bytes", lambda: b""),
            ("set", _set),
            ("frozenset", lambda items=(): frozenset(_set(items))),
        )
    },
}
"""Full name in a file -> what answers it: none imports, looks up or calls anything by name."""
