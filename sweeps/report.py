"""Pages of results from finished runs: ``rgbt report out=report``.

Progress goes to stderr; where the pages are and what they hold to stdout.
"""

from __future__ import annotations

import gc
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from analysis.commands import Resamples, check_out
from rgbt.config.common_options import RunsDir
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand

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
    """Write what finished runs show: images, charts, tables beside the papers, verdicts of claims.

    Runs come from a folder of runs and an archive together. Every score is computed from the counts
    of its run. What cannot be read is reported here and listed on the page. No MLflow store and no
    network is needed.
    """
    del overrides  # none is heeded
    out, is_markdown = options.out, options.format == "markdown"
    check_out(out)

    from rgbt.files.atomic import write_atomic
    from rgbt.terminal import info, path_lines, print_rich
    from sweeps.show.pages import Report
    from sweeps.show.sections import number_of

    gc.set_threshold(1_000_000, 20, 20)  # a tenth of the time, for 40 MB: many small objects stay
    report = Report(options.runs_dir, options.archive, options.resamples, counted=is_markdown)
    if is_markdown:
        files = {out / name: text for name, text in report.pages().items()}
        files |= {page: report.filled(page.read_text()) for page in options.fill}
    else:
        files = {out / "index.html": report.html()}
    out.mkdir(parents=True, exist_ok=True)
    for path, text in files.items():
        write_atomic(path, text.encode(errors="xmlcharrefreplace"))
    if is_markdown:
        for path in out.glob("*.svg"):
            if path.name not in report.images:
                path.unlink()
        for name, content in report.images.items():
            write_atomic(out / name, content)
    for remark in report.remarks[:MAX_REMARKS]:
        info(remark)
    if len(report.remarks) > MAX_REMARKS:
        info(f"{len(report.remarks) - MAX_REMARKS} more remarks are on the page.")
    runs = len(list(report.reader))
    tables = sum(table.is_run for table in report.tables)
    lines = [("page", str(path)) for path in files]
    held = f"{number_of(runs, 'run')}, {number_of(tables, 'table')} with runs"
    print_rich(path_lines([*lines, ("holds", held)]))
    return 0


entry = PlainCommand(Options, main, heeds=())

if __name__ == "__main__":
    entry()
