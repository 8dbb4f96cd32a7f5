"""Which scores the table of a file of counts shows, as names; without values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rgbt.metrics import names
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import Details, details_of
from rgbt.metrics.pairs import HEADLINES, protocol_of

IMAGE = "image"
"""Column of the whole image."""

MEAN = "mean"

ALL_IMAGES = "all images"


@dataclass(frozen=True)
class ScoreGrid:
    """A table of metric names (`rgbt.metrics.named`).

    Attributes:
        title: what the scores are, with their unit.
        columns: titles of the columns.
        rows: label and names, one for each column.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[str, ...]], ...]

    @property
    def metrics(self) -> tuple[str, ...]:
        """All names, row by row."""
        return tuple(name for _, row in self.rows for name in row)


def score_grid(counts: Counts) -> ScoreGrid:
    """The scores of counts; only their classes, partition and time of day are used."""
    details = details_of(counts.partition)
    protocol = protocol_of(counts.partition)
    if protocol is not None:
        return _of_pairs(HEADLINES[protocol], counts)
    if details is None:
        regions = range(1, counts.counts.shape[1] + 1)
        row = (*map(names.region, regions), names.MIOU, names.VAR)
        columns = (*map(_region, regions), names.MIOU, names.VAR)
        return ScoreGrid("mIoU in percent by region", columns, ((names.MIOU, row),))
    numbers = range(1, counts.counts.shape[1] // details.groups + 1)
    if details.bins:
        return _by_bin(details, counts, numbers)
    columns = (IMAGE, *map(_region, numbers))
    if details.kind == "calibration":
        title = f"Expected calibration error in percent points, {details.groups} bins"
        return ScoreGrid(title, columns, (("all pixels", _everywhere(names.ECE, numbers)),))
    of_class = _everywhere(names.BOUNDARY_IOU, numbers)
    rows = [
        (label, tuple(names.of_class(name, each) for each in of_class))
        for name, label in _labels(counts)
    ]
    rows.append((MEAN, _everywhere(names.BOUNDARY_MIOU, numbers)))
    title = f"Boundary IoU in percent, width {100 * details.setting[0]:g} % of the image diagonal"
    title += ", with the border of the image" if details.with_border else ""
    return ScoreGrid(title, columns, tuple(rows))


def _of_pairs(scores: tuple[str, ...], counts: Counts) -> ScoreGrid:
    """By class, and of all images, of those of the day and of the night."""
    rows = [
        (label, tuple(names.of_class(name, score) for score in scores))
        for name, label in _labels(counts)
    ]
    rows.append((ALL_IMAGES, scores))
    rows += [
        (part, tuple(names.subset(part, score) for score in scores)) for part in counts.parts()
    ]
    columns = tuple(score.replace("_", " ") for score in scores)
    return ScoreGrid("Consistency of pairs of frames in percent", columns, tuple(rows))


def headlines(counts: Counts) -> tuple[str, ...]:
    """The scores of details that a comparison shows: means, by region or bin."""
    details = details_of(counts.partition)
    if details is None:
        raise ValueError(f"{counts.partition}: expected counts of details.")
    if details.bins:
        return tuple(names.in_bin(details.kind, each) for each in details.bins)
    score = names.ECE if details.kind == "calibration" else names.BOUNDARY_MIOU
    return _everywhere(score, range(1, counts.counts.shape[1] // details.groups + 1))


def _by_bin(details: Details, counts: Counts, numbers: Sequence[int]) -> ScoreGrid:
    means = tuple(names.in_bin(details.kind, each) for each in details.bins)
    rows = [
        (label, tuple(names.of_class(name, mean) for mean in means))
        for name, label in _labels(counts)
    ]
    rows.append((MEAN, means))
    rows += [
        (f"{MEAN}, {_region(number)}", tuple(names.in_region(number, mean) for mean in means))
        for number in numbers
    ]
    title = "IoU in percent by distance in metres"
    if details.kind == "size":
        title = "Recall in percent by size of the object in pixels"
    return ScoreGrid(title, details.bins, tuple(rows))


def _everywhere(score: str, numbers: Sequence[int]) -> tuple[str, ...]:
    """A score in the whole image and in each region."""
    return (score, *(names.in_region(number, score) for number in numbers))


def _labels(counts: Counts) -> list[tuple[str, str]]:
    """Name and label of each class."""
    return [
        (name, f"{name} (not in means)" if name in counts.unscored else name)
        for name in counts.classes
    ]


def _region(number: int) -> str:
    return f"region {number}"
