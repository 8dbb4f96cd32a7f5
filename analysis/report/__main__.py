"""The report: ``python -m analysis.report out=report/`` makes one page from the MLflow store.

Progress goes to stderr; where the page is, how large it is and what it holds to stdout.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from analysis.arguments import MOST, out_folder, refuse_others, whole
from rgbt.checks import InputError
from rgbt.config.command import built, plain_command, readable_paths
from rgbt.config.stored_config import parse_trust

OWN = {"out": "report", "runs_dir": "runs", "resamples": "2000", "trust": ""}

FEWEST = 100
"""Resamples."""

TOLD = 5
"""Remarks told on stderr; the page has all."""


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Make one page of everything in an MLflow store; it needs no server and no network.

    out        folder; the page is index.html in it
    runs_dir   folder of runs; its mlflow.db is the store unless tracking.uri says another
    resamples  of the images, for intervals and p-values
    trust      modules of yours with maskers and data sets to draw: trust=my_lab; their code is run
    overrides of the tracker, such as tracking.uri=http://host:5000 or tracking.experiment=mine

    Every score is computed from the counts of its run. What cannot be read is told here and listed
    on the page.
    """
    resamples = whole("resamples", arguments["resamples"], FEWEST, MOST)
    runs_dir, out = Path(arguments["runs_dir"]).expanduser(), out_folder(arguments["out"])
    trust = parse_trust(arguments["trust"])
    if out is None:
        raise InputError("'out' has no value; give a folder for the page.")
    # Read by Hydra; the tracker resolves the folder like that of a run.
    place = readable_paths([f"runs_dir={os.fspath(runs_dir)}"])
    refuse_others(overrides, ("tracking",), list(OWN))
    tracking = built("tracking", [*place, *overrides])

    from rich.console import Console
    from rich.progress import Progress

    from analysis.report.collect import Asked, collect
    from analysis.report.page import write_page
    from rgbt.tracking.provenance import command_line
    from rgbt.tracking.terminal import place_lines, show, tell

    typed = command_line(["python", "-m", "analysis.report", *sys.argv[1:]])
    with Progress(console=Console(stderr=True)) as progress:

        def track(items: Sequence[Any], what: str) -> Any:
            return progress.track(items, description=what)

        data = collect(Asked(tracking, runs_dir, resamples, typed, trust), track)
    out.mkdir(parents=True, exist_ok=True)
    page = write_page(data, out)
    for remark in data.remarks[:TOLD]:
        tell(remark)
    if len(data.remarks) > TOLD:
        tell(f"{len(data.remarks) - TOLD} more remarks stand on the page.")
    run = [table for table in data.tables if table.scale]
    held = (
        f"{len(data.runs)} runs, {len(run)} tables with runs, {len(data.tables) - len(run)} "
        f"published alone, {len(data.studies)} studies"
    )
    size = f"{page.stat().st_size / 1e6:.2f} MB"
    show(place_lines([("page", str(page)), ("size", size), ("holds", held)]))
    return 0


if __name__ == "__main__":
    plain_command(OWN, main)()
