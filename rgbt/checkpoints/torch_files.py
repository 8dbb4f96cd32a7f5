"""Read files of torch.save without executing anything in them, and write those of rgbt.

`torch.load(weights_only=True)` reads tensors and plain values and refuses everything else. Objects
of known configuration classes are read as dictionaries, without importing the class. A file of
rgbt ends with its digest, in the comment of the zip archive:

    sha256 = SHA-256 of the file as torch.save wrote it, that is without the comment

so that a copy carries it. Other zip archives are checked with the CRC-32 of every entry.
"""

from __future__ import annotations

import hashlib
import mmap
import os
import re
import struct
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import IO, Any, BinaryIO, cast

import numpy as np
import torch

from rgbt.checks import InputError, one_line
from rgbt.files.atomic import replacing

COMMENT = b"rgbt sha256 %s"
LENGTH = len(COMMENT % bytes(64))

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
    *(f"omegaconf.nodes.{kind}Node" for kind in ("Any", "Integer", "Float", "String")),
    *(f"omegaconf.nodes.{kind}Node" for kind in ("Boolean", "Path", "Bytes", "Enum")),
)
"""Classes of settings: an object is a dictionary, its attributes are those of the dictionary."""

IGNORED = (
    *(f"pathlib.{kind}" for kind in ("PosixPath", "PurePosixPath", "WindowsPath")),
    *("pathlib.PureWindowsPath", "pathlib._local.PosixPath", "pathlib._local.WindowsPath"),
    *("collections.defaultdict", "typing.Any"),
    *(
        f"{module}.{name}"
        for module in ("builtins", "__builtin__")
        for name in ("int", "float", "str", "bool", "list", "dict", "tuple", "frozenset", "bytes")
    ),
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
    except InputError:
        raise
    except Exception as error:  # The border to torch, which raises anything on damaged bytes.
        # torch's own sentence advises weights_only=False, which would execute the file.
        reason = str(error).partition("WeightsUnpickler error: ")[2] or str(error)
        code = re.search(r"GLOBAL (\S+)|function <[\w-]+ (?:function )?(\S+?)>", reason)
        if code:
            raise InputError(
                f"{path} refers to {one_line(code[1] or code[2])}, which would execute code; give "
                "a file of tensors and plain values, such as a saved state_dict()."
            ) from error
        reason = re.split("Please |In PyTorch |Check the documentation|Exception raised", reason)[0]
        said = one_line(reason) or type(error).__name__
        raise InputError(f"{path} cannot be read: {said}.") from error


def _check_zip(path: Path) -> None:
    """Refuse an archive whose content is not what was written."""
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise InputError(f"{path} is compressed; save it again with torch.save.")
        if not any(entry.filename.endswith("data.pkl") for entry in entries):
            raise InputError(f"{path} is a zip archive, but not of torch.save; unpack it.")
        if not archive.comment.startswith(COMMENT % b""):
            # torch writes no checksums where they are disabled (set_crc32_options).
            if any(entry.CRC for entry in entries) and archive.testzip() is not None:
                raise InputError(f"{path} cannot be read: an entry does not match its checksum.")
            return
        comment = archive.comment
    with (
        path.open("rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content,
        memoryview(content) as whole,
        whole[: -len(comment) - 2] as written,
    ):
        digest = hashlib.sha256(written)
    digest.update(bytes(2))  # the length of the comment, before there was one
    if comment != COMMENT % digest.hexdigest().encode():
        raise InputError(f"{path} cannot be read: its content does not match its digest.")


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
