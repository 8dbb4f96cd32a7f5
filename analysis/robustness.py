"""Counts of corrupted images, which ``rgbt robustness`` writes beside a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from analysis.results import CLEAN, ROBUSTNESS, RUNS, Evaluation, NamedCounts, level_of, open_counts
from rgbt.checks import InputError, nearest, split_list
from rgbt.metrics.counts import Counts
from rgbt.runs.naming import row_name

Level = Evaluation
"""One severity of one corruption."""


@dataclass(frozen=True)
class Training:
    """One training with its levels.

    Attributes:
        label: of its method.
        place: folder of the counts.
        levels: the clean images, then by corruption and rising severity.
    """

    label: str
    place: Path
    levels: tuple[Level, ...]

    @property
    def clean(self) -> Counts:
        """Of the images as they are."""
        return self.levels[0].counts

    def of(self, row: str) -> tuple[Level, ...]:
        """The severities of one row, rising; () where it was not measured."""
        return tuple(level for level in self.levels if level.row == row)


def trainings(text: str, runs_dir: Path | str = "runs", split: str = "") -> list[Training]:
    """The trainings that `text` names, with all their levels.

    Args:
        text: runs or groups (see `analysis.results.open_counts`), or folders that
            ``rgbt robustness out=...`` wrote, with commas.
        runs_dir: where runs lie.
        split: "": test.

    Raises:
        InputError: there is no such thing, or it was not measured.
    """
    found = []
    for word in split_list(text, RUNS):
        place = Path(word).expanduser()
        if (place / f"{CLEAN}.json").is_file():
            found.append(Training(place.name, place, levels_of(place)))
            continue
        for named in open_counts(word, runs_dir, split):
            place = folder_of(named)
            found.append(Training(named.label, place, levels_of(place)))
    return found


def folder_of(named: NamedCounts) -> Path:
    """Folder of the counts of a run's corrupted images; InputError: no run, or not measured."""
    folder = named.path.parent / "evaluations" / ROBUSTNESS / named.counts.split
    if not named.key or not folder.is_dir():
        what = f"{folder} is not there" if named.key else f"{named.path} is no run"
        split = "" if named.counts.split == "test" else f" split={named.counts.split}"
        run = named.path.parent if named.key else "..."
        raise InputError(f"{what}; rgbt robustness run={run}{split} makes the counts.")
    return folder


def levels_of(folder: Path) -> tuple[Level, ...]:
    """Every level in a folder: clean first, then what has no severity, then by title.

    Raises:
        InputError: no clean images, or a file that is damaged or of another kind.
    """
    found = [level_of(path.with_suffix(".npz")) for path in sorted(folder.glob("*.json"))]
    if CLEAN not in {level.row for level in found}:
        raise InputError(f"{folder} contains no counts of clean images; rerun rgbt robustness.")
    order = sorted(found, key=lambda at: (at.unit != "", at.title, at.row, at.severity))
    return tuple(sorted(order, key=lambda at: at.row != CLEAN))


def under(
    trained: Sequence[NamedCounts], corruption: str, severity: str
) -> tuple[NamedCounts, ...]:
    """The same trainings on corrupted images.

    Args:
        trained: runs.
        corruption: as it was measured, e.g. "noise:rgb", or a row such as "features-thermal".
        severity: as text; "" where the row has one alone.

    Raises:
        InputError: no runs, not measured, or measured at other severities.
    """
    return tuple(_under(each, row_name(corruption), severity) for each in trained)


def _under(named: NamedCounts, row: str, severity: str) -> NamedCounts:
    folder = folder_of(named)
    levels = levels_of(folder)
    of_row = {f"{level.severity:g}": level for level in levels if level.row == row}
    if not of_row:
        known = nearest(row, {level.row for level in levels})
        raise InputError(f"corruption={row} was not measured in {folder}; {known}.")
    only = next(iter(of_row.values())) if len(of_row) == 1 and not severity else None
    level = of_row.get(severity, only)
    if level is None:
        raise InputError(
            f"severity={severity}: {folder} has {row} at {', '.join(of_row)}; give one of these."
        )
    return replace(named, path=level.path, counts=level.counts)
