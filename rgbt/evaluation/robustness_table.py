"""The table of a run's robustness, its title and its folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rgbt.build.load_run import TrainedNetwork
from rgbt.evaluation.request import NetworkRequest
from rgbt.evaluation.robustness import CLEAN, Measured, read_json
from rgbt.files.atomic import write_atomic
from rgbt.tracking.csv_files import csv_text
from rgbt.tracking.tables import TextTable, percent

FOLDER = "robustness"
"""Inside ``evaluations/`` of a run; `analysis.robustness` looks for curves there."""


def counts_folder(opened: TrainedNetwork, network: NetworkRequest, split: str) -> Path:
    """Folder of a split's counts: named plainly where the run is measured as it was trained."""
    session = opened.session
    regions = [session.regions.name] if network.regions else []
    own = read_json(opened.folder.parent / "dataset.json") or {}
    found = session.dataset.fingerprint()
    is_other = own.get("files", found) != found
    others = [f"{session.dataset.name}-{found[:8]}"] if is_other else []
    return opened.folder / FOLDER / "_".join([split, *regions, *network.suffixes, *others])


def robustness_title(opened: TrainedNetwork, split: str) -> str:
    """Title of the table."""
    session = opened.session
    is_run = opened.step > 0  # a file of weights tells neither step nor seed
    seed = f" seed={session.spec.seed}" if is_run else ""
    return f"Robustness of {opened.label}{seed} ({session.dataset.name}, {split}): mIoU in percent"


def robustness_grid(measured: Sequence[Measured], title: str) -> TextTable:
    """One line per corruption; level 0 is the clean image, level n the n-th severity.

    Args:
        measured: the clean images first.
        title: shown above.
    """
    clean, *others = measured
    rows: dict[str, list[Measured]] = {}
    for each in others:
        rows.setdefault(each.condition.row, []).append(each)
    levels = max((len(row) for row in rows.values()), default=0)
    lines = []
    for row in rows.values():
        first = row[0].condition
        ladder = ", ".join(f"{each.condition.severity:g}" for each in row)
        severities = f"{ladder} {first.unit}" if first.unit else ""
        values = [percent(each.mious["mIoU"]) for each in (clean, *row)]
        empty = [""] * (levels - len(row))
        lines.append((first.title, severities, *values, *empty))
    lines = lines or [(CLEAN, "", percent(clean.mious["mIoU"]))]
    header = ("", "severities", *(f"level {level}" for level in range(levels + 1)))
    return TextTable(title, header, tuple(lines))


def write_tables(measured: Sequence[Measured], grid: TextTable, path: Path) -> None:
    """Write the numbers to `path` with .csv added and the table to `path` with .md added."""
    scores = list(measured[0].mious)
    rows: list[tuple[object, ...]] = [("row", "title", "unit", "severity", "view", *scores)]
    for each in measured:
        seen = each.condition
        values = [100 * each.mious[score] for score in scores]
        rows.append((seen.row, seen.title, seen.unit, f"{seen.severity:g}", seen.view, *values))
    # Names hold dots of severities: endings are added, not exchanged.
    write_atomic(path.with_name(f"{path.name}.csv"), csv_text(rows).encode())
    write_atomic(path.with_name(f"{path.name}.md"), grid.to_markdown().encode())
