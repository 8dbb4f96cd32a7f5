"""Command: statistics of a data set by region, and the statements of SpatialSeg about them.

rgbt spatial dataset=mfnet dataset.root=... split=train out=folder
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Interval

from analysis.commands import (
    DrawOptions,
    Regions,
    Resamples,
    check_out,
    dataset_of,
    write_files,
)
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand


@dataclass(frozen=True, kw_only=True)
class SpatialOptions(DrawOptions):
    """Options of ``rgbt spatial``."""

    split: Annotated[str, Help("split whose images are measured")] = "train"
    partition: Annotated[
        Literal["ring", "vertical", "horizontal"], Help("partition of the images")
    ] = "ring"
    regions: Regions = 5
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
    resamples: Resamples = 2000
    out: Annotated[
        Path | None,
        Help(
            "output folder of statistics.npz (input of rgbt figures), regions.csv, statements.csv "
            "and statistics.md; without it, the tables are only printed"
        ),
    ] = None


def main(options: SpatialOptions, overrides: list[str]) -> int:
    """Measure a data set by region and print its statistics.

    Overrides choose the data set: dataset=mfnet dataset.root=/data/MFNet, or dataset=synth.

    All estimators and averages are measured; the last table shows what depends on them.
    """
    from rich.console import Group

    from analysis.statistics import tables
    from analysis.statistics.collect import collect
    from analysis.statistics.resampled import ResampledSplit, no_background, quantities
    from analysis.statistics.statements import judged
    from rgbt.metrics import metric
    from rgbt.terminal import counting, plain_text, print_rich, rich_table

    out, way = options.out, (options.estimator, options.average)
    check_out(out)
    settings = options.settings()
    regions = metric.Regions(
        partition=options.partition,
        regions=options.regions,
        aspect=options.aspect if options.partition == "ring" else None,
        absent="released",
    )
    dataset = dataset_of(overrides)
    with counting("measuring", len(dataset.names(options.split))) as advance:
        stats = collect(
            dataset,
            options.split,
            regions,
            kernel=options.kernel,
            short_edge=options.short_edge,
            advance=advance,
        )
    remarks = [] if stats.background else [no_background(stats)]
    sample = ResampledSplit(stats, settings, way)
    frame, found = quantities(stats), judged(sample)
    # Statements about noise are shown for the chosen estimator and average only.
    is_shown = (found["estimator"] == "") | (found["estimator"] + found["average"] == "".join(way))
    after = [tables.statement_table(found[is_shown], options.level), tables.estimator_table(found)]
    heading = f"{tables.heading(stats)}; intervals over {sample.blocks.said}"
    shown = [*tables.region_tables(frame, stats, way), *after]
    print_rich(Group(plain_text("\n".join([heading, *remarks])), *map(rich_table, shown)))
    if out is not None:
        every = [*tables.region_tables(frame, stats), *after]
        lines = [f"# {heading}", "", *remarks, *(table.to_markdown() for table in every)]
        texts = {"statistics.md": "\n".join(lines)}
        write_files(out, {**texts, "regions.csv": frame, "statements.csv": found})
        stats.save(out / "statistics.npz")
    return 0


entry = PlainCommand(SpatialOptions, main, heeds=("dataset",))

if __name__ == "__main__":
    entry()
