"""What may come out of a pickle, besides plain Python values: inert records of ours."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor


class RefusedError(Exception):
    """A file wants what it does not get; the message continues the file's name."""

    @classmethod
    def code(cls, name: str) -> RefusedError:
        """For a name outside the known ones."""
        return cls(
            f"asks for {printable(name)}, which would run code on reading, so nothing of it was "
            "read; give a file that holds tensors and plain values only, such as a saved "
            "state_dict()."
        )

    @classmethod
    def greedy(cls) -> RefusedError:
        """For content that would grow beyond all proportion."""
        return cls(
            "would take far more memory than it has bytes; it is damaged, or made to do harm."
        )


class DamagedError(Exception):
    """A file that is cut short, overwritten, or not what its beginning says."""


def printable(text: str, limit: int = 100) -> str:
    """`text` from a file, for a terminal: no control characters, not endless."""
    shown = text if text.isprintable() else text.encode("unicode_escape").decode("ascii")
    return shown if len(shown) <= limit else f"{shown[: limit - 3]}..."


@dataclass(frozen=True)
class Name:
    """A name in a file, such as ``torch.FloatStorage``; never looked up."""

    full: str


@dataclass(eq=False)
class Storage:
    """Numbers in a row.

    Attributes:
        dtype: of a number.
        count: of numbers.
        data: (count,) once the container has located it.
    """

    dtype: torch.dtype
    count: int
    data: Tensor | None = None

    @property
    def num_bytes(self) -> int:
        """Size in the file."""
        return self.count * self.dtype.itemsize


@dataclass(eq=False)
class Strided:
    """A tensor as torch describes it: part of a storage."""

    storage: Storage
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]

    @property
    def num_bytes(self) -> int:
        """What a copy takes; more than the storage where a stride is 0."""
        return math.prod(self.size) * self.storage.dtype.itemsize

    def tensor(self) -> Tensor:
        """A view of the storage.

        Raises:
            DamagedError: it would reach outside.
        """
        data = self.storage.data
        last = self.offset + sum(
            (n - 1) * step for n, step in zip(self.size, self.stride, strict=True)
        )
        if data is None or (last >= len(data) and 0 not in self.size):
            raise DamagedError("a tensor reaches outside its storage")
        if 0 in self.size:
            return torch.empty(self.size, dtype=data.dtype)
        return data.as_strided(self.size, self.stride, data.storage_offset() + self.offset)


@dataclass(eq=False)
class NumberType:
    """A NumPy dtype of plain numbers: kind and size, then the byte order."""

    code: str
    order: str = "="

    def build(self, state: Any) -> None:
        """Take the byte order from NumPy's state of a dtype."""
        if state[1] in ("<", ">"):
            self.order = state[1]

    def dtype(self) -> np.dtype[Any]:
        """As NumPy has it."""
        return np.dtype(f"{self.order}{self.code}")


@dataclass(eq=False)
class Array:
    """A NumPy array of plain numbers: declared first, filled by its state."""

    shape: tuple[int, ...] = ()
    kind: NumberType | None = None
    data: bytes | bytearray = b""
    fortran: bool = False

    def build(self, state: Any) -> None:
        """Take (version, shape, dtype, Fortran order, data), without version in old files.

        Raises:
            RefusedError: an array of objects, whose elements are values of any kind.
        """
        shape, kind, fortran, data = state[-4:]
        if isinstance(data, list):
            raise RefusedError("holds an array of Python objects; only arrays of numbers are read.")
        if isinstance(data, str):  # Python 2 knew no bytes
            data = data.encode("latin1")
        if not isinstance(kind, NumberType) or not isinstance(data, bytes | bytearray):
            raise TypeError("not the state of an array")
        self.shape, self.kind, self.fortran, self.data = sizes_of(shape), kind, bool(fortran), data

    @cached_property
    def copied(self) -> Tensor:
        """The numbers as a tensor of their own, one however many names they have.

        Raises:
            DamagedError: shape and data do not fit.
        """
        dtype = (self.kind or NumberType("f4")).dtype()
        if math.prod(self.shape) * dtype.itemsize != len(self.data):
            raise DamagedError("an array is shorter or longer than its shape")
        flat = np.frombuffer(self.data, dtype)
        array = flat.reshape(self.shape, order="F" if self.fortran else "C")
        return torch.from_numpy(np.array(array, dtype.newbyteorder("="), order="C"))

    def tensor(self) -> Tensor:
        """See `copied`."""
        return self.copied


class Inert:
    """Placeholder for an object of a configuration class: keeps what it is given, does nothing.

    Attributes:
        name: of the class in the file.
        items: its keys, where it is a dictionary or gets attributes.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.items: dict[Any, Any] = {}

    def update(self, pairs: Any) -> None:
        """Take keys and values."""
        self.items.update(pairs)

    def extend(self, items: list[Any]) -> None:
        """Lists of configurations are of no use here."""

    def build(self, state: Any) -> None:
        """Take a state, attributes if it is a dictionary."""
        if type(state) is dict:
            self.items.update(state)


def sizes_of(values: Any) -> tuple[int, ...]:
    """`values` where they are the sizes of a tensor, else TypeError."""
    if not isinstance(values, tuple) or any(type(n) is not int or n < 0 for n in values):
        raise TypeError("sizes must be whole numbers from 0")
    return values


def retyped(storage: Storage, dtype: torch.dtype) -> tuple[torch.dtype, int]:
    """Another type for the bytes of a storage.

    Raises:
        TypeError: they were typed differently before, or do not divide.
    """
    if storage.dtype not in (torch.uint8, dtype) or storage.num_bytes % dtype.itemsize:
        raise TypeError("one storage of two types")
    return dtype, storage.num_bytes // dtype.itemsize


PLAIN_KEYS = (str, int, float, bool, bytes, type(None), Name)


def check_key(key: Any) -> Any:
    """`key` where hashing and printing it takes no time: nested tuples can take for ever.

    Raises:
        TypeError: anything but a plain value or a tuple of them.
    """
    inner = key if type(key) is tuple else (key,)
    if not all(type(each) in PLAIN_KEYS for each in inner):
        raise TypeError("a key must be plain")
    return key
