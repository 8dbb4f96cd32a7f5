"""Command: statistics of a data set by region, and the statements of SpatialSeg about them.

rgbt spatial dataset=mfnet dataset.root=... split=train out=folder
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Interval

from analysis.arguments import MOST, Blocks, Level, Resamples, check_out, dataset_of
from analysis.bar import progress
from rgbt.config.command import built
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.metrics.metric import MAX_REGIONS


@dataclass(frozen=True)
class Options:
    """Options of ``rgbt spatial``."""

    split: Annotated[str, Help("split whose images are measured")] = "train"
    partition: Annotated[
        Literal["ring", "vertical", "horizontal"], Help("partition of the images")
    ] = "ring"
    regions: Annotated[
        int, Interval(ge=1, le=MAX_REGIONS), Help("number of regions of equal area")
    ] = 9
    aspect: Annotated[
        Literal["image", "released_3_4"],
        Help("aspect ratio of rings: image, or released_3_4: 3:4, as released"),
    ] = "image"
    kernel: Annotated[
        Literal["four", "eight"], Help("neighbours in the kernel of the Laplacian: four or eight")
    ] = "four"
    short_edge: Annotated[
        int,
        Interval(ge=0, le=10_000),
        Help("resize images to this shorter edge, pixels; 0: measure them as they are"),
    ] = 0
    estimator: Annotated[
        Literal["immerkaer", "wavelet_mad", "std"], Help("estimator of the noise in the tables")
    ] = "immerkaer"
    average: Annotated[
        Literal["pooled", "images"],
        Help(
            "signal-to-noise ratio over images: pooled (mean signal over mean noise) or images "
            "(mean of the ratios of all images)"
        ),
    ] = "pooled"
    blocks: Blocks = "auto"
    resamples: Resamples = 2000
    level: Level = 0.95
    seed: Annotated[int, Interval(ge=0, le=MOST), Help("seed of the resampling")] = 0
    out: Annotated[
        Path | None,
        Help(
            "output folder of statistics.npz (input of rgbt figures), regions.csv, statements.csv "
            "and statistics.md; without it, the tables are only printed"
        ),
    ] = None


def main(options: Options, overrides: list[str]) -> int:
    """Measure a data set by region and print its statistics.

    Overrides choose the data set, dataset=mfnet dataset.root=/data/MFNet or dataset=synth;
    data.on_error=skip leaves out files that cannot be read.

    All estimators and averages are measured; the last table shows what depends on them.
    """
    from rich.console import Group

    from analysis.statistics import sample as samples
    from analysis.statistics import tables
    from analysis.statistics.collect import MeasurementSettings, collect
    from analysis.statistics.statements import judged
    from analysis.tables import tidy_csv
    from analysis.uncertainty import Resampling
    from rgbt.files.atomic import write_atomic
    from rgbt.metrics.metric import Regions
    from rgbt.terminal import path_lines, plain_text, print_rich, rich_table

    out, way = options.out, (options.estimator, options.average)
    check_out(out)
    drawn = Resampling(
        resamples=options.resamples, level=options.level, blocks=options.blocks, seed=options.seed
    )
    settings = MeasurementSettings(
        regions=Regions(
            partition=options.partition,
            regions=options.regions,
            aspect=options.aspect if options.partition == "ring" else None,
            absent="released",
        ),
        kernel=options.kernel,
        short_edge=options.short_edge,
        skip_unreadable=built("data", overrides).on_error == "skip",
    )
    dataset, left_out = dataset_of(overrides), set[str]()
    with progress("measuring", len(dataset.names(options.split))) as advance:
        stats = collect(dataset, options.split, settings, advance, left_out.add)
    remarks = [f"left out: {sentence}" for sentence in sorted(left_out)]
    remarks += [] if stats.background else [samples.no_background(stats)]
    sample = samples.Sample(stats, drawn, way)
    frame, found = samples.quantities(stats), judged(sample)
    # Of the statements about noise those of the chosen estimator and average.
    is_shown = (found["estimator"] == "") | (found[["estimator", "average"]] == way).all(axis=1)
    after = [tables.statement_table(found[is_shown], options.level), tables.estimator_table(found)]
    heading = f"{tables.heading(stats)}; intervals over {sample.blocks.said}"
    shown = [*tables.region_tables(frame, stats, way), *after]
    print_rich(Group(plain_text("\n".join([heading, *remarks])), *map(rich_table, shown)))
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        every = [*tables.region_tables(frame, stats), *after]
        lines = [f"# {heading}", "", *remarks, *(each.to_markdown() for each in every)]
        stats.save(out / "statistics.npz")
        write_atomic(out / "regions.csv", tidy_csv(frame).encode())
        write_atomic(out / "statements.csv", tidy_csv(found).encode())
        write_atomic(out / "statistics.md", "\n".join(lines).encode())
        print_rich(path_lines([("statistics", f"{out}/")]))
    return 0


entry = PlainCommand(Options, main, heeds=("dataset", "data.on_error"))

if __name__ == "__main__":
    entry()
