"""Count boundaries, calibration, distance and size beside the confusion matrices."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from rgbt.build.session import Session
from rgbt.checks import InputError
from rgbt.dataset import KnownScenes, LabelledDataset, reader_of
from rgbt.evaluation.prediction import counts_of
from rgbt.metrics.boundary import BoundaryCounter
from rgbt.metrics.calibration import CalibrationCounter
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import OF_SCENES, DetailKind, Details
from rgbt.metrics.metric import Regions
from rgbt.metrics.named import value
from rgbt.metrics.scene_counts import SceneCounter
from rgbt.metrics.score_grid import score_grid
from rgbt.tracking.tables import TextTable, number
from rgbt.types import SceneMaps, View

DetailedImages: TypeAlias = "dict[str, dict[DetailKind, NDArray[np.int64]]]"
"""Name of an image -> kind -> its counts (R G, M, K)."""

Count: TypeAlias = "Callable[[str, Tensor, Tensor, Tensor | None], NDArray[np.int64]]"
"""Name, label, classes and confidences (H, W) of an image -> its counts."""


class DetailCounter:
    """Counts all requested details of images.

    Attributes:
        needs_confidence: whether a call requires the confidences.

    Raises:
        InputError: distance or size of a data set that does not know its scenes.
    """

    def __init__(
        self, details: Sequence[Details], dataset: LabelledDataset, regions: Regions
    ) -> None:
        self.needs_confidence = any(each.kind == "calibration" for each in details)
        self._counts = {each.kind: _counter(each, dataset, regions) for each in details}

    def __call__(
        self, name: str, label: Tensor, classes: Tensor, confidence: Tensor | None
    ) -> dict[DetailKind, NDArray[np.int64]]:
        """Kind -> counts of the image `name`; all maps are (H, W)."""
        given = (name, label, classes, confidence)
        return {kind: count(*given) for kind, count in self._counts.items()}


def _counter(details: Details, dataset: LabelledDataset, regions: Regions) -> Count:
    classes = len(dataset.classes)
    if details.kind == "boundary":
        width, border = details.setting[0], details.with_border
        boundary = BoundaryCounter(classes, regions, width, border=border)
        return lambda name, label, predicted, confidence: boundary(label, predicted)  # noqa: ARG005
    if details.kind == "calibration":
        calibration = CalibrationCounter(classes, regions, details.groups)

        def calibrated(
            name: str,  # noqa: ARG001
            label: Tensor,
            predicted: Tensor,
            confidence: Tensor | None,
        ) -> NDArray[np.int64]:
            assert confidence is not None, "calibration needs the confidences of the prediction"
            return calibration(label, predicted, confidence)

        return calibrated
    scenes = _scenes(dataset, details.kind)
    scene = SceneCounter(classes, regions, details)

    def of_scene(
        name: str,
        label: Tensor,
        predicted: Tensor,
        confidence: Tensor | None,  # noqa: ARG001
    ) -> NDArray[np.int64]:
        maps = checked_maps(scenes.scene_maps(name), name, tuple(label.shape))
        shown = maps.depth_m if details.kind == "distance" else maps.objects
        return scene(label, predicted, shown)

    return of_scene


def _scenes(dataset: LabelledDataset, kind: DetailKind) -> KnownScenes:
    reader = reader_of(dataset)
    if isinstance(reader, KnownScenes):
        return reader
    raise InputError(
        f"details={kind}: {dataset.name} has no maps of distance and objects. Use "
        f"dataset=synth_calibrated, or remove {' and '.join(OF_SCENES)} from details."
    )


def checked_maps(maps: SceneMaps, name: str, label_hw: tuple[int, ...]) -> SceneMaps:
    """`maps`, if they have the size of the label.

    Raises:
        InputError: they have another size.
    """
    for what, each in zip(("depth", "objects"), maps, strict=True):
        if each.shape != label_hw:
            raise InputError(
                f"'{name}': the map of {what} has the size {_size(each.shape)}, but the label has "
                f"{_size(label_hw)}. Write the maps again in the size of the labels."
            )
    return maps


def _size(shape: Sequence[int]) -> str:
    return "x".join(map(str, shape))


def details_counts(
    session: Session, split: str, images: DetailedImages, details: Sequence[Details]
) -> dict[DetailKind, Counts]:
    """Kind -> the counts of all images; calibration in 64 bits, as its sums are large."""
    found = {}
    for each in details:
        by_name = {name: counts[each.kind] for name, counts in images.items()}
        dtype = np.int64 if each.kind == "calibration" else np.int32
        partition = each.partition(session.regions.name)
        found[each.kind] = counts_of(session, split, by_name, partition, dtype)
    return found


def save_details(details: Mapping[DetailKind, Counts], path: Path) -> list[tuple[str, str]]:
    """Write a file for each kind beside the counts in `path`; (what, path) of each."""
    lines: list[tuple[str, str]] = []
    for kind, counts in details.items():
        file = details_path(path, kind)
        counts.save(file)
        lines.append((kind, str(file)))
    return lines


def details_path(path: Path, kind: DetailKind) -> Path:
    """File of a kind beside the counts in `path`: "x.npz" -> "x-boundary.npz"."""
    return path.with_name(f"{path.stem}-{kind}{path.suffix}")


def score_table(counts: Counts, label: str) -> TextTable:
    """The scores of counts of details as a table; `label` names the network."""
    grid = score_grid(counts)
    rows = tuple(
        (title, *(number(value(metric, counts, counts.absent)) for metric in metrics))
        for title, metrics in grid.rows
    )
    return TextTable(f"{label}: {grid.title}", ("", *grid.columns), rows)


def views_table(by_view: Mapping[View, Counts], label: str) -> TextTable:
    """The mIoU by region, one row for each input; counts of single frames."""
    every = {view: score_grid(counts) for view, counts in by_view.items()}
    first = next(iter(every.values()))
    rows = tuple(
        (view, *(number(value(each, by_view[view], by_view[view].absent)) for each in grid.metrics))
        for view, grid in every.items()
    )
    return TextTable(f"{label}: {first.title} and input", ("", *first.columns), rows)
