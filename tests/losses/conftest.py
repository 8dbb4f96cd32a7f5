"""Small problems for the set criterion, and the reference it is compared with."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from rgbt.losses.set_criterion import SetCriterion
from rgbt.types import Batch, Output


@pytest.fixture(scope="session")
def reference() -> ModuleType:
    """The set criterion as a loop over passes, layers and images."""
    path = Path(__file__).parents[1] / "benchmarks" / "reference_criterion.py"
    spec = importlib.util.spec_from_file_location("reference_criterion", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["reference_criterion"] = module
    spec.loader.exec_module(module)
    return module


def batch_of(label: Tensor, position: Tensor | None = None, original_hw: Any = None) -> Batch:
    images, height, width = label.shape
    hw = torch.tensor([original_hw or (height, width)]).expand(images, 2)
    return Batch(
        rgb=torch.zeros(images, 3, height, width),
        thermal=torch.zeros(images, 1, height, width),
        label=label,
        name=("a",) * images,
        centre_yx=torch.zeros(images, 2, dtype=torch.long),
        position=position,
        original_hw=hw,
    )


def whole_image(images: int, height: int, width: int) -> Tensor:
    """Positions of crops that are the whole original image."""
    axes = torch.arange(height).float(), torch.arange(width).float()
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"))
    return grid.expand(images, 2, height, width)


def criterion_of(**changes: Any) -> SetCriterion:
    settings: dict[str, Any] = {
        "num_classes": 5,
        "num_points": 64,
        "oversample_ratio": 3.0,
        "importance_ratio": 0.75,
        "class_weight": 2.0,
        "mask_weight": 5.0,
        "dice_weight": 5.0,
        "no_object_weight": 0.1,
        "deep_supervision": True,
    }
    return SetCriterion(**(settings | changes))


def problem_of(
    *sizes: int, queries: int = 7, classes: int = 5, seed: int = 0
) -> tuple[Output, Batch]:
    """Predictions for (L, P, B) and a label of 4x4 blocks, some ignored, 2 rows short of 4h."""
    height, width = 6, 8
    generator = torch.Generator().manual_seed(seed)
    normal = {"generator": generator, "dtype": torch.float32}
    aux = {
        "class_logits": torch.randn(*sizes, queries, classes + 1, **normal).requires_grad_(),
        "mask_logits": (3 * torch.randn(*sizes, queries, height, width, **normal)).requires_grad_(),
    }
    blocks = torch.randint(0, classes + 1, (sizes[2], height, width), generator=generator)
    label = blocks.repeat_interleave(4, 1).repeat_interleave(4, 2)[:, :-2]
    label = torch.where(label == classes, 255, label)
    position = whole_image(sizes[2], 4 * height, 4 * width)[:, :, :-2] / 2 + 3
    return Output(None, aux), batch_of(label, position, (20, 24))


@pytest.fixture
def make_batch() -> Callable[..., Batch]:
    return batch_of


@pytest.fixture
def make_positions() -> Callable[..., Tensor]:
    return whole_image


@pytest.fixture
def make_criterion() -> Callable[..., SetCriterion]:
    return criterion_of


@pytest.fixture
def make_problem() -> Callable[..., tuple[Output, Batch]]:
    return problem_of
