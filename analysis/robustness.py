"""Counts of corrupted images, which ``rgbt robustness`` writes beside a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from analysis.results import RUNS, NamedCounts, open_counts
from rgbt.checks import InputError, nearest, split_list
from rgbt.files.plain_files import read_json
from rgbt.metrics.counts import Counts
from rgbt.runs.naming import row_name

FOLDER = Path("evaluations") / "robustness"
FORMAT = "rgbt robustness 1"
CLEAN = "clean"


@dataclass(frozen=True)
class Level:
    """One severity of one corruption.

    Attributes:
        mark: name of its file, e.g. "noise-16".
        row: the corruption: "clean", "noise", "rgb_removed", "features-thermal", ...
        title: as shown.
        unit: of the severity; "" where there is one alone.
        severity: 0 is the clean image.
        counts: the counts.
    """

    mark: str
    row: str
    title: str
    unit: str
    severity: float
    counts: Counts


@dataclass(frozen=True)
class Training:
    """One training with its levels, the clean images first.

    Attributes:
        label: of its method.
        place: folder of the counts.
        levels: clean, then by row and rising severity.
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
    """Folder of the counts of a run's corrupted images.

    Raises:
        InputError: it is no run, or was not measured.
    """
    folder = named.path.parent / FOLDER / named.counts.split
    if not named.key or not folder.is_dir():
        what = f"{named.path} is no run" if not named.key else f"{folder} is not there"
        split = "" if named.counts.split == "test" else f" split={named.counts.split}"
        run = named.path.parent if named.key else "..."
        raise InputError(f"{what}; rgbt robustness run={run}{split} makes the counts.")
    return folder


def levels_of(folder: Path) -> tuple[Level, ...]:
    """Every level in a folder: clean first, then what has no severity, then by title.

    Raises:
        InputError: no clean images, or a file that is damaged or of another kind.
    """
    found = [_level(path) for path in sorted(folder.glob("*.json"))]
    if CLEAN not in {level.row for level in found}:
        raise InputError(
            f"{folder} contains no counts of clean images ({CLEAN}.json); rgbt robustness "
            "measures them first."
        )
    return tuple(
        sorted(
            found, key=lambda at: (at.row != CLEAN, at.unit != "", at.title, at.row, at.severity)
        )
    )


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
    level = of_row.get(severity) or (None if severity or len(of_row) > 1 else [*of_row.values()][0])
    if level is None:
        raise InputError(
            f"severity={severity}: {folder} has {row} at {', '.join(of_row)}; give one of these."
        )
    return replace(named, path=folder / f"{level.mark}.npz", counts=level.counts)


def _level(path: Path) -> Level:
    made = read_json(path, dict[str, Any], "remove it, and rgbt robustness makes it again")
    if made.get("format") != FORMAT:
        raise InputError(f"{path} was not written by rgbt robustness; name another folder.")
    try:
        of_level = {key: made[key] for key in ("row", "title", "unit")}
        severity = float(made["severity"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} does not describe what was measured ({error}); rgbt robustness makes it again."
        ) from error
    counts = Counts.load(path.with_suffix(".npz"))
    return Level(path.stem, severity=severity, counts=counts, **of_level)
