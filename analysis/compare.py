"""Compare two methods: ``rgbt compare a=runs/<key> b=runs/<key>``.

One table and one sentence: the differences with intervals and p-values, over images and seeds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

from analysis.commands import Archive, DrawOptions, check_out, write_files
from analysis.results import Evaluation, label_of, open_counts
from analysis.uncertainty import Comparison, Interval, Resampling, compare, sentence
from rgbt.checks import InputError, split_list
from rgbt.config.common_options import RunsDir
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.metrics import names, score_grid
from rgbt.metrics.counts import FEWEST, Counts, convention
from rgbt.metrics.details import details_of
from rgbt.metrics.metric import Absent
from rgbt.metrics.named import parse
from rgbt.metrics.pairs import HEADLINES, protocol_of
from rgbt.metrics.scores import absent_notes, absent_rule
from rgbt.tables import ABSENT, TextTable, number
from rgbt.terminal import plain_text, print_rich, rich_table

if TYPE_CHECKING:  # --help answers without waiting for pandas
    import pandas as pd


@dataclass(frozen=True, kw_only=True)
class CompareOptions(DrawOptions):
    """Options of ``rgbt compare``."""

    a: Annotated[
        str,
        Help(
            "first method: a run (folder, config key or MLflow run id), a file of counts (.npz of "
            'rgbt evaluate or rgbt score), a group of runs ("grbm sigma_div=2": all its seeds), '
            "or a list of these with commas: seeds of one method"
        ),
    ]
    b: Annotated[str, Help("second method, in the same form as a")]
    metrics: Annotated[
        str,
        Help(
            "scores to compare: mIoU,Var,region/1,class/car,night/mIoU ...; auto: mIoU, Var, "
            "regions, day and night; for pairs of frames: TC,CA,CA_released,warping_error,"
            "class/car/TC,night/TC ...; auto: TC and CA; for three frames: flicker"
        ),
    ] = "auto"
    split: Annotated[str, Help("split of the runs; default: test")] = ""
    frames: Annotated[
        Literal["", "aligned", "released", "next", "flow", "triples"],
        Help(
            "compare the counts of pairs of frames of the runs (rgbt consistency run=...): aligned "
            "or released (virtual views), next (known motion), flow (videos), triples (three "
            "frames of videos); default: single frames"
        ),
    ] = ""
    condition: Annotated[
        str, Help('input (rgbt evaluate) or corruption (rgbt robustness): thermal, "noise:rgb 16"')
    ] = ""
    absent: Annotated[
        Literal["as counted", "released", "exclude"],
        Help(
            "class without pixels: released: it scores 0; exclude: it is in no mean; as counted: "
            "convention of the data set"
        ),
    ] = "as counted"
    runs_dir: RunsDir = Path("runs")
    archive: Archive = Path("results")
    out: Annotated[Path | None, Help("output folder of comparison.md and comparison.csv")] = None


def main(options: CompareOptions, _: list[str]) -> int:
    """Compare two methods on the same images."""
    check_out(options.out)
    if options.condition and options.frames:
        raise InputError(f"condition={options.condition} is of single frames; omit frames=.")
    stored = options.runs_dir, options.split, options.frames, options.condition, options.archive
    side_a = open_counts(options.a, *stored)
    side_b = open_counts(options.b, *stored)
    shared = {found.path for found in side_a} & {found.path for found in side_b}
    if shared:
        raise InputError(f"a and b both contain {min(shared)}; give two different methods.")
    a, b = [found.counts for found in side_a], [found.counts for found in side_b]
    settings = options.settings(None if options.absent == "as counted" else options.absent)
    comparison = compare(a, b, metrics_of(options.metrics, [*a, *b], settings), settings)
    shown = f" ({options.condition})" if options.condition else ""
    labels = [f"{label}{shown}" for label in _labels(side_a, side_b)]
    grid = comparison_grid(comparison, labels, absent_classes([*a, *b], settings.absent))
    said = sentence(comparison, *labels)
    print_rich(rich_table(grid))
    unlike = ""
    if comparison.unlike:
        unlike = f"Measured differently ({'; '.join(comparison.unlike)})."
    remark = (
        f"Percent points (Var: squared). Intervals: Student, {settings.resamples} resamples of the "
        "images, seeds by Welch; p of the last interval; Holm: corrected for the number of lines."
    )
    lines = [said, unlike, *_remarks(comparison, (side_a, side_b), labels), remark]
    print_rich(plain_text("\n".join(filter(None, lines))))
    text = "\n".join(filter(None, [grid.to_markdown(), said, unlike, ""]))
    files = {"comparison.md": text, "comparison.csv": comparison_frame(comparison)}
    write_files(options.out, files)
    return 0


def _remarks(
    comparison: Comparison, sides: Sequence[Sequence[Evaluation]], labels: Sequence[str]
) -> list[str]:
    """Say which images days and nights are, which lists differ, and why images were so drawn."""
    parts = {}
    for difference in comparison.differences:
        part = parse(difference.metric).part
        if part is not None:  # scores by day and by night are over other images
            parts[part] = difference.a.evidence.said
    remarks = [f"{part}: {said}." for part, said in parts.items()]
    lists = []
    for side in sides:
        of_side = {found.run.lists for found in side if found.run}
        lists.append(" or ".join(sorted(of_side)))
    if lists[0] != lists[1] and all(lists):
        remarks.append(f"Other lists: {labels[0]} {lists[0]}; {labels[1]} {lists[1]}.")
    return [*remarks, comparison.evidence.reason]


def metrics_of(text: str, every: Sequence[Counts], settings: Resampling) -> list[str]:
    """Return the requested metrics; "auto": the usual scores of the counts.

    Means also by day and by night, where all counts have enough images of both for `settings`.
    """
    partition = every[0].partition
    if text != "auto":
        return split_list(text, "metrics")
    if details_of(partition) is not None:
        return list(score_grid.headlines(every[0]))
    protocol = protocol_of(partition)
    if protocol is None:
        means = [names.MIOU]
        regions = [names.region(number) for number in range(1, every[0].counts.shape[1] + 1)]
        metrics = [*means, names.VAR, *regions]
    else:
        means = [*HEADLINES[protocol]]
        metrics = [*means]
    # Neighbours of two sequences make no common block: a few images more than the product.
    fewest = FEWEST * (settings.blocks + 1 if isinstance(settings.blocks, int) else 1)
    for part in (names.DAY, names.NIGHT):
        of_part = [counts.parts().get(part) for counts in every]
        if all(counts is not None and len(counts.names) >= fewest for counts in of_part):
            metrics += [names.subset(part, metric) for metric in means]
    return metrics


def comparison_grid(
    comparison: Comparison, labels: Sequence[str], notes: tuple[str, ...] = ()
) -> TextTable:
    """Show one line per score."""

    def ends_of(interval: Interval | None) -> str:
        return f"{interval.low:+.2f} to {interval.high:+.2f}" if interval else ABSENT

    with_seeds = any(found.difference.both is not None for found in comparison.differences)
    rows = []
    for found in comparison.differences:
        row = [found.metric]
        for side in (found.a, found.b):
            row.append(number(side.value) + ("" if math.isnan(side.sd) else f" ± {side.sd:.2f}"))
        row.append(ABSENT if math.isnan(found.value) else f"{found.value:+.2f}")
        row.append(ends_of(found.difference.images))
        if with_seeds:
            row.append(ends_of(found.difference.both))
        rows.append((*row, _p_text(found.difference.p), _p_text(found.difference.p_corrected)))
    level = f"{100 * comparison.level:g} % over images"
    over = [level, f"{level} and seeds"] if with_seeds else [level]
    drawn = f"{comparison.images} single images"
    if comparison.evidence.said != drawn:
        drawn = f"{comparison.images} images, {comparison.evidence.said}"
    title = f"{labels[1]} minus {labels[0]}: {drawn}, {comparison.partition}"
    return TextTable(title, ("", *labels, "difference", *over, "p", "p (Holm)"), tuple(rows), notes)


def _p_text(p: float) -> str:
    if math.isnan(p):
        return ABSENT
    return "<0.001" if p < 0.001 else f"{p:.3f}"


def comparison_frame(comparison: Comparison) -> pd.DataFrame:
    """Make one row per score; NaN where there is no interval."""
    import pandas as pd

    none = Interval(math.nan, math.nan)
    rows = []
    for found in comparison.differences:
        images, both = found.difference.images or none, found.difference.both or none
        scores = found.a.value, found.b.value, found.a.seeds, found.b.seeds, found.value
        bounds = images.low, images.high, both.low, both.high
        ps = found.difference.p, found.difference.p_corrected
        rows.append((found.metric, *scores, *bounds, *ps))
    columns = ["metric", "a", "b", "seeds_a", "seeds_b", "difference"]
    columns += ["images_low", "images_high", "both_low", "both_high", "p", "p_holm"]
    return pd.DataFrame(rows, columns=columns)


def absent_classes(every: Sequence[Counts], absent: Absent | None) -> tuple[str, ...]:
    """Say how absent classes count, by `absent` or as counted, and which both methods lack."""
    first, used = every[0], absent or convention(every)
    if protocol_of(first.partition) is not None or details_of(first.partition) is not None:
        return (absent_rule(used),)  # their matrices have no labels as rows
    summed = np.sum([counts.by_region() for counts in every], axis=0)
    notes = absent_notes(summed, first.classes, first.scored, first.split, used)
    return (absent_rule(used), *notes)


def _labels(*sides: Sequence[Evaluation]) -> list[str]:
    """Return labels that differ: the methods, with their seeds where these have one name."""
    plain = labels = [label_of(side) for side in sides]
    if plain[0] == plain[1]:
        labels = []
        for side in sides:
            seeds = sorted(found.seed for found in side if found.seed is not None)
            labels += [f"{plain[0]} seed {', '.join(map(str, seeds))}"] if seeds else []
    return labels if len(set(labels)) == 2 else [f"a: {plain[0]}", f"b: {plain[1]}"]


entry = PlainCommand(CompareOptions, main, heeds=())

if __name__ == "__main__":
    entry()
