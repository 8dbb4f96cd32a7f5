"""Results by region of any method: ``rgbt score predictions=folder dataset=...``.

From a folder of predicted label images, or from the counts that a run has stored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

from annotated_types import Interval

from analysis.arguments import MOST, Blocks, Level, check_out, dataset_of
from analysis.bar import progress
from rgbt.checks import InputError
from rgbt.config.command import built
from rgbt.config.common_options import PredictionFormatOptions
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.metrics.metric import MAX_REGIONS, Partition
from rgbt.metrics.names import DAY, MIOU, NIGHT, subset

if TYPE_CHECKING:
    from analysis.predictions.scoring import FolderScores
    from analysis.predictions.table import ScoreKey, ScoreTable
    from analysis.uncertainty import Resampling
    from rgbt.metrics.counts import Counts

OF_A_FOLDER = (
    *("partition", "regions", "format", "palette", "missing", "resize", "prefix", "suffix"),
    *("name", "threads"),
)
"""Options of how a folder is counted; they have no effect on counts of runs."""

MAX_THREADS = 256
SOURCE = "source.txt"
"""File in a folder of scores that records what was scored."""

PARTITION_NAMES = get_args(Partition)

OF_PARTS = {"all": MIOU, **{part: subset(part, MIOU) for part in (DAY, NIGHT)}}
"""Part of the images -> its mIoU."""


@dataclass(frozen=True)
class Options(PredictionFormatOptions):
    """Options of ``rgbt score``."""

    predictions: Annotated[
        str,
        Help(
            "folder of predictions, with a PNG file for every image of the split: class indices "
            "(8 bit, one channel) or, with format=colour, the colours of a palette"
        ),
    ] = ""
    counts: Annotated[
        str,
        Help(
            "instead of predictions: counts of runs, as run folder, config key, MLflow run id, "
            "file, or a list of these with commas"
        ),
    ] = ""
    split: Annotated[str, Help("split of the data set; default: test")] = ""
    out: Annotated[
        Path | None,
        Help(
            "output folder of counts_<partition>.npz, maps.npz, scores.md and scores.csv; without "
            "it, the tables are only printed"
        ),
    ] = None
    runs_dir: Annotated[Path, Help("folder of runs for counts=...")] = Path("runs")
    resamples: Annotated[
        int,
        Interval(ge=0, le=MOST),
        Help("number of resamples for the intervals over images; 0: no intervals"),
    ] = 10_000
    level: Level = 0.95
    blocks: Blocks = "auto"
    partition: Annotated[
        Literal["all", "ring", "vertical", "horizontal"],
        Help("partition of the images (predictions only)"),
    ] = "all"
    regions: Annotated[
        int,
        Interval(ge=1, le=MAX_REGIONS),
        Help("number of regions of equal area (predictions only)"),
    ] = 5
    missing: Annotated[
        Literal["refuse", "leave_out"],
        Help("images without a prediction: refuse, or leave_out: exclude them"),
    ] = "refuse"
    resize: Annotated[
        Literal["refuse", "nearest", "stretch"],
        Help(
            "predictions of another size than their label: refuse; nearest: resize them by the "
            "nearest pixel; stretch: so too where the ratio of height and width differs"
        ),
    ] = "refuse"
    name: Annotated[
        str, Help("name of the method in tables; default: name of the folder of predictions")
    ] = ""
    threads: Annotated[
        int,
        Interval(ge=0, le=MAX_THREADS),
        Help("threads that read and count predictions; 0: one per core"),
    ] = 0

    @property
    def source(self) -> str:
        """What is scored, as the folder records it."""
        if self.counts:
            return f"counts={self.counts}"
        folder = Path(self.predictions).resolve()
        return f"predictions={folder} split={self.split or 'test'}"


def main(options: Options, overrides: list[str]) -> int:
    """Score predictions of any method by region, class, day and night, with intervals.

    Overrides choose the data set: dataset=mfnet dataset.root=/data/MFNet
    """
    from analysis.predictions.text import remarks_on
    from analysis.uncertainty import Resampling
    from rgbt.files.atomic import write_atomic

    given = [key for key in ("predictions", "counts") if getattr(options, key)]
    if len(given) != 1:
        raise InputError(
            "expected one of predictions=folder and counts=run, got "
            f"{' and '.join(given) or 'neither'}."
        )
    out = options.out
    check_out(out)
    _check_same_source(out, options.source)
    settings = None
    if options.resamples:
        settings = Resampling(
            resamples=options.resamples, level=options.level, blocks=options.blocks
        )
    if given == ["counts"]:
        counted, remarks = _score_counts(options, overrides), []
    else:
        scored = _scored(options, overrides)
        counted = [(scored.name, counts) for counts in scored.counts]
        remarks = remarks_on(scored)
        if out is not None:
            write_counts(scored, out)
    _show(score_tables(counted, settings), remarks, out)
    if out is not None:
        write_atomic(out / SOURCE, f"{options.source}\n".encode())
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


def write_counts(scored: FolderScores, out: Path) -> None:
    """Write ``counts_<partition>.npz`` of each partition, and ``maps.npz`` where there is one."""
    from rgbt.terminal import info

    out.mkdir(parents=True, exist_ok=True)
    # The predictions may be other ones than at the last time: earlier counts and maps would pass
    # for ones of these.
    earlier = [path for each in PARTITION_NAMES for path in out.glob(f"counts_{each}*.npz")]
    new = {f"counts_{counts.partition}.npz" for counts in scored.counts}
    gone = sorted(path.name for path in earlier if path.name not in new)
    if gone:
        info(f"removed from {out}, because counted by an earlier call: {', '.join(gone)}.")
    for path in (*earlier, out / "maps.npz"):
        path.unlink(missing_ok=True)
    for counts in scored.counts:
        counts.save(out / f"counts_{counts.partition}.npz")
    if scored.maps is not None:
        scored.maps.save(out / "maps.npz")


def _check_same_source(out: Path | None, source: str) -> None:
    """Refuse a folder with other scores, because files of both would be mixed."""
    if out is None or not (out / "scores.csv").is_file():
        return
    noted = out / SOURCE
    earlier = noted.read_text(errors="replace").strip() if noted.is_file() else "another call"
    if earlier != source:
        raise InputError(f"out={out} holds the scores of {earlier}; give {source} its own folder.")


def _show(tables: Sequence[ScoreTable], remarks: list[str], out: Path | None) -> None:
    """Write the tables as Markdown and CSV where a folder is given, and print them."""
    from rich.console import Group
    from rich.text import Text

    from analysis.predictions.text import convention_line, grids, markdown, tidy_csv
    from rgbt.files.atomic import write_atomic
    from rgbt.terminal import path_lines, print_rich, rich_table

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
        print_rich(Group(*map(rich_table, grids(table)), Text(f"{said}\n")))
    if remarks:
        print_rich(Text("\n".join(remarks)))
    if places:
        print_rich(path_lines(places))


def _scored(options: Options, overrides: list[str]) -> FolderScores:
    from analysis.predictions.scoring import PARTITIONS, ScoringOptions, score_folder
    from rgbt.data.predictions import Affixes, FormatOptions

    dataset, absent = dataset_of(overrides), built("metric", overrides).absent
    counting = ScoringOptions(
        partitions=tuple(each for each in PARTITIONS if options.partition in ("all", each)),
        regions=options.regions,
        format=FormatOptions(
            form=options.format,
            palette=options.palette,
            affixes=Affixes(options.prefix, options.suffix),
        ),
        missing=options.missing,
        resize=options.resize,
        name=options.name,
        threads=options.threads,
        absent=absent,
    )
    folder, split = Path(options.predictions), options.split or "test"
    with progress("counting", len(dataset.names(split))) as advance:
        return score_folder(folder, dataset, split, counting, advance)


def _score_counts(options: Options, overrides: list[str]) -> list[tuple[str, Counts]]:
    from analysis.results import open_counts
    from rgbt.terminal import info

    default = Options()
    without_effect = [key for key in OF_A_FOLDER if getattr(options, key) != getattr(default, key)]
    without_effect += [word.partition("=")[0] for word in overrides]
    if without_effect:
        raise InputError(
            f"'{without_effect[0]}' has no effect on stored counts; omit it, or give a "
            "folder with predictions=..."
        )
    found = open_counts(options.counts, options.runs_dir, options.split)
    info(
        "stored counts have one partition and no map by pixel; for others, write predictions "
        "with rgbt predict run=... input=<split> out=folder, and score that folder."
    )
    labels = [each.label for each in found]
    named = []
    for each in found:
        label = each.label
        if labels.count(label) > 1:
            label = str(each.path) if each.seed is None else f"{label} seed {each.seed}"
        named.append((label, each.counts))
    return named


def _with_intervals(table: ScoreTable, counts: Counts, settings: Resampling) -> ScoreTable:
    """The table with intervals over images, under the conventions that it shows."""
    from analysis.predictions.table import interval_cells, with_intervals
    from analysis.uncertainty import estimate

    found: dict[ScoreKey, tuple[float, float]] = {}
    drawn: dict[str, str] = {}
    reason = ""
    for absent, part in product(table.conventions(), table.num_images):
        named = interval_cells(table, absent)[part]
        estimates = estimate([counts], list(named), replace(settings, absent=absent))
        for metric, each in estimates.items():
            if each.images is not None:
                found[named[metric]] = (each.images.low, each.images.high)
        main = estimates[OF_PARTS[part]]
        drawn[part] = f"of {main.said}" if main.images else f"has none ({main.said} are too few)"
        reason = main.reason if part == "all" else reason
    whole_split = drawn.pop("all")
    if not found:
        return replace(
            table, intervals=f"{table.partition}: no intervals, too few images: {whole_split}."
        )
    parts = "".join(f"; {part} {said}" for part, said in drawn.items())
    said = (
        f"{table.partition}: in brackets, {100 * settings.level:g} % intervals over images "
        f"(Student, of Var without its bias; {settings.resamples} resamples "
        f"{whole_split}{parts}). {reason}".rstrip()
    )
    return with_intervals(table, found, said)


entry = PlainCommand(Options, main, heeds=("dataset",))

if __name__ == "__main__":
    entry()
