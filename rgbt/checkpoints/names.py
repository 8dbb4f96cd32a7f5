"""Names that a pickle may contain in addition to those that rgbt builds (`pickles.BUILDERS`)."""

from __future__ import annotations

from collections.abc import Mapping

import torch

BUILTINS = ("builtins", "__builtin__")
"""The same module in Python 3, and in Python 2 and pickles up to protocol 2."""

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
"""Classes of settings, known by name; their objects are read as `Inert`."""
