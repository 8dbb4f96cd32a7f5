"""Read all files of tensors, and write those of rgbt.

Reading returns plain values and tensors, or raises an error with one message.
"""

from __future__ import annotations

import hashlib
import os
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, BinaryIO, cast

import torch
from torch import Tensor

from rgbt.checkpoints.pickles import DAMAGE, GROWTH, SMALL, RefusedError
from rgbt.checkpoints.torch_files import COMMENT, COMMENT_LENGTH, mapped, read_pickles, read_zip
from rgbt.checks import InputError
from rgbt.files.atomic import replacing

ZIP = "torch.save"
"""Name of the format that checkpoints have."""

OTHERS = {
    (b"version https://git-lfs",): (
        "is a Git LFS pointer and not the file itself; download the file with git lfs pull."
    ),
    (b"<!doctype", b"<html", b"<?xml", b"<head"): (
        "is a web page, probably the download page of the host; download the file itself."
    ),
    (b"\x1f\x8b", b"bzh", b"\xfd7zxz", b"7z\xbc\xaf", b"rar!"): (
        "is a compressed archive; unpack it and name the file of weights."
    ),
}
"""First bytes, in lower case, of files that are often downloaded by mistake instead of weights."""

PLAIN = (str, int, float, bool, type(None))
DEPTH = 20
"""Levels of containers in a value that rgbt writes; state_dict() of optimizers have four."""


@contextmanager
def explained(path: Path, kind: str, advice: str) -> Iterator[None]:
    """Turn errors in the content of a file into an InputError.

    Args:
        path: of the file.
        kind: what it was read as: "a file of weights".
        advice: what to do if the file is damaged: "copy or download it again".

    Raises:
        InputError: refused or damaged.
    """
    try:
        yield
    except InputError:  # a ValueError too, with its own sentence
        raise
    except RefusedError as refusal:
        raise InputError(f"{path} {refusal}") from refusal
    except DAMAGE as damage:
        raise InputError(
            f"{path} cannot be read as {kind}: it is truncated, damaged or of another format; "
            f"{advice}."
        ) from damage


def read_torch_file(path: Path) -> tuple[Any, str]:
    """The value of a file of torch.save or pickle, and the name of its format.

    Objects of known classes of configurations are `pickles.Inert`.

    Raises:
        RefusedError: it requests code, or too much memory, or is another kind of file.
        Exception: one of `DAMAGE`: it is cut short or overwritten.
    """
    beginning = beginning_of(path)
    if beginning.startswith(b"PK\x03\x04"):
        return read_zip(path), ZIP
    for others, what in OTHERS.items():
        if beginning.lstrip().lower().startswith(others):
            raise RefusedError(what)
    if beginning[257:262] == b"ustar":
        raise RefusedError("is a tar archive; unpack it, or save it again with torch 1.6 or later.")
    if not beginning.startswith((b"\x80", b"(", b"}", b"c", b"]")):
        raise RefusedError(
            "is not a file of weights. Supported formats: torch.save, pickles of arrays or "
            "tensors, safetensors."
        )
    return read_pickles(mapped(path))


def beginning_of(path: Path) -> bytes:
    """The first 512 bytes.

    Raises:
        InputError: there is no such file, or nothing in it.
    """
    if path.is_dir():
        raise InputError(f"{path} is a folder; name a file of weights instead.")
    if not path.is_file():
        raise InputError(f"the file of weights {path} does not exist.")
    with path.open("rb") as file:
        beginning = file.read(512)
    if not beginning:
        raise InputError(f"{path} is empty; copy or download it again.")
    return beginning


def plain(value: Any, num_bytes: int) -> Any:
    """A value that rgbt wrote, with its tensors copied from the file.

    Args:
        value: see `read_torch_file`.
        num_bytes: size of the file, which bounds what all tensors together may take.

    Raises:
        RefusedError: the tensors would take far more.
        TypeError: anything but dictionaries, lists and tuples of plain values and tensors.
    """
    budget = GROWTH * num_bytes + SMALL
    known: dict[int, Any] = {}  # one container in many places is copied once

    def copied(value: Any, depth: int) -> Any:
        nonlocal budget
        if type(value) is str:
            # One object for equal texts, as in a program: what is saved again has the same bytes.
            return sys.intern(value)
        if type(value) in PLAIN or id(value) in known:
            return known.get(id(value), value)
        if depth == 0:
            raise TypeError("too many levels")
        if isinstance(value, Tensor):
            budget -= value.nbytes
            if budget < 0:
                raise RefusedError.greedy()
            known[id(value)] = value.clone()
        elif type(value) is dict and all(type(key) in (str, int) for key in value):
            pairs = value.items()
            known[id(value)] = {copied(k, depth): copied(each, depth - 1) for k, each in pairs}
        elif type(value) in (list, tuple):
            known[id(value)] = type(value)(copied(each, depth - 1) for each in value)
        else:
            raise TypeError("not a plain value")
        return known[id(value)]

    return copied(value, DEPTH)


class _Hashing:
    """A stream that writes to a file and hashes what is written."""

    def __init__(self, file: BinaryIO) -> None:
        self.file = file
        self.digest = hashlib.sha256()

    def write(self, content: bytes) -> int:
        self.digest.update(content)
        return self.file.write(content)

    def flush(self) -> None:
        self.file.flush()


def save(path: Path, value: Any) -> None:
    """Write tensors and plain values with their digest: a whole file, or none.

    Raises:
        OSError: the file cannot be written; an older file of this name is kept.
    """
    with replacing(path) as file:
        hashing = _Hashing(file)
        torch.save(value, cast(IO[bytes], hashing))
        # torch ends the archive without a comment: its length is the last two bytes.
        file.seek(-2, os.SEEK_CUR)
        file.write(struct.pack("<H", COMMENT_LENGTH))
        file.write(COMMENT % hashing.digest.hexdigest().encode())
