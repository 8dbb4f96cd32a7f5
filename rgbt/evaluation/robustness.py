"""Measure a network on clean images and under corruptions, and make the table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from rgbt.assembly.session import Session
from rgbt.config.corruption_node import ChosenCorruption
from rgbt.evaluation.corruption import corrupted, corruption_of
from rgbt.evaluation.measure import files_of, measure, measurement_of, store, stored
from rgbt.evaluation.predict import view_of
from rgbt.files.atomic import write_atomic
from rgbt.metrics.counts import Counts
from rgbt.metrics.measurement import Measurement
from rgbt.metrics.names import DAY, MIOU, NIGHT, subset
from rgbt.metrics.scores import summary
from rgbt.requirements import NetworkRecord, record_of
from rgbt.tables import TextTable, csv_text, percent
from rgbt.terminal import progress
from rgbt.types import View

# Inputs of a network for both images, of which it decodes one branch alone.
BRANCHES: tuple[View, ...] = ("thermal", "rgb")

SCORES = (MIOU, subset(DAY, MIOU), subset(NIGHT, MIOU))


def conditions(
    session: Session, split: str, corruptions: Sequence[ChosenCorruption]
) -> Iterator[tuple[Session, Measurement]]:
    """Yield clean images, single branches if the network decodes them, and every severity."""
    yield session, measurement_of(session, split)
    known = record_of(session.model, NetworkRecord).views
    for branch in BRANCHES if view_of(session) == "rgbt" else ():
        if branch in known:
            yield session, measurement_of(session, split, branch)
    for chosen in corruptions:
        for severity in corruption_of(chosen).severities:
            changed = corrupted(session, chosen, severity, split)
            yield changed, measurement_of(changed, split)


def measure_all(
    session: Session, split: str, corruptions: Sequence[ChosenCorruption], out: Path | None
) -> list[Counts]:
    """Return the counts of all conditions, in `out` or beside the run; measure missing ones."""
    every, found = list(conditions(session, split, corruptions)), list[Counts]()
    with progress() as display:
        task = display.add_task("robustness", total=len(every), note="")
        for changed, wanted in every:
            display.update(task, note=wanted.condition)
            files = files_of(changed, wanted, out=out and out / wanted.file_name)
            counts = stored(changed, files)
            counts = counts or store(files, measure(changed, wanted), {})
            found += counts.values()
            display.advance(task)
    return found


def robustness_grid(every: Sequence[Counts], title: str) -> TextTable:
    """Make a table of a line per corruption; level 0 is the clean image, n the n-th severity."""
    scores = [percent(summary(counts, counts.absent)[MIOU]) for counts in every]
    rows: dict[str, list[int]] = {}
    for index, counts in enumerate(every[1:], 1):
        rows.setdefault(counts.measurement.condition, []).append(index)
    levels = max((len(row) for row in rows.values()), default=0)
    lines = []
    for row in rows.values():
        of = every[row[0]].measurement
        ladder = ", ".join(f"{every[index].measurement.severity:g}" for index in row)
        severities = f"{ladder} {of.unit}" if of.unit else ""
        values = [scores[index] for index in row] + [""] * (levels - len(row))
        lines.append((of.title or of.label, severities, scores[0], *values))
    header = ("", "severities", *(f"level {level}" for level in range(levels + 1)))
    return TextTable(title, header, tuple(lines or [("clean", "", scores[0])]))


def write_tables(every: Sequence[Counts], grid: TextTable, path: Path) -> None:
    """Write the numbers to `path` with .csv added and the table to `path` with .md added."""
    known = summary(every[0], every[0].absent)
    names = [name for name in SCORES if name in known]
    rows: list[tuple[object, ...]] = [("condition", "title", "unit", "severity", "view", *names)]
    for counts in every:
        of, values = counts.measurement, summary(counts, counts.absent)
        described = of.condition, of.title or of.label, of.unit, f"{of.severity:g}", of.view
        rows.append((*described, *(100 * values[name] for name in names)))
    # Names hold dots of severities: endings are added, not exchanged.
    write_atomic(path.with_name(f"{path.name}.csv"), csv_text(rows).encode())
    write_atomic(path.with_name(f"{path.name}.md"), grid.to_markdown().encode())
