"""Draw pairs of frames with the prediction of each and the pixels where they differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rgbt.dataset import LabelledDataset
from rgbt.tracking import pictures
from rgbt.tracking.pictures import Image, colours, overlay, palette_of
from rgbt.types import IGNORE

AGREES = (235, 235, 235)
DIFFERS = (200, 30, 30)


@dataclass(frozen=True)
class PairExample:
    """Two frames of a scene and their predictions.

    Images are (H, W, 3) and class maps (H, W) uint8; `followed` is the first prediction at the
    points of the second frame, `seen` (H, W) whether the first frame shows them too, and `flow`
    (H, W, 2) the estimated motion from the second frame to the first; None: it is known.
    """

    name: str
    first_rgb: Image
    first: Image
    second_rgb: Image
    second: Image
    followed: Image
    seen: NDArray[np.bool_]
    flow: NDArray[np.float32] | None = None

    def motion(self) -> tuple[Image, ...]:
        """Paint the flow: hue is its direction, strength its length; black is not used."""
        if self.flow is None:
            return ()
        from matplotlib.colors import hsv_to_rgb

        rows, columns = self.flow[..., 0].astype(float), self.flow[..., 1].astype(float)
        length = np.hypot(rows, columns)
        longest = np.percentile(length[self.seen], 95) if self.seen.any() else 1.0
        hue = (np.arctan2(rows, columns) / (2 * np.pi)) % 1.0
        strength = np.clip(length / max(float(longest), 1.0), 0, 1)
        colour = hsv_to_rgb(np.stack([hue, strength, np.ones_like(hue)], -1))
        picture = np.rint(255 * colour).astype(np.uint8)
        picture[~self.seen] = 0
        return (picture,)

    def difference(self) -> Image:
        """Paint (H, W, 3) red where the two predictions differ, grey where nothing is compared."""
        picture = np.empty((*self.seen.shape, 3), np.uint8)
        picture[:] = AGREES
        picture[self.followed != self.second] = DIFFERS
        picture[~self.seen] = pictures.IGNORED_COLOUR
        return picture


COLUMNS = ("frame", "its prediction", "second frame", "its prediction", "first, brought there")


def draw_pairs(examples: Sequence[PairExample], dataset: LabelledDataset, path: Path) -> None:
    """Write a PNG, one row per scene (at least one), as in Temporal, Figs. 1 and 6."""
    rows = []
    for scene in examples:
        shown = [scene.first_rgb, overlay(scene.first_rgb, scene.first, dataset)]
        shown += [scene.second_rgb, overlay(scene.second_rgb, scene.second, dataset)]
        followed = np.where(scene.seen, scene.followed, IGNORE)
        shown.append(colours(followed, palette_of(dataset)))
        rows.append((scene.name, (*shown, *scene.motion(), scene.difference())))
    moving = ("motion (black: not used)",) if examples and examples[0].flow is not None else ()
    pictures.draw_columns(rows, (*COLUMNS, *moving, "differ (grey: not seen)"), dataset, path)
