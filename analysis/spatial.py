"""Command: statistics of a data set by region, and the claims of SpatialSeg about them.

rgbt spatial dataset=mfnet dataset.root=... split=train out=folder
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from annotated_types import Interval

from analysis.arguments import MOST, Level, check_out, dataset_of
from analysis.bar import progress
from rgbt.checks import InputError
from rgbt.config.command import built
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.metrics.metric import MAX_REGIONS

if TYPE_CHECKING:  # --help answers without waiting for torch and OpenCV
    from analysis.statistics.data import SpatialStatistics
    from analysis.statistics.judging import Claim
    from rgbt.metrics.metric import Regions
    from rgbt.tables import TextTable


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
    blocks: Annotated[
        int,
        Interval(ge=0, le=MOST),
        Help("number of neighbouring images that are resampled together"),
    ] = 10
    resamples: Annotated[
        int, Interval(ge=0, le=MOST), Help("number of resamples of the images")
    ] = 2000
    level: Level = 0.95
    seed: Annotated[int, Interval(ge=0, le=MOST), Help("seed of the resampling")] = 0
    workers: Annotated[int, Interval(ge=0, le=1024), Help("threads; 0: one per core")] = 0
    against: Annotated[
        Path | None,
        Help("statistics.npz of another data set; the last tables compare both"),
    ] = None
    out: Annotated[
        Path | None,
        Help(
            "output folder of statistics.npz (input of rgbt figures), regions.csv and "
            "statistics.md; without it, the tables are only printed"
        ),
    ] = None


def main(options: Options, overrides: list[str]) -> int:
    """Measure a data set by region and print its statistics.

    Overrides choose the data set, dataset=mfnet dataset.root=/data/MFNet or dataset=synth;
    data.on_error=skip leaves out files that cannot be read.

    All estimators and averages are measured; the last table shows what depends on them.
    """
    from rich.console import Group

    from analysis.statistics import tables
    from analysis.statistics.claims import check_resampling, claims
    from analysis.statistics.collect import MeasurementSettings, collect
    from analysis.statistics.comparison import Resampling, comparison_grids
    from analysis.statistics.data import SpatialStatistics
    from analysis.statistics.derive import no_background
    from rgbt.terminal import info, path_lines, print_rich, rich_table

    check_out(options.out)
    level, split = options.level, options.split
    check_resampling(options.blocks, options.resamples, level)
    reference = None if options.against is None else SpatialStatistics.load(options.against)
    settings = MeasurementSettings(
        regions=_regions(options),
        kernel=options.kernel,
        short_edge=options.short_edge,
        workers=options.workers,
        skip_unreadable=built("data", overrides).on_error == "skip",
    )
    dataset = dataset_of(overrides)
    left_out: list[str] = []
    with progress("measuring", len(dataset.names(split))) as advance:
        stats = collect(dataset, split, settings, advance, left_out.append)
    if not stats.background:
        info(no_background(stats))
    for sentence in sorted(left_out):
        info(f"left out: {sentence}")
    resampling = Resampling(level, options.blocks, options.resamples, options.seed)
    found = claims(stats, **resampling._asdict())
    # Of the claims about noise those of the chosen estimator and average.
    way = options.estimator, options.average
    shown = [claim for claim in found if not claim.estimator or _way(claim) == way]
    grids = [
        *tables.occupancy_grids(stats),
        *tables.image_grids(stats, *way),
        tables.entropy_grid(stats),
        tables.claims_grid(shown, level),
        tables.estimator_grid(found),
    ]
    compared = []
    if reference is not None:
        compared = list(comparison_grids(stats, reference, way, resampling))
        grids += compared
    print_rich(Group(tables.heading(stats), *map(rich_table, grids)))
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        print_rich(path_lines(_write(stats, found, compared, options)))
    return 0


def _regions(options: Options) -> Regions:
    from rgbt.metrics.metric import Regions

    partition, aspect = options.partition, options.aspect
    if partition != "ring" and aspect != "image":
        raise InputError(f"aspect={aspect} applies to rings; omit it for {partition} strips.")
    return Regions(
        partition=partition,
        regions=options.regions,
        aspect=aspect if partition == "ring" else None,
        absent="released",
    )


def _write(
    stats: SpatialStatistics,
    found: tuple[Claim, ...],
    compared: Sequence[TextTable],
    options: Options,
) -> list[tuple[str, str]]:
    """The files of the output folder, as (what, path)."""
    from analysis.statistics import tables
    from rgbt.files.atomic import write_atomic

    folder = options.out
    assert folder is not None
    # The chosen way first, the others in the order of the claims.
    every = dict.fromkeys([(options.estimator, options.average), *map(_way, found)])
    ways = [way for way in every if way[0]]
    stats.save(folder / "statistics.npz")
    write_atomic(folder / "regions.csv", tables.to_csv(stats).encode())
    text = tables.markdown(stats, found, ways, options.level)
    text = "\n".join([text, *(grid.to_markdown() for grid in compared)])
    write_atomic(folder / "statistics.md", text.encode())
    kinds = (("measurements", "statistics.npz"), ("values", "regions.csv"))
    return [(kind, str(folder / file)) for kind, file in (*kinds, ("tables", "statistics.md"))]


def _way(claim: Claim) -> tuple[str, str]:
    return claim.estimator, claim.average


entry = PlainCommand(Options, main, heeds=("dataset", "data.on_error"))

if __name__ == "__main__":
    entry()
