"""Show boundary IoU, calibration, distance, size and inputs of a method: ``rgbt details run=...``.

A file of counts of ``rgbt consistency`` shows TC, CA and the changes along the motion.
The counts are those that ``rgbt evaluate run=... modality=all details=all`` has stored; no network
is built. Every score has an interval over images.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from annotated_types import Interval as Bounds

from analysis.arguments import Blocks, Level, Resamples, check_out
from rgbt.checks import InputError
from rgbt.config.common_options import RunsDir
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand

if TYPE_CHECKING:
    from analysis.detail_counts import DetailKey
    from analysis.uncertainty import Estimate, Resampling
    from rgbt.metrics.counts import Counts
    from rgbt.metrics.score_grid import ScoreGrid
    from rgbt.tables import TextTable


@dataclass(frozen=True)
class Options:
    """Options of ``rgbt details``."""

    run: Annotated[
        str,
        Help(
            "a run (folder, config key or MLflow run id), a group of runs (all seeds), a file of "
            "counts (.npz), or a list of these with commas: seeds of one method"
        ),
    ] = ""
    split: Annotated[str, Help("split of the runs")] = "test"
    level: Level = 0.95
    resamples: Resamples = 10_000
    blocks: Blocks = "auto"
    seed: Annotated[int, Bounds(ge=0, le=2**31), Help("seed of the resampling")] = 0
    runs_dir: RunsDir = Path("runs")
    out: Annotated[Path | None, Help("output folder of details.md and details.csv")] = None


@dataclass(frozen=True)
class DetailTable:
    """The scores of one file of counts, or of one for each seed.

    Attributes:
        key: what was counted.
        grid: names of the scores.
        estimates: by name.
    """

    key: DetailKey
    grid: ScoreGrid
    estimates: Mapping[str, Estimate]

    @property
    def is_plain(self) -> bool:
        """Whether the counts are of single frames without details."""
        from rgbt.metrics.pairs import protocol_of

        return self.key.kind is None and protocol_of(self.key.regions) is None


def main(options: Options, overrides: list[str]) -> int:
    """Show every stored score of a method by region, class, bin and input."""
    from analysis.detail_counts import open_details
    from analysis.results import label_of, open_counts
    from analysis.uncertainty import Resampling
    from rgbt.files.atomic import write_atomic
    from rgbt.terminal import path_lines, print_rich, rich_table

    del overrides  # none takes effect
    check_out(options.out)
    if not options.run:
        raise InputError("'run' has no value; give a run, a group of runs, or a file of counts.")
    settings = Resampling(
        resamples=options.resamples,
        level=options.level,
        blocks=options.blocks,
        seed=options.seed,
    )
    opened = open_counts(options.run, options.runs_dir)
    tables = [
        table_of(key, counts, settings)
        for key, counts in open_details(opened, options.split).items()
    ]
    grids = [*text_tables(tables, label_of(opened))]
    for grid in grids:
        print_rich(rich_table(grid))
    first = next(iter(tables[0].estimates.values()))
    reason = f" {first.reason}" if first.reason else ""
    seeds = " and seeds" if len(opened) > 1 else ""
    remark = (
        f"In brackets: {100 * settings.level:g} % intervals over images{seeds} ({first.said}), "
        f"{settings.resamples} resamples.{reason}"
    )
    print_rich(remark)
    out = options.out
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        text = "\n".join([*(grid.to_markdown() for grid in grids), remark, ""])
        write_atomic(out / "details.md", text.encode())
        write_atomic(out / "details.csv", details_csv(tables).encode())
        print_rich(path_lines([("files", f"{out}/ (details.md, details.csv)")]))
    return 0


def table_of(key: DetailKey, counts: Sequence[Counts], settings: Resampling) -> DetailTable:
    """The scores of counts of one kind, one for each seed, with intervals."""
    from analysis.uncertainty import estimate
    from rgbt.metrics.score_grid import score_grid

    grid = score_grid(counts[0])
    return DetailTable(key, grid, estimate(counts, list(dict.fromkeys(grid.metrics)), settings))


def text_tables(tables: Sequence[DetailTable], label: str) -> Iterator[TextTable]:
    """The tables as text; those of single frames have one row for each input and come first."""
    from rgbt.tables import TextTable

    plain: dict[str, list[DetailTable]] = {}
    for table in tables:
        if table.is_plain:
            plain.setdefault(table.key.regions, []).append(table)
    for regions, group in plain.items():
        rows = [(each.key.view or "mIoU", *_cells(each, each.grid.metrics)) for each in group]
        title = f"{label}: {group[0].grid.title} and input ({regions})"
        yield TextTable(title, ("", *group[0].grid.columns), tuple(rows))
    for each in tables:
        if not each.is_plain:
            rows = [(name, *_cells(each, metrics)) for name, metrics in each.grid.rows]
            of_view = f", {each.key.view}" if each.key.view else ""
            title = f"{label}{of_view}: {each.grid.title} ({each.key.regions})"
            yield TextTable(title, ("", *each.grid.columns), tuple(rows))


def details_csv(tables: Sequence[DetailTable]) -> str:
    """One line per score with all digits; empty where there is no value."""
    from rgbt.tables import csv_text

    header = ("regions", "details", "input", "metric", "value", "sd", "seeds", "low", "high")
    rows: list[tuple[object, ...]] = [header]
    for table in tables:
        key = table.key
        for metric, each in table.estimates.items():
            interval = each.both or each.images
            ends = (interval.low, interval.high) if interval else ("", "")
            values = (each.value, each.sd, each.seeds, *ends)
            shown = ("" if value != value else value for value in values)
            rows.append((key.regions, key.kind or "", key.view, metric, *shown))
    return csv_text(rows)


def _cells(table: DetailTable, metrics: Sequence[str]) -> list[str]:
    from rgbt.tables import number

    cells = []
    for metric in metrics:
        each = table.estimates[metric]
        interval = each.both or each.images
        around = f" [{interval.low:.2f}, {interval.high:.2f}]" if interval else ""
        cells.append(number(each.value) + around)
    return cells


entry = PlainCommand(Options, main, heeds=())

if __name__ == "__main__":
    entry()
