"""The names that a file may mention, and what answers those that it may call.

Each builder checks its arguments and makes a record or a plain value. None of them imports, looks
up or calls anything by a name from the file.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

import torch

from rgbt.checkpoints.records import (
    Array,
    Inert,
    Name,
    NumberType,
    RefusedError,
    Storage,
    Strided,
    check_key,
    retyped,
    sizes_of,
)

Builder = Callable[..., Any]
BUILTINS = ("builtins", "__builtin__")
"""The same module in Python 3, and in Python 2 and pickles up to protocol 2."""


def _strided(storage: Any, offset: Any, size: Any, stride: Any, *_ignored: Any) -> Strided:
    """torch._utils._rebuild_tensor and _v2; gradients and hooks mean nothing here."""
    if not isinstance(storage, Storage) or type(offset) is not int or offset < 0:
        raise TypeError("not a tensor")
    if len(sizes_of(size)) != len(sizes_of(stride)):
        raise TypeError("sizes and strides differ")
    return Strided(storage, offset, size, stride)


def _strided_v3(*arguments: Any) -> Strided:
    """The same for a storage of bytes; the dtype is the seventh argument."""
    storage, kind = arguments[0], arguments[6]
    if not isinstance(storage, Storage) or not isinstance(kind, Name):
        raise TypeError("not a tensor")
    storage.dtype, storage.count = retyped(storage, DTYPES[kind.full])
    return _strided(*arguments[:4])


def _parameter(data: Any, *_ignored: Any) -> Any:
    if not isinstance(data, Strided):
        raise TypeError("not a parameter")
    return data


def _dictionary(content: Any = ()) -> dict[Any, Any]:
    pairs = content.items() if type(content) is dict else content
    return {check_key(key): value for key, value in pairs}


def _number_type(code: Any, *_ignored: Any) -> NumberType:
    if not isinstance(code, str) or not re.fullmatch(r"[<>=|]?([iu][1248]|f[248]|b1)", code):
        raise RefusedError("holds an array of something else than plain numbers.")
    order = code[0] if code[0] in "<>" else "="
    return NumberType(code[-2:], order)


def _filled_array(data: Any, kind: Any, shape: Any, order: Any) -> Array:
    """NumPy's form from pickle protocol 5 on."""
    array = Array()
    array.build((sizes_of(shape), kind, order == "F", data))
    return array


def _encoded(text: Any, encoding: Any) -> bytes:
    """How protocols before 3 write bytes."""
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise TypeError("not bytes")
    return text.encode("latin1")


def _bytes(content: Any = b"", *encoding: Any) -> bytearray:
    if isinstance(content, str):
        return bytearray(_encoded(content, *encoding))
    if not isinstance(content, bytes):
        raise TypeError("not bytes")
    return bytearray(content)


def _set(items: Any = ()) -> set[Any]:
    return {check_key(item) for item in items}


BUILDERS: Mapping[str, Builder] = {
    **dict.fromkeys(("collections.OrderedDict", "collections.Counter"), _dictionary),
    "collections.defaultdict": lambda *_: {},
    "torch._utils._rebuild_tensor": _strided,
    "torch._utils._rebuild_tensor_v2": _strided,
    "torch._utils._rebuild_tensor_v3": _strided_v3,
    "torch._utils._rebuild_parameter": _parameter,
    "torch._utils._rebuild_parameter_with_state": _parameter,
    "torch.Size": lambda sizes=(): tuple(sizes),
    "torch.device": lambda *_: Inert("torch.device"),
    **dict.fromkeys(
        ("numpy.core.multiarray._reconstruct", "numpy._core.multiarray._reconstruct"),
        lambda *_: Array(),
    ),
    **dict.fromkeys(
        ("numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar"),
        lambda *_: Inert("number"),
    ),
    **dict.fromkeys(
        ("numpy.core.numeric._frombuffer", "numpy._core.numeric._frombuffer"), _filled_array
    ),
    "numpy.dtype": _number_type,
    "_codecs.encode": _encoded,
    **{f"{module}.bytearray": _bytes for module in BUILTINS},
    **{f"{module}.bytes": lambda: b"" for module in BUILTINS},
    **{f"{module}.set": _set for module in BUILTINS},
    **{f"{module}.frozenset": lambda items=(): frozenset(_set(items)) for module in BUILTINS},
}
"""Full name in a file -> what answers it."""

DTYPES: Mapping[str, torch.dtype] = {
    f"torch.{name}": getattr(torch, name)
    for name in (
        *("float32", "float64", "float16", "bfloat16", "bool", "uint8", "int8", "int16", "int32"),
        *("int64", "uint16", "uint32", "uint64"),
    )
}

UNTYPED = "torch.storage.UntypedStorage"

STORAGES: Mapping[str, torch.dtype] = {
    f"{module}.{kind}Storage": dtype
    for module in ("torch", "torch.cuda")
    for kind, dtype in {
        **{"Float": torch.float32, "Double": torch.float64, "Half": torch.float16},
        **{"BFloat16": torch.bfloat16, "Bool": torch.bool, "Byte": torch.uint8},
        **{"Char": torch.int8, "Short": torch.int16, "Int": torch.int32, "Long": torch.int64},
    }.items()
} | {UNTYPED: torch.uint8}
"""Classes of storages, which are named and never made by the file."""

PLAIN_NAMES = frozenset(
    {
        *STORAGES,
        *DTYPES,
        *("numpy.ndarray", "torch.Tensor", "typing.Any"),
        *(
            f"{module}.{name}"
            for module in BUILTINS
            for name in ("int", "float", "str", "bool", "list", "dict", "tuple")
        ),
    }
)
"""Names that a file may mention but not call."""

STAND_INS = frozenset(
    {
        *("detectron2.config.config.CfgNode", "fvcore.common.config.CfgNode"),
        *("yacs.config.CfgNode", "detectron2.config.CfgNode", "fvcore.common.CfgNode"),
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
        *(f"pathlib.{kind}" for kind in ("PosixPath", "PurePosixPath", "WindowsPath")),
        *("pathlib.PureWindowsPath", "pathlib._local.PosixPath", "pathlib._local.WindowsPath"),
    }
)
"""Classes of settings, known by name; an `Inert` takes the place of their objects."""
