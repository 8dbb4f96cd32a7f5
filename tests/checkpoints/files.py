"""Synthetic files of weights: every tensor holds one number, which follows from its name.

Such a tensor takes one number on disk, whatever its shape, and still tells where it ended up.
"""

from __future__ import annotations

import copy
import zlib
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from tests.models import golden

SWIN = {"embed_dim": 32, "depths": [1, 1, 2, 1], "num_heads": [1, 2, 4, 8], "window_size": 5}
MIT = {"embed_dims": [16, 32, 64, 96], "depths": [1, 1, 1, 1], "num_heads": [1, 2, 4, 6]}
"""Sizes of networks that the files of `tests.checkpoints.imagenet` fill."""

PROTOTYPES: dict[str, nn.Module] = {}
"""Networks that were requested before; composing a configuration takes longer than copying."""


def network(yaml: str, num_classes: int = 9, **changed: Any) -> nn.Module:
    """As `golden.network`; each call gives another network with the same initial weights."""
    key = repr((yaml, num_classes, changed))
    if key not in PROTOTYPES:
        PROTOTYPES[key] = golden.network(yaml, num_classes, **changed)
    return copy.deepcopy(PROTOTYPES[key])


def number(name: str) -> int:
    """A number below 2^16 for a name; exact in float32."""
    return zlib.crc32(name.encode()) % 65536


def tensor(name: str, shape: Any, dtype: torch.dtype = torch.float32) -> Tensor:
    """`shape` times the number of `name`, without memory for it."""
    return torch.full((1,), number(name)).to(dtype).expand(tuple(shape) or (1,)).reshape(shape)


def named(shapes: Mapping[str, Any]) -> OrderedDict[str, Tensor]:
    """Floating tensors by name."""
    return OrderedDict((name, tensor(name, shape)) for name, shape in shapes.items())


def like(state: Mapping[str, Tensor], prefix: str = "") -> OrderedDict[str, Tensor]:
    """A file's tensors for a network's entries, with a prefix before each name."""
    return OrderedDict(
        (prefix + key, tensor(prefix + key, value.shape, value.dtype))
        for key, value in state.items()
    )


def saved(folder: Path, content: Any, *, name: str = "file.pth", legacy: bool = False) -> Path:
    """A file of torch.save."""
    path = folder / name
    torch.save(content, path, _use_new_zipfile_serialization=not legacy)
    return path


def holds(value: Tensor, name: str) -> bool:
    """Whether an entry holds the number of `name`, everywhere."""
    return bool((value == number(name)).all())
