"""Command: what a data set looks like by region, and which claims of SpatialSeg hold on it.

python -m analysis.spatial dataset=mfnet dataset.root=... split=train out=folder
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from analysis.arguments import MOST, dataset_of, decimal, out_folder, refuse_others, whole
from analysis.bar import progress
from rgbt.checks import InputError, check_choice
from rgbt.config.command import built, plain_command

if TYPE_CHECKING:  # --help answers without waiting for torch and OpenCV
    from analysis.statistics.collect import DataSet, Settings
    from analysis.statistics.data import SpatialStatistics
    from analysis.statistics.judging import Claim
    from rgbt.metrics.metric import Regions

OWN: dict[str, str | None] = {
    "split": "train",
    "partition": "ring",
    "regions": "9",
    "aspect": "image",
    "kernel": "four",
    "estimator": "immerkaer",
    "average": "pooled",
    "blocks": "10",
    "resamples": "2000",
    "level": "0.95",
    "seed": "0",
    "workers": "0",
    "out": "",
}
OVERRIDES = ("dataset", "data.on_error")
"""What of the configuration counts here; another key is refused."""


def main(values: dict[str, str], overrides: list[str]) -> None:
    """Measure a data set by region and print what it shows.

    python -m analysis.spatial dataset=mfnet dataset.root=/data/MFNet split=train out=folder

    dataset=synth or mfnet, dataset.*=...   as in python -m rgbt.run; data.on_error=skip leaves out
                        files that cannot be read
    split               whose images
    partition, regions  ring, vertical or horizontal; 1 to 255 regions of equal area
    aspect              of rings: image or released_3_4
    kernel              of the Laplacian: four (default) or eight neighbours
    estimator           of the noise in the tables: immerkaer (default), wavelet_mad, std
    average             of signal to noise over images: pooled (mean signal over mean noise, the
                        default) or images (mean of each image's ratio)
    blocks              neighbouring images that are resampled together
    resamples, level, seed  of the intervals
    workers             threads; 0: one per core
    out                 folder for statistics.npz (what analysis.figures draws), regions.csv and
                        statistics.md; without one, the tables are shown only

    All estimators and averages are measured; the last table shows what depends on them.
    """
    from analysis.statistics.claims import check_resampling, claims
    from rgbt.tracking.terminal import place_lines, show

    _check_words(values)
    out = out_folder(values["out"])
    numbers = {key: whole(key, values[key], 0, MOST) for key in ("blocks", "resamples", "seed")}
    level = decimal("level", values["level"], "0.95")
    check_resampling(numbers["blocks"], numbers["resamples"], level)
    settings, dataset = _settings(values, overrides)
    dataset.names(values["split"])  # a split that is not there is told before anything is read
    stats = _collect(dataset, values["split"], settings)
    found = claims(stats, level=level, **numbers)
    _print(stats, found, (values["estimator"], values["average"]), level)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        show(place_lines(_write(stats, found, values, out)))


def _check_words(values: dict[str, str]) -> None:
    """Refuse what cannot be understood before anything is read."""
    from analysis.statistics.derive import AVERAGES
    from analysis.statistics.measure import ESTIMATORS, KERNELS

    check_choice("partition", values["partition"], ("ring", "vertical", "horizontal"))
    check_choice("aspect", values["aspect"], ("image", "released_3_4"))
    check_choice("kernel", values["kernel"], KERNELS)
    check_choice("estimator", values["estimator"], ESTIMATORS)
    check_choice("average", values["average"], AVERAGES)


def _settings(values: dict[str, str], overrides: list[str]) -> tuple[Settings, DataSet]:
    from analysis.statistics.collect import Settings

    refuse_others(overrides, OVERRIDES, list(OWN))
    settings = Settings(
        regions=_regions(values),
        kernel=values["kernel"],
        workers=whole("workers", values["workers"], 0, 1024),
        skip_unreadable=built("data", overrides).on_error == "skip",
    )
    return settings, dataset_of(overrides)


def _regions(values: dict[str, str]) -> Regions:
    from rgbt.metrics.metric import Regions
    from rgbt.metrics.regions import MAX_REGIONS

    partition, aspect = values["partition"], values["aspect"]
    if partition != "ring" and aspect != "image":
        raise InputError(f"aspect={aspect} is one of rings; leave it out with {partition} strips.")
    regions = whole("regions", values["regions"], 1, MAX_REGIONS)
    return Regions(
        partition=partition,  # type: ignore[arg-type]  # checked in `_check_words`
        regions=regions,
        aspect=aspect if partition == "ring" else None,  # type: ignore[arg-type]  # as above
        absent="released",
    )


def _collect(dataset: DataSet, split: str, settings: Settings) -> SpatialStatistics:
    from analysis.statistics.collect import collect
    from rgbt.tracking.terminal import tell

    left_out: list[str] = []
    with progress("measuring", len(dataset.names(split))) as advance:
        stats = collect(dataset, split, settings, advance, left_out.append)
    for sentence in sorted(left_out):
        tell(f"left out: {sentence}")
    return stats


def _print(
    stats: SpatialStatistics, found: tuple[Claim, ...], way: tuple[str, str], level: float
) -> None:
    """Tables on stdout; of the claims about noise those of the chosen estimator and average."""
    from rich.console import Group

    from analysis.statistics import tables
    from rgbt.tracking.terminal import rich_table, show

    shown = [claim for claim in found if not claim.estimator or _way(claim) == way]
    grids = [
        *tables.occupancy_grids(stats),
        *tables.image_grids(stats, *way),
        tables.entropy_grid(stats),
        tables.claims_grid(shown, level),
        tables.estimator_grid(found),
    ]
    show(Group(tables.heading(stats), *map(rich_table, grids)))


def _write(
    stats: SpatialStatistics, found: tuple[Claim, ...], values: dict[str, str], folder: Path
) -> list[tuple[str, str]]:
    """The files of `folder`, as (what, path)."""
    from analysis.statistics import tables
    from rgbt.files.atomic import write_atomic

    chosen = values["estimator"], values["average"]
    ways = sorted({_way(claim) for claim in found if claim.estimator}, key=lambda w: w != chosen)
    text = tables.markdown(stats, found, ways, decimal("level", values["level"], "0.95"))
    stats.save(folder / "statistics.npz")
    write_atomic(folder / "regions.csv", tables.to_csv(stats).encode())
    write_atomic(folder / "statistics.md", text.encode())
    kinds = (("measurements", "statistics.npz"), ("values", "regions.csv"))
    return [(kind, str(folder / file)) for kind, file in (*kinds, ("tables", "statistics.md"))]


def _way(claim: Claim) -> tuple[str, str]:
    return claim.estimator, claim.average


entry = plain_command(OWN, main)

if __name__ == "__main__":
    entry()
