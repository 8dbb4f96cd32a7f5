"""Residual blocks against plain NumPy; names and sizes of whole ResNets against torchvision's."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from rgbt.models.resnet import BasicBlock, Bottleneck, basic_stage, bottleneck_stage

BLOCKS = {
    18: (2, 2, 2, 2),
    34: (3, 4, 6, 3),
    50: (3, 4, 6, 3),
    101: (3, 4, 23, 3),
    152: (3, 8, 36, 3),
}


def randomised(module: nn.Module, seed: int = 0) -> nn.Module:
    """`module` in evaluation mode with every tensor drawn, statistics of normalisations too."""
    g = torch.Generator().manual_seed(seed)
    for name, tensor in module.state_dict().items():
        if name.endswith(("running_var", "bn1.weight", "bn2.weight", "bn3.weight")):
            tensor.copy_(0.5 + torch.rand(tensor.shape, generator=g))
        elif tensor.is_floating_point():
            tensor.copy_(torch.randn(tensor.shape, generator=g) / 3)
    return module.eval()


def convolved(x: np.ndarray, w: np.ndarray, stride: int, dilation: int) -> np.ndarray:
    """(C, H, W) with `w` (O, C, k, k), padded so that only the stride changes the size."""
    side = w.shape[2]
    pad = dilation * (side // 2)
    padded = np.pad(x, ((0, 0), (pad, pad), (pad, pad)))
    rows, columns = -(-x.shape[1] // stride), -(-x.shape[2] // stride)
    out = np.zeros((len(w), rows, columns))
    for row in range(rows):
        for column in range(columns):
            top, left = row * stride, column * stride
            span = dilation * (side - 1) + 1
            window = padded[:, top : top + span : dilation, left : left + span : dilation]
            out[:, row, column] = (w * window).sum((1, 2, 3))
    return out


def normalised(x: np.ndarray, state: dict[str, np.ndarray], name: str) -> np.ndarray:
    mean, var, weight, bias = (
        state[f"{name}.{part}"][:, None, None]
        for part in ("running_mean", "running_var", "weight", "bias")
    )
    return (x - mean) / np.sqrt(var + 1e-5) * weight + bias


def by_hand(
    state: dict[str, np.ndarray], x: np.ndarray, strides: tuple[int, ...], dilation: int
) -> np.ndarray:
    """A block from its tensors: every convolution normalised, a ReLU between, a shortcut, a ReLU.

    `strides` of conv1, conv2, ...; `dilation` of the 3x3 convolutions.
    """
    y = x
    for number, stride in enumerate(strides, 1):
        weight = state[f"conv{number}.weight"]
        y = convolved(y, weight, stride, dilation if weight.shape[2] == 3 else 1)
        y = normalised(y, state, f"bn{number}")
        y = np.maximum(y, 0) if number < len(strides) else y
    if "downsample.0.weight" in state:
        x = convolved(x, state["downsample.0.weight"], int(np.prod(strides)), 1)
        x = normalised(x, state, "downsample.1")
    return np.maximum(x + y, 0)


@pytest.mark.parametrize(
    ("block", "strides", "dilation"),
    [
        (BasicBlock(6, 6), (1, 1), 1),
        (BasicBlock(3, 6), (1, 1), 1),
        (BasicBlock(6, 6, stride=2), (2, 1), 1),
        (Bottleneck(8, 2), (1, 1, 1), 1),
        (Bottleneck(3, 2), (1, 1, 1), 1),
        (Bottleneck(8, 2, dilation=2), (1, 1, 1), 2),
        (Bottleneck(8, 2, stride=2), (1, 2, 1), 1),
        (Bottleneck(8, 2, stride=2, stride_at="1x1"), (2, 1, 1), 1),
        (Bottleneck(8, 2, stride=2, dilation=3), (1, 2, 1), 3),
    ],
)
def test_blocks_by_hand(block: Any, strides: tuple[int, ...], dilation: int) -> None:
    randomised(block)
    x = torch.randn(2, block.conv1.in_channels, 7, 10, generator=torch.Generator().manual_seed(1))
    out = block(x).detach().numpy()
    state = {name: tensor.double().numpy() for name, tensor in block.state_dict().items()}
    for image, found in zip(x.double().numpy(), out):
        expected = by_hand(state, image, strides, dilation)
        assert (expected > 0).mean() > 0.2
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_a_stage_is_its_blocks_one_after_the_other() -> None:
    """The first block strided, with its own dilation; the others neither strided nor like it."""
    stage = randomised(bottleneck_stage(3, 2, 3, stride=2, dilations=(1, 2), stride_at="1x1"))
    first = Bottleneck(3, 2, stride=2, stride_at="1x1")
    blocks = [first, *(Bottleneck(8, 2, dilation=2) for _ in range(2))]
    for mine, theirs in zip(blocks, stage, strict=True):
        mine.load_state_dict(theirs.state_dict())
    x = torch.randn(1, 3, 9, 12, generator=torch.Generator().manual_seed(1))
    found = stage(x)
    for block in blocks:
        x = block.eval()(x)
    assert found.shape == (1, 8, 5, 6)
    assert torch.equal(found, x)


@pytest.mark.parametrize("stride", [1, 2])
def test_a_basic_stage_strides_once(stride: int) -> None:
    stage = basic_stage(4, 4, 3, stride=stride)
    assert stage(torch.rand(2, 4, 8, 12)).shape == (2, 4, 8 // stride, 12 // stride)
    assert [isinstance(block.downsample, nn.Identity) for block in stage] == [
        stride == 1,
        True,
        True,
    ]


def test_gradient_reaches_every_parameter() -> None:
    for stage in (basic_stage(3, 4, 2, stride=2), bottleneck_stage(3, 4, 2, dilations=(2, 4))):
        x = torch.randn(2, 3, 8, 8, generator=torch.Generator().manual_seed(0), requires_grad=True)
        weight = torch.randn(stage(x).shape, generator=torch.Generator().manual_seed(1))
        (stage(x) * weight).sum().backward()
        for parameter in (x, *stage.parameters()):
            assert parameter.grad is not None
            assert parameter.grad.isfinite().all()
            assert parameter.grad.any()


def resnet(depth: int) -> nn.ModuleDict:
    """All parameters of a ResNet for ImageNet; torchvision's names."""
    stage, expansion = (basic_stage, 1) if depth < 50 else (bottleneck_stage, 4)
    parts: dict[str, nn.Module] = {
        "conv1": nn.Conv2d(3, 64, 7, bias=False),
        "bn1": nn.BatchNorm2d(64),
        "fc": nn.Linear(512 * expansion, 1000),
    }
    channels = 64
    for index, blocks in enumerate(BLOCKS[depth]):
        width = 64 * 2**index
        parts[f"layer{index + 1}"] = stage(channels, width, blocks, stride=min(index + 1, 2))
        channels = expansion * width
    return nn.ModuleDict(parts)


@pytest.mark.parametrize(
    ("depth", "parameters", "tensors"),
    [
        (18, 11_689_512, 122),
        (34, 21_797_672, 218),
        (50, 25_557_032, 320),
        (101, 44_549_160, 626),
        (152, 60_192_808, 932),
    ],
)
def test_torchvisions_names_and_parameter_counts(depth: int, parameters: int, tensors: int) -> None:
    """Published counts of parameters, and the naming rule of torchvision's state dicts."""
    with torch.device("meta"):
        net = resnet(depth)
    assert sum(p.numel() for p in net.parameters()) == parameters
    names = set(net.state_dict())
    assert len(names) == tensors
    assert names == {"conv1.weight", "fc.weight", "fc.bias", *norm("bn1"), *stage_names(depth)}


def stage_names(depth: int) -> set[str]:
    found: set[str] = set()
    for stage, blocks in enumerate(BLOCKS[depth], 1):
        for block in range(blocks):
            prefix = f"layer{stage}.{block}"
            for number in range(1, 3 if depth < 50 else 4):
                found |= {f"{prefix}.conv{number}.weight", *norm(f"{prefix}.bn{number}")}
            if block == 0 and (stage > 1 or depth >= 50):
                found |= {f"{prefix}.downsample.0.weight", *norm(f"{prefix}.downsample.1")}
    return found


def norm(name: str) -> set[str]:
    parts = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")
    return {f"{name}.{part}" for part in parts}
