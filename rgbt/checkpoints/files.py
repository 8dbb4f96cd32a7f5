"""Read files of weights in all formats without executing anything in them, and write ours.

`torch.load(weights_only=True)` reads tensors and plain values and refuses everything else. Objects
of known configuration classes are read as dictionaries, without importing the class. A file of
rgbt ends with its digest, in the comment of the zip archive, so that a copy carries it: the SHA-256
of everything before the comment and its length. Other zip archives are checked with the CRC-32 of
every entry.
"""

from __future__ import annotations

import hashlib
import os
import re
import struct
import zipfile
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from rgbt.checks import InputError, one_line
from rgbt.files.atomic import replacing
from rgbt.files.plain_files import disguise

COMMENT = b"rgbt sha256 %s"

# Keys under which releases put their weights.
WRAPPERS = ("state_dict", "model", "module", "model_state_dict")

# Prefixes that DataParallel and torch.compile add to every name.
PREFIXES = ("module.", "_orig_mod.")

# Key of the note in an export, and of the run that a checkpoint belongs to.
NOTE = "rgbt"

LAST = {"model", "others", "optimizers", "state"}
# Other keys of a run's last checkpoint, of one with averaged weights, and of the best one.
OURS = (LAST, LAST | {"unaveraged"}, {"model", "step"})

ATTRIBUTES = ("pytorch_lightning.utilities.parsing", "lightning.pytorch.utilities.parsing")
MM = ("cv.utils.config", "engine.config.config")
OMEGACONF_NODES = ("Any", "Integer", "Float", "String", "Boolean", "Path", "Bytes", "Enum")
# Classes of settings: an object is a dictionary, its attributes are those of the dictionary.
SETTINGS = (
    *(f"{module}.CfgNode" for module in ("detectron2.config", "detectron2.config.config")),
    "fvcore.common.CfgNode",
    "fvcore.common.config.CfgNode",
    "yacs.config.CfgNode",
    *(f"{module}.AttributeDict" for module in ATTRIBUTES),
    *(f"lightning{mark}fabric.utilities.data.AttributeDict" for mark in "_."),
    "argparse.Namespace",
    "types.SimpleNamespace",
    "easydict.EasyDict",
    "addict.addict.Dict",
    *(f"mm{part}.Config{kind}" for part in MM for kind in ("", "Dict")),
    "omegaconf.dictconfig.DictConfig",
    "omegaconf.listconfig.ListConfig",
    "omegaconf.base.ContainerMetadata",
    "omegaconf.base.Metadata",
    *(f"omegaconf.nodes.{kind}Node" for kind in OMEGACONF_NODES),
)

BUILTINS = ("int", "float", "str", "bool", "list", "dict", "tuple", "frozenset", "bytes")
# Entries beside weights that hold no weights.
IGNORED = (
    *(f"pathlib.{kind}" for kind in ("PosixPath", "PurePosixPath", "WindowsPath")),
    "pathlib.PureWindowsPath",
    "pathlib._local.PosixPath",
    "pathlib._local.WindowsPath",
    "collections.defaultdict",
    "typing.Any",
    *(f"{module}.{name}" for module in ("builtins", "__builtin__") for name in BUILTINS),
)


def _empty(*_: object) -> dict[Any, Any]:
    return {}


SCALAR, ARRAY = np.float64(0).__reduce__()[0], np.empty(0).__reduce__()[0]
KNOWN: list[Any] = [
    *((OrderedDict, name) for name in SETTINGS),
    *((_empty, name) for name in IGNORED),
    # Scores beside weights are often NumPy's numbers.
    np.dtype,
    np.ndarray,
    *(type(np.dtype(code)) for code in "?bhilqBHILQefd"),
    *((SCALAR, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")),
    *((ARRAY, f"numpy.{core}.multiarray._reconstruct") for core in ("core", "_core")),
]

ADVICE_BEFORE = r"(?s)^.*(WeightsUnpickler error: |trusted source\.)"
# torch's advice before and after its reason: weights_only=False, which would execute the file.
ADVICE_AFTER = "Please |In PyTorch |Check the documentation|Exception raised"

DTYPES = (
    torch.float16,
    torch.bfloat16,
    torch.float32,
    torch.float64,
    torch.bool,
    torch.uint8,
    torch.int8,
    torch.int16,
    torch.int32,
    torch.int64,
)


@dataclass(frozen=True)
class Contents:
    """A file of weights.

    Attributes:
        tensors: by name, views of the file where possible; prefixes of wrappers are taken off.
        settings: values of configuration objects in the file, by dotted key.
        ours: written by this project, with the names of its network.
        note: the note of an export.
    """

    path: Path
    tensors: Mapping[str, Tensor]
    settings: Mapping[str, Any] = field(default_factory=dict)
    ours: bool = False
    note: Mapping[str, str] = field(default_factory=dict)


def read(path: Path) -> Contents:
    """Read names and tensors of a file of torch.save or of safetensors.

    Raises:
        InputError: missing, damaged, of another kind, or it would execute code.
    """
    if path.is_file() and path.open("rb").read(9)[8:] == b"{":  # behind the length of its header
        contents = _read_safetensors(path)
    else:
        contents = _unwrapped(path, read_torch_file(path, mapped=True))
    for name, tensor in contents.tensors.items():
        if not is_plain(tensor):
            raise InputError(f"{path}: {name!r} is {in_words(tensor)}, which is not read.")
    return contents


def read_torch_file(path: Path, *, mapped: bool = False) -> Any:
    """Read the value of a file of torch.save, tensors on the CPU; errors as of `read`.

    Where `mapped`, tensors may stay in the file; writing to them does not reach it.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file of weights.")
    try:
        is_zip = zipfile.is_zipfile(path)
        if is_zip:
            _check_zip(path)
        with torch.serialization.safe_globals(KNOWN):
            return torch.load(path, map_location="cpu", weights_only=True, mmap=is_zip and mapped)
    except Exception as error:  # torch raises anything on damaged bytes
        reason = re.split(ADVICE_AFTER, re.sub(ADVICE_BEFORE, "", str(error)))[0]
        said = disguise(path) or one_line(reason) or type(error).__name__
        raise InputError(
            f"{path} cannot be read as weights ({said}); give a file of a saved state_dict()."
        ) from error


def save(path: Path, value: Any) -> None:
    """Write tensors and plain values with their digest: a whole file, or none.

    Raises:
        OSError: the file cannot be written; an older file of this name is kept.
    """
    digest, end = hashlib.sha256(), b""
    with replacing(path, lambda: _bytes_of(value)) as file:

        def write(part: memoryview) -> None:
            nonlocal end
            digest.update(end)
            digest.update(part[:-2])
            end = bytes(part[-2:])
            file.write(part)

        torch.save(value, cast(Any, SimpleNamespace(write=write, flush=file.flush)))
        file.seek(-2, os.SEEK_END)  # torch ends the archive with the length of no comment
        comment = COMMENT % digest.hexdigest().encode()
        file.write(struct.pack("<H", len(comment)) + comment)


def _bytes_of(value: Any) -> int:
    """Size of what torch.save writes, without the memory for it."""
    sizes: list[int] = []
    write = lambda part: sizes.append(memoryview(part).nbytes)  # noqa: E731
    torch.save(value, cast(Any, SimpleNamespace(write=write, flush=lambda: None)))
    return sum(sizes)


def _check_zip(path: Path) -> None:
    """Raise ValueError for an archive whose content is not what was written."""
    with zipfile.ZipFile(path) as archive:
        entries, comment = archive.infolist(), archive.comment
        if not any(entry.filename.endswith("data.pkl") for entry in entries):
            held = ", ".join(entry.filename for entry in entries[:3])
            raise ValueError(f"it is a zip archive of {held}; unpack it")
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise ValueError("it is compressed; save it again with torch.save")
        if comment.startswith(COMMENT % b""):
            if comment != COMMENT % _digest(path, path.stat().st_size - len(comment) - 2):
                raise ValueError("its content does not match its digest")
        # torch writes no checksums where they are disabled (set_crc32_options).
        elif any(entry.CRC for entry in entries) and archive.testzip() is not None:
            raise ValueError("an entry does not match its checksum")


def _digest(path: Path, size: int) -> bytes:
    """SHA-256 of the first `size` bytes of a file, in hexadecimal."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while part := file.read(min(size - file.tell(), 2**20)):
            digest.update(part)
    return digest.hexdigest().encode()


def _read_safetensors(path: Path) -> Contents:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            metadata = dict(file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, RuntimeError) as error:
        said = disguise(path) or one_line(error)
        raise InputError(f"{path} cannot be read as weights ({said}).") from error
    start = f"{NOTE}."
    note = {k.removeprefix(start): v for k, v in metadata.items() if k.startswith(start)}
    return Contents(path, _without_prefixes(tensors), ours=bool(note), note=note)


def _unwrapped(path: Path, value: Any) -> Contents:
    """The tensors of a file, which are at the top level or under one known key."""
    if not isinstance(value, dict):
        raise InputError(f"{path} holds a {type(value).__name__}; give a saved state_dict().")
    inner = [key for key in WRAPPERS if _is_state(value.get(key))]
    if not inner and not _is_state(value):  # a key of the author's own
        inner = [key for key in value if type(key) is str and _is_state(value[key])]
        if not inner:
            raise InputError(f"{path} holds no tensors by name; its keys are: {list(value)[:6]}.")
    if len(inner) > 1:
        raise InputError(f"{path} holds weights under {inner}; keep one of them in the file.")
    state = value[inner[0]] if inner else value
    found = value.get(NOTE) if inner else None
    note = {}
    for key, text in found.items() if isinstance(found, dict) else ():
        if type(key) is str and type(text) is str:
            note[key] = text
    return Contents(
        path,
        _without_prefixes({k: value for k, value in state.items() if isinstance(value, Tensor)}),
        settings=dict(_settings(value)) if inner else {},
        ours=value.keys() - {NOTE} in OURS,
        note=note,
    )


def _is_state(value: object) -> bool:
    """Whether a dictionary is tensors by name."""
    return (
        isinstance(value, dict)
        and any(isinstance(entry, Tensor) for entry in value.values())
        and all(type(key) is str for key in value)
    )


def _without_prefixes(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Take the `PREFIXES` off that all names have."""
    for prefix in PREFIXES:
        if tensors and prefix not in tensors and all(name.startswith(prefix) for name in tensors):
            shorter = {name.removeprefix(prefix): tensor for name, tensor in tensors.items()}
            return _without_prefixes(shorter)
    return tensors


def _settings(value: dict[Any, Any]) -> Iterator[tuple[str, Any]]:
    """Dotted key and value of plain values in the configuration of a file, five levels deep."""
    yield from ((key, value[key]) for key in ("step", "epoch") if isinstance(value.get(key), int))
    for key in ("hyper_parameters", "args", "config", "state"):
        yield from _leaves(value.get(key), "", 5)


def _leaves(node: Any, path: str, levels: int) -> Iterator[tuple[str, Any]]:
    items = {**node, **vars(node)} if isinstance(node, OrderedDict) else node
    for key, child in items.items() if isinstance(items, dict) and levels else ():
        dotted = f"{path}.{key}".lstrip(".")
        if isinstance(child, str | int | float):
            yield dotted, child
        yield from _leaves(child, dotted, levels - 1)


def is_plain(value: object) -> bool:
    """Whether a value is a tensor in memory that any operation takes, of one of `DTYPES`."""
    return (
        isinstance(value, Tensor)
        and value.layout is torch.strided
        and value.device.type == "cpu"
        and value.dtype in DTYPES
    )


def misfits(own: Mapping[str, Tensor], stored: Mapping[str, Any]) -> list[str]:
    """List in words what keeps `stored` tensors of a checkpoint from the places of a network.

    torch itself compares no types.
    """
    found = [f"{name} is missing" for name in own.keys() - stored.keys()]
    found += [f"{name} is unknown" for name in stored.keys() - own.keys()]
    for name in own.keys() & stored.keys():
        tensor, place = stored[name], own[name]
        if not is_plain(tensor) or (tensor.shape, tensor.dtype) != (place.shape, place.dtype):
            found.append(f"{name} is {in_words(tensor)} instead of {in_words(place)}")
    return sorted(found)


def in_words(value: object) -> str:
    """Write shape and type: "9x32 float32"."""
    if not isinstance(value, Tensor):
        return f"a {type(value).__name__}"
    size = "x".join(map(str, value.shape)) or "one"
    return f"{size} {str(value.dtype).removeprefix('torch.')}"
