"""Which scores the table of a file of counts shows, as names; without values."""

from __future__ import annotations

from dataclasses import dataclass

from rgbt.metrics import names
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import Details, details_of
from rgbt.metrics.pairs import HEADLINES, protocol_of

MEAN = "mean"


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
    details, protocol = details_of(counts.partition), protocol_of(counts.partition)
    labels = {
        name: f"{name} (not in means)" if name in counts.unscored else name
        for name in counts.classes
    }

    def by_class(scores: tuple[str, ...]) -> list[tuple[str, tuple[str, ...]]]:
        return [
            (label, tuple(names.of_class(name, each) for each in scores))
            for name, label in labels.items()
        ]

    if protocol is not None:
        scores = HEADLINES[protocol]
        rows = [*by_class(scores), ("all images", scores)]
        rows += [
            (part, tuple(names.subset(part, each) for each in scores)) for part in counts.parts()
        ]
        columns = tuple(score.replace("_", " ") for score in scores)
        return ScoreGrid("Consistency of pairs of frames in percent", columns, tuple(rows))
    groups = 1 if details is None else details.groups
    numbers = range(1, counts.counts.shape[1] // groups + 1)
    regions = tuple(f"region {number}" for number in numbers)
    if details is None:
        row = (*map(names.region, numbers), names.MIOU, names.VAR)
        columns = (*regions, names.MIOU, names.VAR)
        return ScoreGrid("mIoU in percent by region", columns, ((names.MIOU, row),))
    if details.bins:
        means = _bins(details)
        rows = [*by_class(means), (MEAN, means)]
        rows += [
            (f"{MEAN}, {region}", tuple(names.in_region(number, each) for each in means))
            for number, region in zip(numbers, regions, strict=True)
        ]
        title = "IoU in percent by distance in metres"
        if details.kind == "size":
            title = "Recall in percent by size of the object in pixels"
        return ScoreGrid(title, details.bins, tuple(rows))
    columns = ("image", *regions)
    if details.kind == "calibration":
        title = f"Expected calibration error in percent points, {details.groups} bins"
        return ScoreGrid(title, columns, (("all pixels", _everywhere(names.ECE, numbers)),))
    rows = by_class(_everywhere(names.BOUNDARY_IOU, numbers))
    rows.append((MEAN, _everywhere(names.BOUNDARY_MIOU, numbers)))
    title = f"Boundary IoU in percent, width {100 * details.setting[0]:g} % of the image diagonal"
    title += ", with the border of the image" if details.with_border else ""
    return ScoreGrid(title, columns, tuple(rows))


def headlines(counts: Counts) -> tuple[str, ...]:
    """The scores of details that a comparison shows: means, by region or bin."""
    details = details_of(counts.partition)
    assert details is not None, "counts of details"
    if details.bins:
        return _bins(details)
    score = names.ECE if details.kind == "calibration" else names.BOUNDARY_MIOU
    return _everywhere(score, range(1, counts.counts.shape[1] // details.groups + 1))


def _bins(details: Details) -> tuple[str, ...]:
    return tuple(f"{details.kind}/{each}" for each in details.bins)


def _everywhere(score: str, numbers: range) -> tuple[str, ...]:
    """A score in the whole image and in each region."""
    return (score, *(names.in_region(number, score) for number in numbers))
