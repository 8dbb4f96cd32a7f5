"""Small problems for the losses, and recorded ones."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rgbt.losses.set_criterion import SetCriterion
from rgbt.types import Batch, Output
from tests.models.golden import FOLDER, fill_rule

NOTHING = torch.Generator()


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def recorded_losses(group: str) -> tuple[Any, dict[str, Any], dict[str, Any], Any]:
    """Rule of the numbers, recipes of a group, description of the outputs, stored arrays."""
    facts = json.loads((FOLDER / "losses.json").read_text())
    arrays = np.load(FOLDER / "losses.npz")
    return fill_rule(), facts["recipes"][group], facts["outputs"], arrays


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
    generator = seeded(seed)
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
