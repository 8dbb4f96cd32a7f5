"""The camera, views and recorded outputs that the tests of the geometry share."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rgbt.geometry.camera import Camera, Order, homography
from tests.models.golden import FOLDER, fill_rule

HW = (480, 640)
RELEASED = Camera(
    fx=702.6030497884977, fy=703.4541726858521, cx=320.0, cy=240.0, height=480, width=640
)
LIMITS = torch.tensor([10.0, 10.0, 5.0])
"""Degrees of yaw, pitch and roll in the paper."""


def random_angles(count: int, seed: int, *, whole: bool = False) -> Tensor:
    """(count, 3) of the paper's ranges; `whole` degrees as the published sets have."""
    generator = torch.Generator().manual_seed(seed)
    angles = (2 * torch.rand(count, 3, generator=generator) - 1) * LIMITS
    return angles.round() if whole else angles


def random_views(count: int, seed: int, order: Order = "zyx") -> Tensor:
    return homography(random_angles(count, seed), RELEASED.matrix(HW), order)


class Recorded:
    """Six views by the release, of one image, label and logits at one size."""

    def __init__(self, height: int, width: int) -> None:
        self.hw, self.name = (height, width), f"vvig.{height}x{width}"
        self.arrays = np.load(FOLDER / "losses.npz")
        recipe = json.loads((FOLDER / "losses.json").read_text())["recipes"]["vvig"]
        self.recipe: dict[str, int] = recipe[f"{height}x{width}"]
        self.angles = torch.tensor(recipe["triples_yaw_pitch_roll_degrees"], dtype=torch.float32)
        fx, fy, cx, cy = (value * width / 640 for value in recipe["fx_fy_cx_cy_480x640"])
        self.camera = Camera(fx=fx, fy=fy, cx=cx, cy=cy, height=height, width=width)
        self.fill = fill_rule()

    def image(self) -> Tensor:
        """(1, 4, H, W) float32, whole grey levels 0..255."""
        return torch.from_numpy(self.fill.image(self.recipe["image_seed"], *self.hw)).float()[None]

    def label(self) -> Tensor:
        """(1, H, W) int64."""
        seed, cell = self.recipe["label_seed"], self.recipe["label_cell"]
        return torch.from_numpy(self.fill.labels(seed, *self.hw, list(range(9)), cell))[None]

    def logits(self) -> Tensor:
        """(1, 9, H, W) float32: blocks of 8 pixels and noise."""
        height, width = self.hw
        shape = (9, height // 8, width // 8)
        coarse = self.fill.normal(self.recipe["logits_coarse_seed"], shape)
        fine = self.fill.normal(self.recipe["logits_fine_seed"], (9, height, width))
        blocks = np.kron(coarse, np.ones((1, 8, 8), np.float32))
        return torch.from_numpy(2 * blocks + fine)[None]

    def __getitem__(self, key: str) -> Any:
        return self.arrays[f"{self.name}.{key}"]

    def sampled(self, key: str, values: Tensor) -> tuple[Tensor, Tensor]:
        """`values` where "key" was recorded, and what was recorded there, both flat float64."""
        recorded = torch.from_numpy(self[key]).double().flatten()
        positions = self.fill.sample_positions(f"{self.name}.{key}", values.numel())
        return values.double().flatten()[torch.from_numpy(positions)], recorded
