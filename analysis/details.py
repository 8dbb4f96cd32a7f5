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

from analysis.commands import Archive, DrawOptions, check_out, write_files
from analysis.results import Evaluation, evaluations_of, label_of, open_counts
from analysis.uncertainty import Estimate, estimate
from rgbt.checks import InputError
from rgbt.config.common_options import RunsDir
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import KINDS, details_of, regions_of
from rgbt.metrics.pairs import protocol_of
from rgbt.metrics.score_grid import ScoreGrid, score_grid
from rgbt.metrics.scores import absent_rule
from rgbt.tables import TextTable, number
from rgbt.terminal import print_rich, rich_table
from rgbt.types import VIEWS

if TYPE_CHECKING:  # --help answers without waiting for pandas
    import pandas as pd

# Input of the network ("" where a file does not tell), and partition of the counts.
Key = tuple[str, str]

Scores = tuple[ScoreGrid, Mapping[str, Estimate]]


@dataclass(frozen=True, kw_only=True)
class DetailsOptions(DrawOptions):
    """Options of ``rgbt details``."""

    run: Annotated[
        str,
        Help(
            "a run (folder, config key or MLflow run id), a group of runs (all seeds), a file of "
            "counts (.npz), or a list of these with commas: seeds of one method"
        ),
    ]
    split: Annotated[str, Help("split of the runs")] = "test"
    runs_dir: RunsDir = Path("runs")
    archive: Archive = Path("results")
    out: Annotated[Path | None, Help("output folder of details.md and details.csv")] = None


def main(options: DetailsOptions, _: list[str]) -> int:
    """Show every stored score of a method by region, class, bin and input."""
    check_out(options.out)
    settings = options.settings()
    opened = open_counts(options.run, options.runs_dir, archive=options.archive)
    found: dict[Key, Scores] = {}
    for key, counts in _stored(opened, options.split).items():
        grid = score_grid(counts[0])
        found[key] = grid, estimate(counts, list(dict.fromkeys(grid.metrics)), settings)
    tables = list(_tables(found, label_of(opened)))
    for table in tables:
        print_rich(rich_table(table))
    first = next(iter(found.values()))[1]
    evidence = next(iter(first.values())).evidence
    seeds = " and seeds" if len(opened) > 1 else ""
    remark = (
        f"In brackets: {100 * settings.level:g} % intervals over images{seeds} ({evidence.said}), "
        f"{settings.resamples} resamples. {evidence.reason} {absent_rule(opened[0].counts.absent)}"
    )
    print_rich(remark)
    text = "\n".join([*(table.to_markdown() for table in tables), remark, ""])
    write_files(options.out, {"details.md": text, "details.csv": _frame(found)})
    return 0


def _stored(opened: Sequence[Evaluation], split: str) -> dict[Key, list[Counts]]:
    """Return the counts of a method by what they are of, one for each training.

    InputError: a training lacks counts that another has, or has none beside those of its end.
    """
    by_training = [_by_key(training, split) for training in opened]

    def order(key: Key) -> tuple[str, int, int]:
        details = details_of(key[1])
        kind = (None, *KINDS).index(details and details.kind)
        return regions_of(key[1]), kind, ("", *VIEWS).index(key[0])

    known: set[Key] = set()
    for found in by_training:
        known.update(found)
    keys = sorted(known, key=order)
    views = {view for view, _ in keys}
    is_more = len(views) > 1 or any(details_of(partition) for _, partition in keys)
    for training, found in zip(opened, by_training, strict=True):
        missing = [details_of(key[1]) for key in keys if key not in found]
        if missing or not (is_more or training.run is None):
            modality = "..." if is_more and len(views) == 1 else "modality=all"
            lacking = [details.kind for details in missing if details is not None]
            kinds = ",".join(dict.fromkeys(lacking)) or "boundary"
            folder = training.path.parent
            raise InputError(
                f"{folder} has no counts of {kinds} of split '{split}'; write them with rgbt "
                f"evaluate run={folder} {modality} details={kinds}"
            )
    return {key: [found[key] for found in by_training] for key in keys}


def _by_key(training: Evaluation, split: str) -> dict[Key, Counts]:
    """Return the counts of the same images that a run has; a file alone has no named input."""
    if training.run is None:
        return {("", training.counts.partition): training.counts}
    found = {}
    for stored in evaluations_of(training.run, split):
        of = stored.counts.measurement
        if set(of.changed) <= {"view", "partition"} and not protocol_of(of.partition):
            found[of.view, of.partition] = stored.counts
    return found


def _tables(found: Mapping[Key, Scores], label: str) -> Iterator[TextTable]:
    """Yield the scores as text; tables of one line are joined, with a line for each input."""
    groups: dict[tuple[str, str, str], list[Key]] = {}
    for (view, partition), (grid, _) in found.items():
        alone = view if len(grid.rows) > 1 else ""
        groups.setdefault((alone, grid.title, regions_of(partition)), []).append((view, partition))
    for (alone, title, regions), keys in groups.items():
        first, _ = found[keys[0]]
        is_joined = len(first.rows) == 1 and keys[0][0] != ""
        rows = []
        for view, partition in keys:
            grid, estimates = found[view, partition]
            for name, metrics in grid.rows:
                cells = [_cell(estimates[metric]) for metric in metrics]
                rows.append((view if is_joined else name, *cells))
        named = f"{label}, {alone}" if alone else label
        title = f"{named}: {title}{' and input' if is_joined else ''} ({regions})"
        yield TextTable(title, ("", *first.columns), tuple(rows))


def _cell(score: Estimate) -> str:
    ends = score.interval
    return number(score.value) + (f" [{ends.low:.2f}, {ends.high:.2f}]" if ends else "")


def _frame(found: Mapping[Key, Scores]) -> pd.DataFrame:
    """Make one row per score; NaN where there is no interval."""
    import pandas as pd

    rows = []
    for (view, partition), (_, estimates) in found.items():
        details = details_of(partition)
        about = regions_of(partition), details.kind if details else "", view
        for metric, score in estimates.items():
            interval = score.interval
            ends = (interval.low, interval.high) if interval else (None, None)
            rows.append((*about, metric, score.value, score.sd, score.seeds, *ends))
    columns = ["regions", "details", "input", "metric", "value", "sd", "seeds", "low", "high"]
    return pd.DataFrame(rows, columns=columns)


entry = PlainCommand(DetailsOptions, main, heeds=())

if __name__ == "__main__":
    entry()
