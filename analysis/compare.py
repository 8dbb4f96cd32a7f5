"""Compare two methods: ``rgbt compare a=runs/<key> b=runs/<key>``.

One table and one sentence: the differences with intervals and p-values, over images and seeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from annotated_types import Interval as Bounds

from analysis.arguments import Blocks, Level, Resamples, check_out
from rgbt.checks import InputError, split_list
from rgbt.config.common_options import RunsDir
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand

if TYPE_CHECKING:
    from analysis.results import NamedCounts
    from analysis.uncertainty import Comparison, Interval, Resampling
    from rgbt.metrics.counts import Counts
    from rgbt.metrics.metric import Absent
    from rgbt.tables import TextTable


@dataclass(frozen=True)
class Options:
    """Options of ``rgbt compare``."""

    a: Annotated[
        str,
        Help(
            "first method: a run (folder, config key or MLflow run id), a file of counts (.npz of "
            'rgbt evaluate or rgbt score), a group of runs ("grbm sigma_div=2": all its seeds), '
            "or a list of these with commas: seeds of one method"
        ),
    ] = ""
    b: Annotated[str, Help("second method, in the same form as a")] = ""
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
    corruption: Annotated[
        str,
        Help(
            "compare the counts of corrupted images of the runs (rgbt robustness run=...): "
            "corruption=noise:rgb severity=16"
        ),
    ] = ""
    severity: Annotated[str, Help("severity of the corruption")] = ""
    missing: Annotated[
        Literal["refuse", "leave_out"],
        Help("images that only one method has: refuse the comparison, or leave_out: exclude them"),
    ] = "refuse"
    level: Level = 0.95
    resamples: Resamples = 10_000
    blocks: Blocks = "auto"
    absent: Annotated[
        Literal["as counted", "released", "exclude"],
        Help(
            "class without pixels: released: it scores 0; exclude: it is in no mean; as counted: "
            "convention of the data set"
        ),
    ] = "as counted"
    seed: Annotated[int, Bounds(ge=0, le=2**31), Help("seed of the resampling")] = 0
    runs_dir: RunsDir = Path("runs")
    out: Annotated[Path | None, Help("output folder of comparison.md and comparison.csv")] = None


def main(options: Options, overrides: list[str]) -> int:
    """Compare two methods on the same images."""
    from rich.markup import escape

    from analysis.uncertainty import Resampling, compare
    from analysis.uncertainty.sentence import sentence
    from rgbt.files.atomic import write_atomic
    from rgbt.metrics.named import parse
    from rgbt.terminal import path_lines, print_rich, rich_table

    del overrides  # none takes effect
    check_out(options.out)
    opened = _opened(options)
    a, b = _counts(opened, options.missing)
    settings = Resampling(
        resamples=options.resamples,
        level=options.level,
        blocks=options.blocks,
        seed=options.seed,
        absent=None if options.absent == "as counted" else options.absent,
    )
    comparison = compare(a, b, metrics_of(options.metrics, [*a, *b], settings), settings)
    shown = " ".join(word for word in (options.corruption, options.severity) if word)
    labels = [f"{label} ({shown})" if shown else label for label in _labels(opened)]
    notes = absent_classes([*a, *b], settings.absent)
    grid = replace(comparison_grid(comparison, labels), notes=notes)
    said = sentence(comparison, *labels)
    print_rich(rich_table(grid))
    # Scores by day and by night are over other images.
    drawn = {parse(each.metric).part: each.a.said for each in comparison.differences}
    parts = [f"{part}: {text}." for part, text in drawn.items() if part is not None]
    remark = (
        f"Percent points (Var: squared). Intervals: Student, {settings.resamples} resamples of the "
        "images, seeds by Welch; p of the last interval; Holm: corrected for the number of lines."
    )
    print_rich(escape("\n".join(filter(None, [said, *parts, comparison.reason, remark]))))
    out = options.out
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_atomic(out / "comparison.md", f"{grid.to_markdown()}\n{said}\n".encode())
        write_atomic(out / "comparison.csv", comparison_csv(comparison).encode())
        print_rich(path_lines([("files", f"{out}/ (comparison.md, comparison.csv)")]))
    return 0


def metrics_of(text: str, every: Sequence[Counts], settings: Resampling) -> list[str]:
    """The requested metrics; "auto": the usual scores of the counts, also by day and by night.

    Of single frames mIoU (by day, by night) and Var and every region; of pairs of frames the two
    of their protocol (by day, by night). Day and night where all counts distinguish them and have
    enough images of them for `settings`.
    """
    from analysis.uncertainty.blocks import FEWEST
    from rgbt.metrics import names, score_grid
    from rgbt.metrics.details import details_of
    from rgbt.metrics.pairs import HEADLINES, protocol_of

    if text != "auto":
        return split_list(text, "metrics")
    if details_of(every[0].partition) is not None:
        return list(score_grid.headlines(every[0]))
    headlines: tuple[str, ...] = (names.MIOU,)
    by_region = [names.VAR, *map(names.region, range(1, every[0].counts.shape[1] + 1))]
    protocol = protocol_of(every[0].partition)
    if protocol is not None:
        headlines, by_region = HEADLINES[protocol], []
    told = [counts.parts() for counts in every]
    # Neighbours of two sequences make no common block: a few images more than the product.
    fewest = FEWEST * (settings.blocks + 1 if isinstance(settings.blocks, int) else 1)
    parts = [
        names.subset(part, metric)
        for part in (names.DAY, names.NIGHT)
        if all(part in each and len(each[part].names) >= fewest for each in told)
        for metric in headlines
    ]
    return [*headlines, *by_region, *parts]


def comparison_grid(comparison: Comparison, labels: Sequence[str]) -> TextTable:
    """One line per score."""
    from rgbt.tables import TextTable, number

    with_seeds = any(each.difference.both is not None for each in comparison.differences)
    level = f"{100 * comparison.level:g} %"
    over = [f"{level} over images"]
    over += [f"{level} over images and seeds"] if with_seeds else []
    rows = []
    for each in comparison.differences:
        difference = number(each.value) if each.value != each.value else f"{each.value:+.2f}"
        spreads = ["" if side.sd != side.sd else f" ± {side.sd:.2f}" for side in (each.a, each.b)]
        scores = [number(each.a.value) + spreads[0], number(each.b.value) + spreads[1]]
        intervals = [_shown(each.difference.images)]
        intervals += [_shown(each.difference.both)] if with_seeds else []
        ps = _p(each.difference.p), _p(each.p_corrected)
        rows.append((each.metric, *scores, difference, *intervals, *ps))
    singles = f"{comparison.images} single images"
    drawn = (
        singles if comparison.said == singles else f"{comparison.images} images, {comparison.said}"
    )
    title = f"{labels[1]} minus {labels[0]}: {drawn}, {comparison.partition}"
    header = ("", *labels, "difference", *over, "p", "p (Holm)")
    return TextTable(title, header, tuple(rows))


def absent_classes(every: Sequence[Counts], absent: Absent | None) -> tuple[str, ...]:
    """Footnotes about classes that are absent from the counts of both methods.

    Args:
        every: counts of both methods, of the same images.
        absent: convention of the table; None: that of the counts.
    """
    import numpy as np

    from rgbt.metrics.counts import convention
    from rgbt.metrics.details import details_of
    from rgbt.metrics.pairs import protocol_of
    from rgbt.metrics.scores import absent_notes

    first = every[0]
    if protocol_of(first.partition) is not None or details_of(first.partition) is not None:
        return ()  # matrices of pairs of frames and of boundaries have no labels as rows
    summed = np.sum([counts.by_region() for counts in every], axis=0)
    used = absent or convention(every)
    return absent_notes(summed, first.classes, first.scored, first.split, used)


def _opened(options: Options) -> list[tuple[NamedCounts, ...]]:
    """The trainings of both methods."""
    from analysis.results import groups_in, open_counts
    from analysis.robustness import under

    frames, corruption, severity = options.frames, options.corruption, options.severity
    if severity and not corruption:
        raise InputError("'severity' has no effect without corruption=..., for example noise.")
    if corruption and frames:
        raise InputError(f"corruption={corruption} applies to single frames; omit frames=.")
    opened = []
    for key, side in (("a", options.a), ("b", options.b)):
        if not side:
            groups = ", ".join(groups_in(options.runs_dir)) or "none"
            raise InputError(
                f"'{key}' has no value; give a run, a file of counts, or a group of runs. Groups "
                f"in {options.runs_dir}: {groups}."
            )
        found = open_counts(side, options.runs_dir, options.split, frames)
        opened.append(under(found, corruption, severity) if corruption else found)
    return opened


def _counts(
    opened: Sequence[tuple[NamedCounts, ...]], missing: str
) -> tuple[list[Counts], list[Counts]]:
    from analysis.uncertainty.same_images import common
    from rgbt.terminal import info

    methods = [[named.counts for named in each] for each in opened]
    shared = {each.path for each in opened[0]} & {each.path for each in opened[1]}
    if shared:
        raise InputError(f"a and b both contain {min(shared)}; give two different methods.")
    if missing == "leave_out":
        before = len({name for seeds in methods for counts in seeds for name in counts.names})
        methods = common(methods)
        left = before - len(methods[0][0].names)
        if left:
            info(f"{left} of {before} images are not in all counts and were excluded.")
    return methods[0], methods[1]


def _labels(opened: Sequence[tuple[NamedCounts, ...]]) -> list[str]:
    """Labels that differ: the names of the methods, with their seeds where these are equal."""
    from analysis.results import label_of

    plain = labels = [label_of(each) for each in opened]
    if plain[0] == plain[1]:
        seeds = [sorted(named.seed for named in each if named.seed is not None) for each in opened]
        labels = [f"{plain[0]} seed {', '.join(map(str, each))}" for each in seeds if each]
    return labels if len(set(labels)) == 2 else [f"a: {plain[0]}", f"b: {plain[1]}"]


def _shown(interval: Interval | None) -> str:
    return "-" if interval is None else f"{interval.low:+.2f} to {interval.high:+.2f}"


def _p(value: float) -> str:
    if value != value:
        return "-"
    return "<0.001" if value < 0.001 else f"{value:.3f}"


def comparison_csv(comparison: Comparison) -> str:
    """One line per score with all digits; empty where there is no value."""
    from rgbt.tables import csv_text

    ends = ("images_low", "images_high", "both_low", "both_high", "p", "p_holm")
    rows: list[tuple[object, ...]] = []
    rows.append(("metric", "a", "b", "seeds_a", "seeds_b", "difference", *ends))
    for each in comparison.differences:
        found = each.difference
        images = (found.images.low, found.images.high) if found.images else ("", "")
        both = (found.both.low, found.both.high) if found.both else ("", "")
        values = (*images, *both, found.p, each.p_corrected)
        row = (each.a.value, each.b.value, each.a.seeds, each.b.seeds, each.value, *values)
        rows.append((each.metric, *("" if value != value else value for value in row)))
    return csv_text(rows)


entry = PlainCommand(Options, main, heeds=())

if __name__ == "__main__":
    entry()
