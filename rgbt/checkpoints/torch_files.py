"""Files of torch.save: the zip archive since 1.6 and the sequence of pickles before.

Tensors are views of the mapped file, so that nothing is copied until it is put somewhere. The
mapping is private: writing to a tensor does not reach the file.
"""

from __future__ import annotations

import mmap
import struct
from io import BytesIO
from pathlib import Path
from typing import IO, Any, cast

import torch
from torch import Tensor

from rgbt.checkpoints.archives import listed_in, mapped, verified
from rgbt.checkpoints.builders import BUILDERS, STORAGES, UNTYPED
from rgbt.checkpoints.pickles import unpickle
from rgbt.checkpoints.records import DamagedError, Name, RefusedError, Storage

MAGIC = 0x1950A86A20F9469CFC6C
"""Value of the first pickle of a file from before 1.6."""

PROTOCOL = 1001
Buffer = mmap.mmap | bytes


class References:
    """Storages that a pickle refers to, by their key."""

    def __init__(self) -> None:
        self.storages: dict[str, Storage] = {}
        self.views: dict[str, tuple[str, int]] = {}

    def __call__(self, reference: Any) -> Storage:
        """The storage of ("storage", class, key, device, count[, view of another storage]).

        Raises:
            RefusedError: a whole module with its source, which torch kept before 1.0.
        """
        if not isinstance(reference, tuple) or reference[:1] not in (("storage",), ("module",)):
            raise TypeError("not a storage")
        if reference[0] == "module":
            raise RefusedError(
                "holds a whole network with its source code, which would have to run; give a file "
                "that holds its state_dict()."
            )
        kind, key, _, count, *view = reference[1:]
        if not isinstance(kind, Name) or type(key) is not str or type(count) is not int:
            raise TypeError("not a storage")
        if count < 0:
            raise ValueError("a storage of negative size")
        announced = Storage(STORAGES[kind.full], count)
        storage = self.storages.setdefault(key, announced)
        same = announced.dtype == storage.dtype or kind.full == UNTYPED
        if not same or announced.num_bytes != storage.num_bytes:
            raise TypeError("one storage of two types")
        if view and view[0] is not None:
            return self._view(storage, view[0])
        return storage

    def _view(self, whole: Storage, view: Any) -> Storage:
        """A part of a storage, as files from before 0.4 have them: (key, offset, count)."""
        key, offset, count = view
        if type(key) is not str or type(offset) is not int or type(count) is not int:
            raise TypeError("not a view")
        part = self.storages.setdefault(f"view {key}", Storage(whole.dtype, count))
        self.views[f"view {key}"] = next(k for k, s in self.storages.items() if s is whole), offset
        return part

    def locate(self, places: dict[str, Tensor]) -> None:
        """Give every storage its numbers.

        Args:
            places: key -> (n,) bytes or numbers, as they lie in the file.
        """
        for key, storage in self.storages.items():
            if key not in self.views:
                storage.data = places[key]
        for key, (whole, offset) in self.views.items():
            part, data = self.storages[key], self.storages[whole].data
            if data is None or offset < 0 or part.count < 0 or offset + part.count > len(data):
                raise DamagedError("a view reaches outside its storage")
            part.data = data[offset : offset + part.count]


def numbers(buffer: Buffer, start: int, storage: Storage) -> Tensor:
    """The numbers of a storage at a place in the file.

    Raises:
        DamagedError: the file ends before.
    """
    end = start + storage.num_bytes
    if end > len(buffer):
        raise DamagedError("the file ends within a tensor")
    if storage.count == 0:
        return torch.empty(0, dtype=storage.dtype)
    if start % storage.dtype.itemsize or isinstance(buffer, bytes):
        return torch.frombuffer(bytearray(buffer[start:end]), dtype=storage.dtype)
    return torch.frombuffer(buffer, dtype=storage.dtype, count=storage.count, offset=start)


def read_zip(path: Path) -> Any:
    """The value that torch.save wrote into a zip archive, tensors as `Strided`.

    Raises:
        RefusedError: another zip archive, a program, another byte order.
        DamagedError: cut short, overwritten.
    """
    buffer = mapped(path)
    listed = listed_in(path)
    root = next((name[:-8] for name in listed if name.endswith("data.pkl")), None)
    if root is None:
        raise RefusedError(
            "is a zip archive, but not one of torch.save; unpack it and name a file."
        )
    if f"{root}constants.pkl" in listed:
        raise RefusedError(
            "is a TorchScript program, which would have to run; give a file that holds its "
            "state_dict()."
        )
    entries = verified(buffer, listed)
    start, end = entries.get(f"{root}byteorder", (0, 0))
    if buffer[start:end] not in (b"", b"little"):
        raise RefusedError("was written on a big-endian machine, which is not supported.")
    references = References()
    start, end = entries[f"{root}data.pkl"]
    value = unpickle(BytesIO(buffer[start:end]), FULL, references)
    places = {}
    for key, storage in references.storages.items():
        start, end = entries[f"{root}data/{key}"]
        if end - start < storage.num_bytes:
            raise DamagedError("a tensor is longer than its entry")
        places[key] = numbers(buffer, start, storage)
    references.locate(places)
    return value


def read_pickles(buffer: Buffer) -> tuple[Any, str]:
    """The value of a file that is one pickle, or torch's sequence of pickles and numbers.

    Returns:
        the value, and the name of the format.
    """
    stream = cast(IO[bytes], buffer) if isinstance(buffer, mmap.mmap) else BytesIO(buffer)
    first = unpickle(stream, FULL, _no_reference)
    if first != MAGIC or type(first) is not int:
        return first, "pickle"
    return read_sequence(buffer, stream, nested=False), "torch.save before 1.6"


def read_sequence(buffer: Buffer, stream: IO[bytes], *, nested: bool) -> Any:
    """What follows the magic number: protocol, machine, value, keys, numbers."""
    protocol = unpickle(stream, {}, _no_reference)
    machine = unpickle(stream, {}, _no_reference)
    if protocol != PROTOCOL or not isinstance(machine, dict):
        raise DamagedError("another protocol")
    if machine.get("little_endian") is not True:
        raise RefusedError("was written on a big-endian machine, which is not supported.")
    references = References()
    value = unpickle(stream, BUILDERS if nested else FULL, references)
    keys = unpickle(stream, {}, _no_reference)
    places = {}
    for key in keys if isinstance(keys, list) else ():
        storage = references.storages[key]
        start = stream.tell() + 8
        places[key] = numbers(buffer, start, storage)
        if struct.unpack("<q", buffer[start - 8 : start]) != (storage.count,):
            raise DamagedError("a storage is not as long as announced")
        stream.seek(start + storage.num_bytes)
    references.locate(places)
    return value


def _nested(content: Any) -> Storage:
    """A storage that lies as a whole file in a pickle: tensors written by plain pickle.

    Raises:
        TypeError: something else lies there.
    """
    if not isinstance(content, bytes):
        raise TypeError("not a file")
    stream = BytesIO(content)
    if unpickle(stream, {}, _no_reference) != MAGIC:
        raise TypeError("not a file of torch.save")
    storage = read_sequence(content, stream, nested=True)
    if not isinstance(storage, Storage):
        raise TypeError("not a storage")
    return storage


def _no_reference(_: object) -> None:
    raise TypeError("refers to something outside")


FULL = {**BUILDERS, "torch.storage._load_from_bytes": _nested}
"""Builders of a whole file; a file inside it has only `BUILDERS`, so that there is one level."""
