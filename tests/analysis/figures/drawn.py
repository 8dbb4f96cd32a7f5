"""Reading back what was drawn, and small inputs for figures."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from matplotlib.figure import Figure

from analysis.figures.plots import save
from analysis.statistics.collect import SpatialStatistics
from rgbt.metrics.metric import Regions

CLASSES = ("unlabeled", "car", "color_cone")
PALETTE = np.array([(0, 0, 0), (64, 0, 128), (192, 128, 128)], np.uint8)


def texts(figure: Figure, folder: Path) -> list[str]:
    """Every text of a figure as it stands in the SVG; fails where letters became outlines."""
    path = folder / "drawn.svg"
    save(figure, path)
    root = ElementTree.parse(path).getroot()
    found = root.iter("{http://www.w3.org/2000/svg}text")
    return ["".join(text.itertext()).strip() for text in found]


def letters(figure: Figure, folder: Path) -> list[float]:
    """Sizes in points of all letters of a figure."""
    path = folder / "sizes.svg"
    save(figure, path)
    return [float(size) for size in re.findall(r"font(?:-size)?: ([\d.]+)px", path.read_text())]


def statistics(labels: np.ndarray, regions: Regions, night: np.ndarray | None) -> SpatialStatistics:
    """Statistics of label images (N, H, W); LV, mean and noise of image n, region r: see below.

    laplacian = 10 (modality + 1) (n + 1) + r, mean = 100 + n, noise = (modality + 1) (r + 1).
    """
    region_map = regions.map(labels.shape[1:])
    number, classes = regions.regions, len(CLASSES)
    inside = [
        [np.bincount(label[region_map == r], minlength=classes) for r in range(number)]
        for label in labels
    ]
    one_hot = np.stack([labels == index for index in range(classes)], axis=1)
    dark = np.zeros(len(labels), bool) if night is None else night
    n, m, r = np.ogrid[: len(labels), :2, :number]
    full = np.zeros((len(labels), 2, number))
    return SpatialStatistics(
        dataset="toy",
        fingerprint="fingerprint",
        split="train",
        classes=CLASSES,
        background=CLASSES[:1],
        partition=regions.name,
        region_map=region_map,
        kernel="four",
        names=tuple(f"{index:05d}" for index in range(len(labels))),
        night=night,
        labels=np.array(inside, np.int64),
        ignored=np.zeros((len(labels), number), np.int64),
        occupied=np.stack([one_hot[part].sum(0) for part in (~dark, dark)]).astype(np.int32),
        laplacian=full + 10 * (m + 1) * (n + 1) + r,
        mean=full + 100.0 + n,
        noise=np.stack([full + (m + 1.0) * (r + 1), full, full + 20.0], axis=1),
    )


def strips(regions: int, partition: str = "vertical") -> Regions:
    """A partition into strips, or rings."""
    aspect = "image" if partition == "ring" else None
    return Regions(partition=partition, regions=regions, aspect=aspect, absent="released")  # type: ignore[arg-type]
