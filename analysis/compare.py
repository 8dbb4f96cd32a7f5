"""Compare two methods: ``rgbt compare a=runs/<key> b=runs/<key>``.

One table and one sentence: the differences with intervals and p-values, over images and seeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

from analysis.commands import Archive, DrawOptions, check_out, write_files
from analysis.results import Evaluation, label_of, open_counts
from analysis.uncertainty import Comparison, Interval, Resampling, compare, sentence
from analysis.uncertainty.blocks import FEWEST
from rgbt.checks import InputError, split_list
from rgbt.config.common_options import RunsDir
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.metrics import names, score_grid
from rgbt.metrics.counts import Counts, convention
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
class Options(DrawOptions):
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


def main(options: Options, _: list[str]) -> int:
    """Compare two methods on the same images."""
    check_out(options.out)
    if options.condition and options.frames:
        raise InputError(f"condition={options.condition} is of single frames; omit frames=.")
    stored = options.runs_dir, options.split, options.frames, options.condition, options.archive
    opened = [open_counts(side, *stored) for side in (options.a, options.b)]
    if shared := {each.path for each in opened[0]} & {each.path for each in opened[1]}:
        raise InputError(f"a and b both contain {min(shared)}; give two different methods.")
    a, b = ([each.counts for each in side] for side in opened)
    settings = options.settings(None if options.absent == "as counted" else options.absent)
    found = compare(a, b, metrics_of(options.metrics, [*a, *b], settings), settings)
    shown = f" ({options.condition})" if options.condition else ""
    labels = [f"{label}{shown}" for label in _labels(opened)]
    grid = comparison_grid(found, labels, absent_classes([*a, *b], settings.absent))
    said = sentence(found, *labels)
    print_rich(rich_table(grid))
    # Scores by day and by night are over other images.
    drawn = {parse(each.metric).part: each.a.evidence.said for each in found.differences}
    parts = [f"{part}: {text}." for part, text in drawn.items() if part is not None]
    lists = [" or ".join(sorted({e.run.lists for e in each if e.run})) for each in opened]
    if lists[0] != lists[1] and all(lists):
        parts.append(f"Other lists: {labels[0]} {lists[0]}; {labels[1]} {lists[1]}.")
    unlike = f"Measured differently ({'; '.join(found.unlike)})." if found.unlike else ""
    remark = (
        f"Percent points (Var: squared). Intervals: Student, {settings.resamples} resamples of the "
        "images, seeds by Welch; p of the last interval; Holm: corrected for the number of lines."
    )
    lines = [said, unlike, *parts, found.evidence.reason, remark]
    print_rich(plain_text("\n".join(filter(None, lines))))
    text = "\n".join(filter(None, [grid.to_markdown(), said, unlike, ""]))
    write_files(options.out, {"comparison.md": text, "comparison.csv": comparison_frame(found)})
    return 0


def metrics_of(text: str, every: Sequence[Counts], settings: Resampling) -> list[str]:
    """The requested metrics; "auto": the usual scores of the counts.

    Means also by day and by night, where all counts have enough images of both for `settings`.
    """
    partition = every[0].partition
    if text != "auto":
        return split_list(text, "metrics")
    if details_of(partition) is not None:
        return list(score_grid.headlines(every[0]))
    protocol = protocol_of(partition)
    means = [names.MIOU] if protocol is None else [*HEADLINES[protocol]]
    numbers = range(1, every[0].counts.shape[1] + 1)
    regions = [names.VAR, *map(names.region, numbers)] if protocol is None else []
    # Neighbours of two sequences make no common block: a few images more than the product.
    fewest = FEWEST * (settings.blocks + 1 if isinstance(settings.blocks, int) else 1)
    told = [counts.parts() for counts in every]
    parts = [
        names.subset(part, metric)
        for part in (names.DAY, names.NIGHT)
        if all(part in each and len(each[part].names) >= fewest for each in told)
        for metric in means
    ]
    return [*means, *regions, *parts]


def comparison_grid(
    found: Comparison, labels: Sequence[str], notes: tuple[str, ...] = ()
) -> TextTable:
    """One line per score."""

    def between(interval: Interval | None) -> str:
        return f"{interval.low:+.2f} to {interval.high:+.2f}" if interval else ABSENT

    def of_p(p: float) -> str:
        return ABSENT if p != p else "<0.001" if p < 0.001 else f"{p:.3f}"

    with_seeds = any(each.difference.both is not None for each in found.differences)
    rows = []
    for each in found.differences:
        spreads = ["" if side.sd != side.sd else f" ± {side.sd:.2f}" for side in (each.a, each.b)]
        scores = [number(each.a.value) + spreads[0], number(each.b.value) + spreads[1]]
        scores.append(ABSENT if each.value != each.value else f"{each.value:+.2f}")
        ends = [between(each.difference.images), between(each.difference.both)][: 1 + with_seeds]
        rows.append((each.metric, *scores, *ends, of_p(each.difference.p), of_p(each.p_corrected)))
    level = f"{100 * found.level:g} % over images"
    over = [level, f"{level} and seeds"][: 1 + with_seeds]
    singles = f"{found.images} single images"
    said = found.evidence.said
    drawn = singles if said == singles else f"{found.images} images, {said}"
    title = f"{labels[1]} minus {labels[0]}: {drawn}, {found.partition}"
    return TextTable(title, ("", *labels, "difference", *over, "p", "p (Holm)"), tuple(rows), notes)


def comparison_frame(found: Comparison) -> pd.DataFrame:
    """One row per score; NaN where there is no interval."""
    import pandas as pd

    none = Interval(float("nan"), float("nan"))
    rows = []
    for each in found.differences:
        intervals = (each.difference.images or none, each.difference.both or none)
        bounds = [end for interval in intervals for end in (interval.low, interval.high)]
        scores = each.a.value, each.b.value, each.a.seeds, each.b.seeds, each.value
        rows.append((each.metric, *scores, *bounds, each.difference.p, each.p_corrected))
    columns = ["metric", "a", "b", "seeds_a", "seeds_b", "difference"]
    columns += ["images_low", "images_high", "both_low", "both_high", "p", "p_holm"]
    return pd.DataFrame(rows, columns=columns)


def absent_classes(every: Sequence[Counts], absent: Absent | None) -> tuple[str, ...]:
    """How absent classes count, by `absent` or as counted, and which both methods lack."""
    first, used = every[0], absent or convention(every)
    if protocol_of(first.partition) is not None or details_of(first.partition) is not None:
        return (absent_rule(used),)  # their matrices have no labels as rows
    summed = np.sum([counts.by_region() for counts in every], axis=0)
    notes = absent_notes(summed, first.classes, first.scored, first.split, used)
    return (absent_rule(used), *notes)


def _labels(opened: Sequence[tuple[Evaluation, ...]]) -> list[str]:
    """Labels that differ: the names of the methods, with their seeds where these are equal."""
    plain = labels = [label_of(each) for each in opened]
    if plain[0] == plain[1]:
        seeds = [sorted(named.seed for named in each if named.seed is not None) for each in opened]
        labels = [f"{plain[0]} seed {', '.join(map(str, each))}" for each in seeds if each]
    return labels if len(set(labels)) == 2 else [f"a: {plain[0]}", f"b: {plain[1]}"]


entry = PlainCommand(Options, main, heeds=())

if __name__ == "__main__":
    entry()
