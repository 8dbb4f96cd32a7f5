"""The training samples of CRM and SpatialSeg as their release makes them, for comparison.

Written anew from what the release does, step by step: files to float32, everything resized and
then cropped, per-sample arrays, one at a time. Its image library (imageio, which decodes PNG with
Pillow) is stood in for by Pillow itself, which is a little faster; detectron2's resizing of float
images is torch's. It draws from a generator of its own: equal in distribution to ours, not draw for
draw.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch.nn import functional as F
from torch.utils.data import Dataset

from rgbt.geometry.padding import STRIDE
from rgbt.transforms.crm import CrmTransform

SIZES = tuple(range(240, 961, 48))
CROP_HW = (240, 320)
FAR = 400.0
"""What the release pads its map of distances with."""

JITTER = CrmTransform(
    sizes=None,
    max_size=None,
    crop_hw=None,
    flip_probability=0.0,
    colour="released",
    test_short_edge=None,
    track_position=False,
    colour_probability=0.5,
    brightness_delta=32.0,
    contrast_range=(0.5, 1.5),
    saturation_range=(0.5, 1.5),
    hue_delta=18,
    thermal_contrast_range=(0.5, 1.5),
)


class ReleasedSamples(Dataset[dict[str, Any]]):
    """Samples of MFNet's packed layout; an index is drawn anew each time it is asked for.

    Args:
        root: holds images/ and labels/.
        names: of the samples.
        seed: of all draws.
    """

    def __init__(self, root: Path, names: tuple[str, ...], seed: int = 0) -> None:
        self.root = root
        self.names = names
        self.rng = np.random.default_rng(seed)

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> dict[str, Any]:
        name = self.names[index]
        image = np.asarray(Image.open(self.root / "images" / f"{name}.png")).astype(np.float32)
        label = np.asarray(Image.open(self.root / "labels" / f"{name}.png")).astype(np.float32)
        distances = _distances(image.shape[:2])
        image, label, distances = self._resized(image, label.astype(np.float64), distances)
        image, label, distances = self._cropped(image, label, distances)
        image = self._coloured(image)
        if self.rng.random() < 0.5:
            image, label, distances = (each[:, ::-1] for each in (image, label, distances))
        tensor = torch.as_tensor(np.ascontiguousarray(image.transpose(2, 0, 1)))
        target = torch.as_tensor(np.ascontiguousarray(label).astype("long"))
        classes = np.unique(target.numpy())
        masks = torch.stack([target == int(each) for each in classes])
        centre = _centre(distances)
        return {
            "image": tensor.float(),
            "label": target,
            "classes": classes,
            "masks": masks,
            "centre": centre,
            "mask": self._mask(centre),
        }

    def _resized(self, *arrays: NDArray[Any]) -> tuple[NDArray[Any], ...]:
        height, width = arrays[0].shape[:2]
        factor = self.rng.choice(SIZES) / min(height, width)
        size = int(height * factor + 0.5), int(width * factor + 0.5)
        image = torch.from_numpy(arrays[0]).permute(2, 0, 1)[None]
        resized = F.interpolate(image, size=size, mode="bilinear", align_corners=False)
        others = [
            F.interpolate(torch.from_numpy(each)[None, None], size=size, mode="nearest")[0, 0]
            for each in arrays[1:]
        ]
        return resized[0].permute(1, 2, 0).numpy(), *(each.numpy() for each in others)

    def _cropped(self, *arrays: NDArray[Any]) -> tuple[NDArray[Any], ...]:
        height, width = (min(*pair) for pair in zip(arrays[0].shape, CROP_HW, strict=False))
        top = self.rng.integers(arrays[0].shape[0] - height + 1)
        left = self.rng.integers(arrays[0].shape[1] - width + 1)
        return tuple(each[top : top + height, left : left + width] for each in arrays)

    def _coloured(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        parts = np.ascontiguousarray(image[..., :3]), np.ascontiguousarray(image[..., 3])
        rgb, thermal = JITTER.coloured(*parts, self.rng)
        return np.concatenate([rgb, thermal[..., None]], axis=-1).astype(np.float32)

    def _mask(self, centre: tuple[int, int]) -> NDArray[np.bool_]:
        """Half of the 64-pixel cells, Gaussian odds around the centre (SpatialSeg release)."""
        rows, columns = (-(-length // STRIDE) * STRIDE // 64 for length in CROP_HW)
        y, x = np.mgrid[:rows, :columns]
        squares = (y - centre[0] // 64) ** 2 + (x - centre[1] // 64) ** 2
        odds = np.exp(-squares / (2 * (rows / 4) ** 2)).ravel()
        count = -(-odds.size // 2)
        hidden = np.zeros(odds.size, bool)
        hidden[self.rng.choice(odds.size, count, replace=False, p=odds / odds.sum())] = True
        return np.kron(hidden.reshape(rows, columns), np.ones((16, 16), bool))


def _distances(hw: tuple[int, int]) -> NDArray[np.float32]:
    """Of every pixel from the centre: computed for each sample, as released."""
    y, x = np.mgrid[: hw[0], : hw[1]]
    return np.sqrt((y - hw[0] // 2) ** 2 + (x - hw[1] // 2) ** 2).astype(np.float32)


def _centre(distances: NDArray[np.float32]) -> tuple[int, int]:
    height, width = (-(-length // STRIDE) * STRIDE for length in distances.shape)
    padded = np.full((height, width), FAR, np.float32)
    padded[: distances.shape[0], : distances.shape[1]] = distances
    row, column = np.unravel_index(padded.argmin(), padded.shape)
    return int(row), int(column)
