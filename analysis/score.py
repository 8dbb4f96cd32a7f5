"""Results by region of any method: ``python -m analysis.score predictions=folder dataset=...``.

From a folder of predicted label images, or from the counts that a run has stored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, get_args

from analysis.arguments import (
    MOST,
    blocks_of,
    dataset_of,
    decimal,
    out_folder,
    refuse_others,
    whole,
)
from analysis.bar import progress
from rgbt.checks import InputError, check_choice
from rgbt.config.command import built, plain_command
from rgbt.metrics.names import DAY, MIOU, NIGHT, subset
from rgbt.metrics.regions import MAX_REGIONS, Partition

if TYPE_CHECKING:
    from analysis.predictions.scoring import Options, Scored
    from analysis.predictions.table import Cell, ScoreTable
    from analysis.results import NamedCounts
    from analysis.uncertainty import Resampling
    from rgbt.metrics.counts import Counts

OF_A_FOLDER = {
    "partition": "all",
    "regions": "5",
    "format": "auto",
    "missing": "refuse",
    "resize": "refuse",
    "suffix": "",
    "name": "",
    "threads": "0",
}
"""Keys that say how a folder is counted; stored counts have been counted already."""

OWN = {
    "predictions": "",
    "counts": "",
    "split": "",
    "out": "",
    "runs_dir": "runs",
    "resamples": "10000",
    "level": "0.95",
    "blocks": "auto",
    **OF_A_FOLDER,
}
MAX_THREADS = 256
SOURCE = "source.txt"
"""File of a folder of scores that says what was scored."""

PARTITION_NAMES = get_args(Partition)

OF_PARTS = {"all": MIOU, **{part: subset(part, MIOU) for part in (DAY, NIGHT)}}
"""Part of the images -> its mIoU."""


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Score predictions of any method by region, class, day and night, with intervals.

    predictions  folder with NAME.png for every image of the split: class indices (8 bit, one
                 channel), a palette PNG, or RGB in the colours of dataset.palette
    counts       instead: counts of runs; run folder, config key, MLflow run id, file, or several
                 with commas
    split        split of the data set; default: test
    out          folder for counts_<partition>.npz, maps.npz, scores.md and scores.csv; without
                 one, the tables are shown only
    runs_dir     folder of runs, for counts=
    resamples    of the intervals over images; 0: no intervals
    level        share of intervals that shall hold the true value
    blocks       what is drawn together: auto, none, sequence, or a number of neighbouring images
    For predictions=:
    partition    all, ring, vertical or horizontal
    regions      number of regions of equal area
    format       auto; index: the stored numbers; colour: the colours shown
    missing      refuse, or leave_out: count only the images that have a file
    resize       refuse, or nearest: predictions of another size than their label
    suffix       of the names: NAME<suffix>.png, e.g. _pred
    name         of the method, for tables; default: the folder's name
    threads      that read and count; 0: one per core
    overrides of the data set, such as dataset=mfnet dataset.root=/data/MFNet
    """
    from analysis.predictions.text import remarks_on
    from rgbt.files.atomic import write_atomic

    given = [key for key in ("predictions", "counts") if arguments[key]]
    if len(given) != 1:
        raise InputError(
            "expected one of predictions=folder and counts=run, got "
            f"{' and '.join(given) or 'neither'}."
        )
    out = out_folder(arguments["out"])
    _check_same_source(out, _source_of(arguments))
    settings = _resampling(arguments)
    if given == ["counts"]:
        counted, remarks = _stored(arguments, overrides), []
    else:
        scored = _scored(arguments, overrides)
        counted = [(scored.name, counts) for counts in scored.counts]
        remarks = remarks_on(scored)
        if out is not None:
            write_counts(scored, out)
    tables = score_tables(counted, settings)
    _show(tables, remarks, out)
    if out is not None:
        write_atomic(out / SOURCE, f"{_source_of(arguments)}\n".encode())
    return 0


def score_tables(
    counted: Sequence[tuple[str, Counts]], settings: Resampling | None
) -> list[ScoreTable]:
    """The scores of each file of counts, with intervals over images.

    Args:
        counted: (name of the method, counts) in the order of the tables.
        settings: of the intervals, the convention for absent classes aside; None for none.

    Raises:
        InputError: blocks that cannot be made of these images.
    """
    from analysis.predictions.table import score_table

    tables = [score_table(counts, name) for name, counts in counted]
    if settings is None:
        return tables
    with progress("resampling", len(tables)) as advance:
        for index, (_, counts) in enumerate(counted):
            tables[index] = _with_intervals(tables[index], counts, settings)
            advance()
    return tables


def write_counts(scored: Scored, out: Path) -> None:
    """Write ``counts_<partition>.npz`` of each partition, and ``maps.npz`` where there is one."""
    from rgbt.tracking.terminal import tell

    out.mkdir(parents=True, exist_ok=True)
    # The predictions may be other ones than at the last time: earlier counts and maps would pass
    # for ones of these.
    earlier = [path for each in PARTITION_NAMES for path in out.glob(f"counts_{each}*.npz")]
    new = {f"counts_{counts.partition}.npz" for counts in scored.counts}
    gone = sorted(path.name for path in earlier if path.name not in new)
    if gone:
        tell(f"removed from {out}, because counted by an earlier call: {', '.join(gone)}.")
    for path in (*earlier, out / "maps.npz"):
        path.unlink(missing_ok=True)
    for counts in scored.counts:
        counts.save(out / f"counts_{counts.partition}.npz")
    if scored.maps is not None:
        scored.maps.save(out / "maps.npz")


def _check_same_source(out: Path | None, source: str) -> None:
    """Refuse a folder with other scores: files of both would stand side by side."""
    if out is None or not (out / "scores.csv").is_file():
        return
    noted = out / SOURCE
    earlier = noted.read_text(errors="replace").strip() if noted.is_file() else "another call"
    if earlier != source:
        raise InputError(f"out={out} holds the scores of {earlier}; give {source} its own folder.")


def _source_of(arguments: dict[str, str]) -> str:
    """What is scored, as it is noted in the folder."""
    if arguments["counts"]:
        return f"counts={arguments['counts']}"
    folder = Path(arguments["predictions"]).resolve()
    return f"predictions={folder} split={arguments['split'] or 'test'}"


def _show(tables: Sequence[ScoreTable], remarks: list[str], out: Path | None) -> None:
    """Write the tables as Markdown and CSV where a folder is given, and print them."""
    from rich.console import Group
    from rich.text import Text

    from analysis.predictions.text import convention_line, grids, markdown, tidy_csv
    from rgbt.files.atomic import write_atomic
    from rgbt.tracking.terminal import place_lines, rich_table, show

    places = []
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        title = "Scores of " + ", ".join(dict.fromkeys(table.name for table in tables))
        write_atomic(out / "scores.md", markdown(title, tables, remarks).encode())
        write_atomic(out / "scores.csv", tidy_csv(tables).encode())
        counts = sorted(path.name for path in (*out.glob("counts_*.npz"), *out.glob("maps.npz")))
        places = [("tables", str(out / "scores.md")), ("tidy", str(out / "scores.csv"))]
        places += [("counts", f"{out}/ ({', '.join(counts)})")] if counts else []
    for table in tables:
        said = "\n".join(filter(None, (convention_line(table), table.intervals)))
        show(Group(*map(rich_table, grids(table)), Text(f"{said}\n")))
    if remarks:
        show(Text("\n".join(remarks)))
    if places:
        show(place_lines(places))


def _scored(arguments: dict[str, str], overrides: list[str]) -> Scored:
    from analysis.predictions.scoring import score_folder

    refuse_others(overrides, ("dataset",), list(OWN))
    dataset, absent = dataset_of(overrides), built("metric", overrides).absent
    options = replace(_options(arguments), absent=absent)
    folder, split = Path(arguments["predictions"]), arguments["split"] or "test"
    with progress("counting", len(dataset.names(split))) as advance:
        return score_folder(folder, dataset, split, options, advance)


def _options(arguments: dict[str, str]) -> Options:
    from analysis.predictions.scoring import PARTITIONS, Options

    partition = arguments["partition"]
    check_choice("partition", partition, ("all", *PARTITIONS))
    words: dict[str, Any] = {key: arguments[key] for key in ("missing", "resize", "suffix", "name")}
    return Options(
        partitions=tuple(each for each in PARTITIONS if partition in ("all", each)),
        regions=whole("regions", arguments["regions"], 1, MAX_REGIONS),
        form=cast(Any, arguments["format"]),  # Options refuses other words
        threads=whole("threads", arguments["threads"], 0, MAX_THREADS),
        **words,
    )


def _stored(arguments: dict[str, str], overrides: list[str]) -> list[tuple[str, Counts]]:
    from analysis.results import open_counts
    from rgbt.tracking.terminal import tell

    without_effect = [key for key, default in OF_A_FOLDER.items() if arguments[key] != default]
    without_effect += [word.partition("=")[0] for word in overrides]
    if without_effect:
        raise InputError(
            f"'{without_effect[0]}' has no effect on stored counts, which are counted already; "
            "leave it out, or give a folder with predictions=..."
        )
    found = open_counts(arguments["counts"], Path(arguments["runs_dir"]), arguments["split"])
    tell(
        "stored counts hold one partition and no map by pixel; for the others write predictions "
        "with python -m rgbt.predict run=... input=<split> out=folder, and score that folder."
    )
    labels = [each.label for each in found]
    return [
        (each.label if labels.count(each.label) == 1 else _distinct_label(each), each.counts)
        for each in found
    ]


def _distinct_label(named: NamedCounts) -> str:
    """A label of its own for one of several of one name."""
    return str(named.path) if named.seed is None else f"{named.label} seed {named.seed}"


def _resampling(arguments: dict[str, str]) -> Resampling | None:
    from analysis.uncertainty import Resampling

    resamples = whole("resamples", arguments["resamples"], 0, MOST)
    if resamples == 0:
        return None
    level = decimal("level", arguments["level"], "0.95")
    return Resampling(resamples=resamples, level=level, blocks=blocks_of(arguments["blocks"]))


def _with_intervals(table: ScoreTable, counts: Counts, settings: Resampling) -> ScoreTable:
    """The table with intervals over images, under the conventions that it shows."""
    from analysis.predictions.table import interval_cells, with_intervals
    from analysis.uncertainty import estimate

    found: dict[Cell, tuple[float, float]] = {}
    drawn: dict[str, str] = {}
    reason = ""
    for absent, part in product(table.conventions(), table.num_images):
        named = interval_cells(table, absent)[part]
        try:
            estimates = estimate([counts], list(named), replace(settings, absent=absent))
        except InputError as error:
            if part == "all":
                raise
            drawn[part] = f"has none ({error})"  # a part that is too small stops nothing else
            continue
        for metric, each in estimates.items():
            if each.images is not None:
                found[named[metric]] = (each.images.low, each.images.high)
        drawn[part] = f"of {estimates[OF_PARTS[part]].said}"
        reason = estimates[OF_PARTS[part]].reason if part == "all" else reason
    whole_split = drawn.pop("all")
    if not found:
        return replace(
            table, intervals=f"{table.partition}: no intervals, too few images: {whole_split}."
        )
    parts = "".join(f"; {part} {said}" for part, said in drawn.items())
    said = (
        f"{table.partition}: in brackets, {100 * settings.level:g} % intervals over images "
        f"(percentile, of Var without its bias; {settings.resamples} resamples "
        f"{whole_split}{parts}). {reason}".rstrip()
    )
    return with_intervals(table, found, said)


if __name__ == "__main__":
    plain_command(OWN, main)()
