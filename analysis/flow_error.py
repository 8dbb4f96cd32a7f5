"""Show how far scores along an estimated flow are from those along the exact flow.

``rgbt flow folder=measured`` reads what ``rgbt consistency frames=next
flow=rgb out=measured`` wrote, on the embedded data set or another one with known motion.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from analysis.arguments import Blocks, Level, Resamples
from rgbt.checks import InputError, split_list
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand

if TYPE_CHECKING:
    from analysis.uncertainty import Comparison, Difference, Resampling
    from rgbt.metrics.counts import Counts
    from rgbt.tables import TextTable


@dataclass(frozen=True)
class Options:
    """Options of ``rgbt flow``."""

    folder: Annotated[
        str,
        Help(
            "folder that rgbt consistency frames=next flow=rgb wrote with out=..., or several with "
            "commas: one for each source of the flow"
        ),
    ] = ""
    split: Annotated[str, Help("split that was measured")] = "test"
    level: Level = 0.95
    resamples: Resamples = 10_000
    blocks: Blocks = "auto"


@dataclass(frozen=True)
class MeasuredFlow:
    """Counts of one network along two flows, and the records of the estimated one.

    Attributes:
        label: name of the folder.
        exact: counts along the exact flow.
        estimated: counts of the same pairs along the estimated flow.
        records: one line for each pair (`rgbt.evaluation.pair_frames`).
    """

    label: str
    exact: Counts
    estimated: Counts
    records: tuple[dict[str, str], ...]


def main(options: Options, overrides: list[str]) -> int:
    """Compare TC, CA and warping error along an estimated and along the exact flow."""
    from analysis.uncertainty import Resampling
    from rgbt.terminal import print_rich, rich_table

    del overrides  # none takes effect
    if not options.folder:
        raise InputError("'folder' has no value; give a folder of rgbt consistency frames=next.")
    settings = Resampling(resamples=options.resamples, level=options.level, blocks=options.blocks)
    for word in split_list(options.folder, "folders"):
        measured = read_measured(Path(word), options.split)
        comparison = compare_flows(measured, settings)
        print_rich(rich_table(difference_table(measured, comparison)))
        print_rich(rich_table(record_table(measured)))
        print_rich(
            f"In brackets: {100 * options.level:g} % intervals over scenes ({comparison.said})."
        )
    return 0


def read_measured(folder: Path, split: str) -> MeasuredFlow:
    """What one command wrote.

    Raises:
        InputError: the folder lacks one of the files, or has those of several flows.
    """
    from rgbt.metrics.counts import Counts
    from rgbt.tables import read_csv

    found = sorted(folder.glob(f"consistency_flow-*_{split}.npz"))
    if len(found) != 1:
        raise InputError(
            f"{folder} has {len(found)} files consistency_flow-*_{split}.npz, expected one; write "
            "each flow to a folder of its own with rgbt consistency frames=next flow=rgb out=..."
        )
    table = found[0].with_name(f"{found[0].stem.removeprefix('consistency_')}.csv")
    if not table.is_file():
        raise InputError(f"{table} does not exist; measure again with rgbt consistency.")
    _, records = read_csv(table.read_text())
    return MeasuredFlow(
        label=folder.name,
        exact=Counts.load(folder / f"consistency_next_{split}.npz"),
        estimated=Counts.load(found[0]),
        records=tuple(records),
    )


def compare_flows(measured: MeasuredFlow, settings: Resampling) -> Comparison:
    """Estimated minus exact: all scenes, those of the day, and those of the night."""
    from analysis.uncertainty import compare
    from analysis.uncertainty.blocks import FEWEST
    from rgbt.metrics import names

    scores = (names.TC, names.CA, names.WARPING_ERROR)
    parts = [part for part, counts in measured.exact.parts().items() if len(counts.names) >= FEWEST]
    metrics = [*scores, *(names.subset(part, score) for part in parts for score in scores)]
    counts = [measured.exact], [measured.estimated]
    return compare(*counts, metrics, settings, paired=True, same_pixels=False)


def difference_table(measured: MeasuredFlow, comparison: Comparison) -> TextTable:
    """One line for each score."""
    from rgbt.tables import TextTable

    rows = tuple(_row(each) for each in comparison.differences)
    title = f"{measured.label}: scores along two flows, {len(measured.exact.names)} pairs (percent)"
    return TextTable(title, ("", "exact", "estimated", "difference"), rows)


def _row(found: Difference) -> tuple[str, ...]:
    around = found.difference.images
    ends = f" [{around.low:+.2f}, {around.high:+.2f}]" if around else ""
    name = found.metric.replace("_", " ")
    return name, f"{found.a.value:.2f}", f"{found.b.value:.2f}", f"{found.value:+.2f}{ends}"


def record_table(measured: MeasuredFlow) -> TextTable:
    """Means over scenes: pixels used, error of the flow, its length."""
    from rgbt.tables import TextTable

    header = ("scenes", "pixels used, %", "of these hidden, %", "error, px", "displacement, px")
    return TextTable("The estimated flow", header, tuple(_means(measured)))


def _means(measured: MeasuredFlow) -> Iterator[tuple[str, ...]]:
    parts = {"all": measured.exact, **measured.exact.parts()}
    for part, counts in parts.items():
        lines = [line for line in measured.records if line["name"] in set(counts.names)]
        shares = [100 * _mean(lines, key) for key in ("used", "hidden")]
        lengths = [_mean(lines, key) for key in ("end_point_error_px", "displacement_px")]
        yield part, *(f"{value:.1f}" for value in shares), *(f"{value:.2f}" for value in lengths)


def _mean(lines: Sequence[dict[str, str]], key: str) -> float:
    known = [float(line[key]) for line in lines if line[key]]
    return sum(known) / len(known) if known else float("nan")


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
