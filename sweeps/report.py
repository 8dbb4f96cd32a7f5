"""Pages of results from finished runs: ``rgbt report out=report``.

Progress goes to stderr; where the pages are and what they hold to stdout.
"""

from __future__ import annotations

import gc
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from analysis.commands import Resamples, check_out
from rgbt.config.common_options import RunsDir
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand

if TYPE_CHECKING:
    from sweeps.show.pages import Report

# Remarks that are printed to stderr; the page has all.
MAX_REMARKS = 5


@dataclass(frozen=True)
class Options:
    """Options of ``rgbt report``."""

    out: Annotated[Path, Help("output folder")] = Path("report")
    format: Annotated[
        Literal["html", "markdown"],
        Help("html: one file; markdown: a page of claims, of the tables of each paper, ..."),
    ] = "html"
    runs_dir: RunsDir = Path("runs")
    archive: Annotated[Path, Help("folder of the archive")] = Path("results")
    resamples: Resamples = 2000
    fill: Annotated[
        tuple[Path, ...],
        Help("with markdown: pages whose numbers between <!-- results:... --> are made again"),
    ] = ()


def main(options: Options, overrides: list[str]) -> int:
    """Write what finished runs show: tables beside the papers, verdicts of claims, runs.

    Runs come from a folder of runs and an archive together. Every score is computed from the counts
    of its run. What cannot be read is reported here and listed on the page. No MLflow store and no
    network is needed.
    """
    del overrides  # none is heeded
    out = options.out
    check_out(out)

    from rgbt.files.atomic import write_atomic
    from rgbt.terminal import info, path_lines, print_rich

    gc.set_threshold(1_000_000, 20, 20)  # a tenth of the time, for 40 MB: many small objects stay
    report = report_of(
        options.runs_dir, options.archive, options.resamples, counted=options.format == "markdown"
    )
    files = {out / "index.html": report.html()} if options.format == "html" else {}
    if options.format == "markdown":
        files = {out / name: text for name, text in report.pages().items()}
        files |= {page: report.filled(page.read_text()) for page in options.fill}
    out.mkdir(parents=True, exist_ok=True)
    for path, text in files.items():
        write_atomic(path, text.encode(errors="xmlcharrefreplace"))
    if options.format == "markdown":
        images = report.images
        for stale in {path.name for path in out.glob("*.svg")} - set(images):
            (out / stale).unlink()
        for name, content in images.items():
            write_atomic(out / name, content)
    for remark in report.remarks[:MAX_REMARKS]:
        info(remark)
    if len(report.remarks) > MAX_REMARKS:
        info(f"{len(report.remarks) - MAX_REMARKS} more remarks are on the page.")
    run = sum(view.is_run for view in report.views)
    held = f"{sum(1 for _ in report.source.finished)} runs, {run} tables with runs"
    print_rich(path_lines([*(("page", str(path)) for path in files), ("holds", held)]))
    return 0


def report_of(runs_dir: Path, archive: Path, resamples: int, *, counted: bool) -> Report:
    """The report of a folder of runs and an archive; `counted`: with sizes of networks."""
    from rich.console import Console
    from rich.progress import track

    from analysis.results import finished_runs
    from rgbt.config.options import readable_paths
    from sweeps.judge.stored_tables import FinishedRuns, TableResults, known_tables
    from sweeps.plan.planner import Planner
    from sweeps.show import pages

    runs = finished_runs(runs_dir, archive)
    planner = Planner(readable_paths([f"runs_dir={runs_dir}"]))
    remarks: list[str] = []
    source = TableResults(
        FinishedRuns(runs), planner, known_tables(remarks), resamples, counted, remarks
    )
    notes = {path.parent.name: path for path in sorted(runs_dir.glob("studies/*/study.md"))}
    studies = {name: path.read_text(errors="replace") for name, path in notes.items()}
    console = Console(stderr=True)
    return pages.Report(
        source, runs, studies, lambda items: track(list(items), "tables", console=console)
    )


entry = PlainCommand(Options, main, heeds=())

if __name__ == "__main__":
    entry()
