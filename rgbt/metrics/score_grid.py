"""Which scores the table of a file of counts shows, as names; without values."""

from __future__ import annotations

from dataclasses import dataclass

from rgbt.metrics import names
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import Details, details_of
from rgbt.metrics.pairs import HEADLINES, protocol_of


@dataclass(frozen=True)
class ScoreGrid:
    """A table of metric names: its title with the unit, titles of columns, and rows of names."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[str, ...]], ...]

    @property
    def metrics(self) -> tuple[str, ...]:
        """Return all names, row by row."""
        return tuple(name for _, row in self.rows for name in row)


def score_grid(counts: Counts) -> ScoreGrid:
    """Name the scores of counts; only their classes, partition and time of day are used."""
    details, protocol = details_of(counts.partition), protocol_of(counts.partition)

    def by_class(scores: tuple[str, ...]) -> list[tuple[str, tuple[str, ...]]]:
        rows = []
        for name in counts.classes:
            label = f"{name} (not in means)" if name in counts.unscored else name
            rows.append((label, tuple(names.of_class(name, score) for score in scores)))
        return rows

    if protocol is not None:
        scores = HEADLINES[protocol]
        rows = [*by_class(scores), ("all images", scores)]
        rows += [(part, tuple(names.subset(part, s) for s in scores)) for part in counts.parts()]
        columns = tuple(score.replace("_", " ") for score in scores)
        return ScoreGrid("Consistency of pairs of frames in percent", columns, tuple(rows))
    numbers = _regions(counts, details)
    regions = tuple(f"region {number}" for number in numbers)
    if details is None:
        row = (*map(names.region, numbers), names.MIOU, names.VAR)
        columns = (*regions, names.MIOU, names.VAR)
        return ScoreGrid("mIoU in percent by region", columns, ((names.MIOU, row),))
    means, columns = headlines(counts), details.bins or ("image", *regions)
    if details.kind == "calibration":
        title = f"Expected calibration error in percent points, {details.groups} bins"
        return ScoreGrid(title, columns, (("all pixels", means),))
    if details.kind == "boundary":
        rows = by_class(_everywhere(names.BOUNDARY_IOU, numbers))
        title = (
            f"Boundary IoU in percent, width {100 * details.setting[0]:g} % of the image diagonal"
        )
        title += ", with the border of the image" if len(details.setting) > 1 else ""
        return ScoreGrid(title, columns, (*rows, ("mean", means)))
    rows = [*by_class(means), ("mean", means)]
    for number in numbers:
        row = tuple(names.in_region(number, score) for score in means)
        rows.append((f"mean, region {number}", row))
    title = "IoU in percent by distance in metres"
    if details.kind == "size":
        title = "Recall in percent by size of the object in pixels"
    return ScoreGrid(title, columns, tuple(rows))


def headlines(counts: Counts) -> tuple[str, ...]:
    """Return the scores of details that a comparison shows: means, by region or bin."""
    details = details_of(counts.partition)
    assert details is not None, "counts of details"
    if details.bins:
        return tuple(f"{details.kind}/{bin_name}" for bin_name in details.bins)
    score = names.ECE if details.kind == "calibration" else names.BOUNDARY_MIOU
    return _everywhere(score, _regions(counts, details))


def _regions(counts: Counts, details: Details | None) -> range:
    return range(1, counts.counts.shape[1] // (details.groups if details else 1) + 1)


def _everywhere(score: str, numbers: range) -> tuple[str, ...]:
    """A score in the whole image and in each region."""
    return (score, *(names.in_region(number, score) for number in numbers))
