"""Files of ImageNet networks as their authors' code names them, built without our networks."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from tests.checkpoints.files import named, tensor

ENDS = ("weight", "bias")
STATISTICS = (*ENDS, "running_mean", "running_var")
BLOCKS = {
    18: (2, 2, 2, 2),
    34: (3, 4, 6, 3),
    50: (3, 4, 6, 3),
    101: (3, 4, 23, 3),
    152: (3, 8, 36, 3),
}


def linear(name: str, before: int, after: int) -> dict[str, Any]:
    return {f"{name}.weight": (after, before), f"{name}.bias": (after,)}


def norms(names: Iterable[str], width: int) -> dict[str, Any]:
    return {f"{name}.{end}": (width,) for name in names for end in ENDS}


def swin_file(
    width: int = 32,
    depths: tuple[int, ...] = (1, 1, 2, 1),
    heads: tuple[int, ...] = (1, 2, 4, 8),
    window: int = 5,
) -> OrderedDict[str, Tensor]:
    """ImageNet Swin, `microsoft/Swin-Transformer`."""
    shapes: dict[str, Any] = {
        "patch_embed.proj.weight": (width, 3, 4, 4),
        "patch_embed.proj.bias": (width,),
        **norms(["patch_embed.norm"], width),
    }
    numbers = {}
    for stage, (depth, head) in enumerate(zip(depths, heads, strict=True)):
        dim = width * 2**stage
        for block in range(depth):
            at = f"layers.{stage}.blocks.{block}"
            if block % 2 and stage < 3:
                shapes[f"{at}.attn_mask"] = (64 // 4**stage, window**2, window**2)
            shapes |= norms((f"{at}.norm1", f"{at}.norm2"), dim)
            shapes[f"{at}.attn.relative_position_bias_table"] = ((2 * window - 1) ** 2, head)
            numbers[f"{at}.attn.relative_position_index"] = (window**2, window**2)
            shapes |= linear(f"{at}.attn.qkv", dim, 3 * dim) | linear(f"{at}.attn.proj", dim, dim)
            shapes |= linear(f"{at}.mlp.fc1", dim, 4 * dim) | linear(f"{at}.mlp.fc2", 4 * dim, dim)
        if stage < 3:
            at = f"layers.{stage}.downsample"
            shapes |= norms([f"{at}.norm"], 4 * dim)
            shapes[f"{at}.reduction.weight"] = (2 * dim, 4 * dim)
    shapes |= norms(["norm"], width * 2**3) | linear("head", width * 2**3, 1000)
    indices = {name: tensor(name, shape, torch.int64) for name, shape in numbers.items()}
    return named(shapes) | indices


def mit_file(
    dims: tuple[int, ...] = (16, 32, 64, 96), depths: tuple[int, ...] = (1, 1, 1, 1)
) -> OrderedDict[str, Tensor]:
    """ImageNet MiT, `NVlabs/SegFormer`."""
    shapes: dict[str, Any] = linear("head", dims[3], 1000)
    before = 3
    for stage, (dim, depth, ratio) in enumerate(zip(dims, depths, (8, 4, 2, 1), strict=True), 1):
        kernel = 7 if stage == 1 else 3
        shapes[f"patch_embed{stage}.proj.weight"] = (dim, before, kernel, kernel)
        shapes[f"patch_embed{stage}.proj.bias"] = (dim,)
        shapes |= norms((f"patch_embed{stage}.norm", f"norm{stage}"), dim)
        for block in range(depth):
            at = f"block{stage}.{block}"
            shapes |= norms((f"{at}.norm1", f"{at}.norm2"), dim)
            shapes |= linear(f"{at}.attn.q", dim, dim) | linear(f"{at}.attn.kv", dim, 2 * dim)
            shapes |= linear(f"{at}.attn.proj", dim, dim)
            shapes |= linear(f"{at}.mlp.fc1", dim, 4 * dim) | linear(f"{at}.mlp.fc2", 4 * dim, dim)
            shapes[f"{at}.mlp.dwconv.dwconv.weight"] = (4 * dim, 1, 3, 3)
            shapes[f"{at}.mlp.dwconv.dwconv.bias"] = (4 * dim,)
            if ratio > 1:
                shapes[f"{at}.attn.sr.weight"] = (dim, dim, ratio, ratio)
                shapes[f"{at}.attn.sr.bias"] = (dim,)
                shapes |= norms([f"{at}.attn.norm"], dim)
        before = dim
    return named(shapes)


def resnet_file(
    layers: int,
    *,
    counters: bool = True,
    prefix: str = "",
    width: int = 64,
    more: Sequence[str] = (),
) -> OrderedDict[str, Tensor]:
    """torchvision's ResNets."""
    bottleneck = layers >= 50
    shapes: dict[str, Any] = {"conv1.weight": (width, 3, 7, 7)}
    sizes, before = {"bn1": width}, width
    for stage, depth in enumerate(BLOCKS[layers], 1):
        inner = width * 2 ** (stage - 1)
        out = 4 * inner if bottleneck else inner
        for block in range(depth):
            at = f"layer{stage}.{block}"
            sides = ((1, before, inner), (3, inner, inner), (1, inner, out))
            if not bottleneck:
                sides = ((3, before, inner), (3, inner, out))
            for index, (side, source, target) in enumerate(sides, 1):
                shapes[f"{at}.conv{index}.weight"] = (target, source, side, side)
                sizes[f"{at}.bn{index}"] = target
            if before != out:
                shapes[f"{at}.downsample.0.weight"] = (out, before, 1, 1)
                sizes[f"{at}.downsample.1"] = out
            before = out
    shapes |= {f"{norm}.{end}": (size,) for norm, size in sizes.items() for end in STATISTICS}
    shapes |= {} if prefix else linear("fc", before, 1000)
    tensors = named({f"{prefix}{name}": shape for name, shape in shapes.items()})
    tensors |= named(dict.fromkeys(more, (21, 2048, 3, 3)))
    for name in (f"{prefix}{norm}.num_batches_tracked" for norm in sizes if counters):
        tensors[name] = tensor(name, (), torch.int64)
    return tensors


def deep_resnet_file(width: int) -> OrderedDict[str, Tensor]:
    """The ResNet-50 of semseg, with three stem convolutions of width, width and 2 width."""
    sizes = {"conv1": (width, 3), "conv2": (width, width), "conv3": (2 * width, width)}
    deep: dict[str, Any] = {f"{name}.weight": (*size, 3, 3) for name, size in sizes.items()}
    deep |= {f"bn{n}.{end}": (width * (1 + n // 3),) for n in (1, 2, 3) for end in STATISTICS}
    deep["layer1.0.conv1.weight"] = (width, 2 * width, 1, 1)
    deep["layer1.0.downsample.0.weight"] = (4 * width, 2 * width, 1, 1)
    return resnet_file(50, width=width) | named(deep)
