"""Read files of torch.save without executing anything in them, and write those of rgbt.

`torch.load(weights_only=True)` reads tensors and plain values and refuses everything else. Objects
of known configuration classes are read as dictionaries, without importing the class. A file of
rgbt ends with its digest, in the comment of the zip archive, so that a copy carries it:

    sha256 = SHA-256 of the file as torch.save wrote it, that is without the comment

Other zip archives are checked with the CRC-32 of every entry.
"""

from __future__ import annotations

import hashlib
import os
import re
import struct
import zipfile
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, BinaryIO, cast

import numpy as np
import torch
from torch import Tensor

from rgbt.checks import InputError, one_line
from rgbt.files.atomic import replacing

COMMENT = b"rgbt sha256 %s"
LENGTH = len(COMMENT % bytes(64))

OMEGACONF_NODES = ("Any", "Integer", "Float", "String", "Boolean", "Path", "Bytes", "Enum")
SETTINGS = (
    *("detectron2.config.config.CfgNode", "fvcore.common.config.CfgNode", "yacs.config.CfgNode"),
    *("detectron2.config.CfgNode", "fvcore.common.CfgNode"),
    *("pytorch_lightning.utilities.parsing.AttributeDict",),
    *("lightning.pytorch.utilities.parsing.AttributeDict",),
    *("lightning_fabric.utilities.data.AttributeDict",),
    *("lightning.fabric.utilities.data.AttributeDict",),
    *("argparse.Namespace", "types.SimpleNamespace", "easydict.EasyDict", "addict.addict.Dict"),
    *("mmcv.utils.config.Config", "mmcv.utils.config.ConfigDict"),
    *("mmengine.config.config.Config", "mmengine.config.config.ConfigDict"),
    *("omegaconf.dictconfig.DictConfig", "omegaconf.listconfig.ListConfig"),
    *("omegaconf.base.ContainerMetadata", "omegaconf.base.Metadata"),
    *(f"omegaconf.nodes.{kind}Node" for kind in OMEGACONF_NODES),
)
"""Classes of settings: an object is a dictionary, its attributes are those of the dictionary."""

BUILTINS = ("int", "float", "str", "bool", "list", "dict", "tuple", "frozenset", "bytes")
IGNORED = (
    *(f"pathlib.{kind}" for kind in ("PosixPath", "PurePosixPath", "WindowsPath")),
    *("pathlib.PureWindowsPath", "pathlib._local.PosixPath", "pathlib._local.WindowsPath"),
    *("collections.defaultdict", "typing.Any"),
    *(f"{module}.{name}" for module in ("builtins", "__builtin__") for name in BUILTINS),
)
"""What else stands beside weights; none of it is weights."""


def _empty(*_: object) -> dict[Any, Any]:
    return {}


SCALAR, ARRAY = np.float64(0).__reduce__()[0], np.empty(0).__reduce__()[0]
KNOWN: list[Any] = [
    *((OrderedDict, name) for name in SETTINGS),
    *((_empty, name) for name in IGNORED),
    # Scores beside weights are often NumPy's numbers.
    *(np.dtype, np.ndarray, *(type(np.dtype(code)) for code in "?bhilqBHILQefd")),
    *((SCALAR, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")),
    *((ARRAY, f"numpy.{core}.multiarray._reconstruct") for core in ("core", "_core")),
]

BEFORE = r"(?s)^.*(WeightsUnpickler error: |trusted source\.)"
AFTER = "Please |In PyTorch |Check the documentation|Exception raised"
"""torch's advice before and after its reason: weights_only=False, which would execute the file."""


def read_torch_file(path: Path, *, mapped: bool = False) -> Any:
    """The value of a file of torch.save, tensors on the CPU.

    Args:
        path: of the file.
        mapped: whether tensors may stay in the file; writing to them does not reach it.

    Raises:
        InputError: missing, damaged, of another format, or it would execute code.
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
        reason = re.split(AFTER, re.sub(BEFORE, "", str(error)))[0]
        said = one_line(reason) or type(error).__name__
        raise InputError(
            f"{path} cannot be read as weights ({said}); give a file of a saved state_dict()."
        ) from error


def _check_zip(path: Path) -> None:
    """Raise ValueError for an archive whose content is not what was written."""
    with zipfile.ZipFile(path) as archive:
        entries, comment = archive.infolist(), archive.comment
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise ValueError("it is compressed; save it again with torch.save")
        if not comment.startswith(COMMENT % b""):
            # torch writes no checksums where they are disabled (set_crc32_options).
            if any(entry.CRC for entry in entries) and archive.testzip() is not None:
                raise ValueError("an entry does not match its checksum")
            return
    digest, left = hashlib.sha256(), path.stat().st_size - len(comment) - 2
    with path.open("rb") as file:
        while part := file.read(min(left, 2**20)):
            digest.update(part)
            left -= len(part)
    digest.update(bytes(2))  # the length of the comment, before there was one
    if comment != COMMENT % digest.hexdigest().encode():
        raise ValueError("its content does not match its digest")


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
        file.write(struct.pack("<H", LENGTH))
        file.write(COMMENT % hashing.digest.hexdigest().encode())


DTYPES = (
    *(torch.float16, torch.bfloat16, torch.float32, torch.float64),
    *(torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64),
)


def is_plain(value: object) -> bool:
    """Whether a value is a tensor in memory that any operation takes, of one of `DTYPES`."""
    return (
        isinstance(value, Tensor)
        and value.layout is torch.strided
        and value.device.type == "cpu"
        and value.dtype in DTYPES
    )


def misfits(own: Mapping[str, Tensor], stored: Mapping[str, Any]) -> list[str]:
    """What keeps the tensors of a checkpoint from their places, in words; none: nothing.

    Args:
        own: entries of the network or optimizer, with their shapes and types.
        stored: those of the file; torch itself compares no types.
    """
    found = [f"{name} is missing" for name in own.keys() - stored.keys()]
    found += [f"{name} is unknown" for name in stored.keys() - own.keys()]
    for name in own.keys() & stored.keys():
        tensor, place = stored[name], own[name]
        if not is_plain(tensor) or (tensor.shape, tensor.dtype) != (place.shape, place.dtype):
            found.append(f"{name} is {in_words(tensor)} instead of {in_words(place)}")
    return sorted(found)


def in_words(value: object) -> str:
    """Shape and type: "9x32 float32"."""
    if not isinstance(value, Tensor):
        return f"a {type(value).__name__}"
    size = "x".join(map(str, value.shape)) or "one"
    return f"{size} {str(value.dtype).removeprefix('torch.')}"
