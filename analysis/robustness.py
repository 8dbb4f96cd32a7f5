"""Counts of corrupted images, which ``rgbt robustness`` writes beside a run or to ``out=``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from analysis.results import (
    CLEAN,
    EVALUATIONS,
    ROBUSTNESS,
    RUNS,
    Evaluation,
    level_of,
    open_counts,
)
from rgbt.checks import InputError, split_list


@dataclass(frozen=True)
class Training:
    """One training of a method, its levels: clean, then by corruption and rising severity."""

    label: str
    place: Path
    levels: tuple[Evaluation, ...]


def trainings(text: str, runs_dir: Path | str = "runs", split: str = "") -> list[Training]:
    """The trainings that `text` names, with all their levels; InputError: not measured.

    `text`: runs or groups (see `analysis.results.open_counts`), or folders that
    ``rgbt robustness out=...`` wrote, with commas.
    """
    found: list[tuple[str, Path]] = []
    for word in split_list(text, RUNS):
        place = Path(word).expanduser()
        if (place / f"{CLEAN}.json").is_file():
            found.append((place.name, place))
            continue
        for named in open_counts(word, runs_dir, split):
            place = named.path.parent / EVALUATIONS / ROBUSTNESS / named.counts.split
            found.append((named.label, place))
    return [Training(label, place, levels_of(place)) for label, place in found]


def levels_of(folder: Path) -> tuple[Evaluation, ...]:
    """Every level in a folder: clean first, then what has no severity, then by title."""
    found = [level_of(path.with_suffix(".npz")) for path in sorted(folder.glob("*.json"))]
    if CLEAN not in {level.row for level in found}:
        raise InputError(f"{folder} has no counts of clean images; rgbt robustness makes them.")
    order = sorted(found, key=lambda at: (at.unit != "", at.title, at.row, at.severity))
    return tuple(sorted(order, key=lambda at: at.row != CLEAN))
