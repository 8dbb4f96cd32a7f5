"""Searches, grids and lists of the store: trials and the Pareto front."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from analysis.report.data import StudyEntry, TrialEntry
from analysis.report.store import MlflowRun, read_each
from rgbt.checks import InputError
from rgbt.runs.provenance import without_passwords
from rgbt.tables import read_csv

TRIALS_FILE = "trials.csv"
MARKDOWN_FILE = "study.md"
FIRST = ("trial", "state", "label")
LAST = ("seconds", "last_step", "runs", "reason")
COMPLETE = "complete"

OBJECTIVES = re.compile(r"^Kind: (\w+)\. Objectives: (.+)\.$", re.MULTILINE)
OBJECTIVE = re.compile(r"(highest|lowest) (.+)")
CREATED = re.compile(r"^(?:Created|Begun) by `(.+)`\.$", re.MULTILINE)
"""The command of a study; older records have "Begun by"."""
FIGURES = re.compile(r"\n## [^\n]*\n\n!\[", re.MULTILINE)
"""Where the figures of a report begin; they are separate files and not part of the page."""


def study_entries(records: Sequence[MlflowRun], remarks: list[str]) -> tuple[StudyEntry, ...]:
    """All studies of the store, by name.

    Args:
        records: runs of MLflow of the kind "study".
        remarks: gets a sentence for each that cannot be read.
    """
    found = read_each(records, read_study, remarks)
    return tuple(sorted(found, key=lambda each: each.name))


def read_study(record: MlflowRun) -> StudyEntry:
    """Read the record of a study.

    Raises:
        InputError: a file is missing or damaged.
    """
    name = record.tags.get("rgbt.study", record.name)
    note = record.files.text(MARKDOWN_FILE) or record.tags.get("mlflow.note.content", "")
    head = OBJECTIVES.search(note)
    if head is None:
        raise InputError(
            f"study '{name}': its {MARKDOWN_FILE} does not name the objectives; "
            f"`rgbt study name={name}` records it again."
        )
    wanted = [found for text in head.group(2).split(", ") if (found := OBJECTIVE.fullmatch(text))]
    objectives = tuple(each.group(2) for each in wanted)
    maximize = tuple(each.group(1) == "highest" for each in wanted)
    text = record.files.text(TRIALS_FILE)
    if text is None:
        raise InputError(
            f"study '{name}' has no {TRIALS_FILE} in the store; "
            f"`rgbt study name={name}` records it again."
        )
    created = CREATED.search(note)
    return StudyEntry(
        name=name,
        kind=record.tags.get("rgbt.study.kind", head.group(1)),
        objectives=objectives,
        maximize=maximize,
        trials=_trials(text, name, objectives, maximize),
        note=without_passwords(FIGURES.split(note)[0].strip() + "\n"),
        command=without_passwords(created.group(1)) if created else "",
    )


def _trials(
    text: str, name: str, objectives: tuple[str, ...], maximize: tuple[bool, ...]
) -> tuple[TrialEntry, ...]:
    header, lines = read_csv(text)
    missing = [column for column in (*FIRST, *objectives, *LAST) if column not in header]
    if missing:
        raise InputError(f"study '{name}': its {TRIALS_FILE} lacks the column '{missing[0]}'.")
    # Parameters stand between the label and the first score, see `sweeps.report.tables`.
    params = header[len(FIRST) : header.index(objectives[0])]
    try:
        values = [
            tuple(float(line[each] or math.nan) for each in objectives)
            if line["state"] == COMPLETE
            else ()
            for line in lines
        ]
        front = pareto_front(values, maximize)
        return tuple(
            TrialEntry(
                number=int(line["trial"]),
                state=line["state"],
                params={key: line[key] for key in params if line[key] != ""}
                or {"point": line["label"]},
                values=values[place],
                on_front=place in front,
                runs=tuple(line["runs"].split()),
            )
            for place, line in enumerate(lines)
        )
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"study '{name}': its {TRIALS_FILE} is damaged ({error}).") from error


def pareto_front(values: Sequence[tuple[float, ...]], maximize: Sequence[bool]) -> set[int]:
    """Places of the points that no other point beats: as good in all and better in one objective.

    Args:
        values: of each trial, one per objective; () or with NaN: no point.
        maximize: by objective, whether more is better.
    """
    places = [place for place, each in enumerate(values) if each and all(map(math.isfinite, each))]
    points = np.array([values[place] for place in places]).reshape(-1, len(maximize))
    points = np.where(maximize, points, -points)
    as_good = (points[:, None] >= points).all(-1)
    beaten = np.any(as_good & (points[:, None] > points).any(-1), axis=0)
    return {places[index] for index in np.flatnonzero(~beaten)}
