"""The report: ``rgbt report out=report/`` makes one page from the MLflow store.

With format=markdown it makes the pages of ``docs/results``.

Progress goes to stderr; where the page is, how large it is and what it holds to stdout.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from analysis.arguments import Resamples, check_out
from rgbt.config.command import built
from rgbt.config.options import Help, readable_paths
from rgbt.config.plain_command import PlainCommand
from rgbt.config.stored_config import parse_trust

MAX_REMARKS = 5
"""Remarks that are printed to stderr; the page has all."""


@dataclass(frozen=True)
class Options:
    """Options of ``rgbt report``."""

    out: Annotated[Path, Help("output folder; the page is its index.html")] = Path("report")
    format: Annotated[
        Literal["html", "markdown"],
        Help("html: one page; markdown: index.md, a page of tables per paper, networks.md"),
    ] = "html"
    runs_dir: Annotated[
        Path,
        Help("folder of runs; its mlflow.db is the store unless tracking.uri names another"),
    ] = Path("runs")
    resamples: Resamples = 2000
    trust: Annotated[
        str,
        Help(
            "your modules with maskers and data sets to draw: trust=my_lab; their code is executed"
        ),
    ] = ""


def main(options: Options, overrides: list[str]) -> int:
    """Make one page of everything in an MLflow store; it needs no server and no network.

    Overrides are of the tracker: tracking.uri=http://host:5000 or tracking.experiment=mine

    Every score is computed from the counts of its run. What cannot be read is reported here and
    listed on the page.
    """
    runs_dir, out = options.runs_dir, options.out
    check_out(out)
    trust = parse_trust(options.trust)
    # Read by Hydra; the tracker resolves the folder like that of a run.
    place = readable_paths([f"runs_dir={os.fspath(runs_dir)}"])
    tracking = built("tracking", [*place, *overrides])

    from rich.console import Console
    from rich.progress import Progress

    from analysis.report.collect import collect
    from analysis.report.markdown import write_pages
    from analysis.report.networks import network_entries
    from analysis.report.page import write_page
    from rgbt.runs.provenance import command_line
    from rgbt.terminal import info, path_lines, print_rich

    typed = command_line(["rgbt", "report", *sys.argv[1:]])
    with Progress(console=Console(stderr=True)) as progress:

        def track(items: Sequence[Any], what: str) -> Any:
            return progress.track(items, description=what)

        data = collect(tracking, runs_dir, options.resamples, typed, trust, track)
        networks = network_entries(track) if options.format == "markdown" else ()
    out.mkdir(parents=True, exist_ok=True)
    pages = write_pages(data, networks, out) if networks else [write_page(data, out)]
    for remark in data.remarks[:MAX_REMARKS]:
        info(remark)
    if len(data.remarks) > MAX_REMARKS:
        info(f"{len(data.remarks) - MAX_REMARKS} more remarks are on the page.")
    run = [table for table in data.tables if table.scale]
    held = (
        f"{len(data.runs)} runs, {len(run)} tables with runs, {len(data.tables) - len(run)} "
        f"published only, {len(data.studies)} studies"
    )
    size = f"{sum(page.stat().st_size for page in pages) / 1e6:.2f} MB"
    print_rich(
        path_lines([*(("page", str(page)) for page in pages), ("size", size), ("holds", held)])
    )
    return 0


entry = PlainCommand(Options, main, heeds=("tracking",))

if __name__ == "__main__":
    entry()
