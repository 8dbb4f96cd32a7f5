"""Results by region of any method: ``python -m analysis.score predictions=folder dataset=...``.

From a folder of predicted label images, or from the counts that a run has stored.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

from rgbt.checks import InputError, check_choice, check_range
from rgbt.command import composing, plain_command

if TYPE_CHECKING:
    from analysis.predictions.scoring import Options, Scored
    from analysis.predictions.table import ScoreTable
    from analysis.uncertainty import Resampling
    from rgbt.data.mfnet import MFNet
    from rgbt.metrics.counts import Counts
    from rgbt.metrics.metric import Absent

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
    "split": "test",
    "out": "",
    "runs_dir": "runs",
    "resamples": "10000",
    "level": "0.95",
    "blocks": "auto",
    **OF_A_FOLDER,
}
MAX_THREADS = 256


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Score predictions of any method by region, class, day and night, with intervals.

    predictions  folder with NAME.png for every image of the split: class indices (8 bit, one
                 channel), a palette PNG, or RGB in the colours of dataset.palette
    counts       instead: counts of runs; run folder, config key, MLflow run id, file, or several
                 with commas
    split        split of the data set
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
    given = [key for key in ("predictions", "counts") if arguments[key]]
    if len(given) != 1:
        raise InputError(
            f"expected one of predictions=folder and counts=run, got {' and '.join(given) or 'none'}."
        )
    out = Path(arguments["out"]) if arguments["out"] else None
    settings = _resampling(arguments)
    if given == ["counts"]:
        counted, remarks = _stored(arguments, overrides)
    else:
        scored = _scored(arguments, overrides)
        counted = [(scored.name, counts) for counts in scored.counts]
        remarks = remarks_on(scored)
        _write_counts(scored, out)
    tables = score_tables(counted, settings)
    if settings is not None:
        remarks.append(_about_intervals(settings))
    _report(tables, remarks, out)
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
    from rich.console import Console
    from rich.progress import Progress

    from analysis.predictions.table import score_table, with_intervals

    tables = [score_table(counts, name) for name, counts in counted]
    if settings is None:
        return tables
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("resampling", total=len(tables))
        for index, (_, counts) in enumerate(counted):
            intervals = _intervals(tables[index], counts, settings)
            tables[index] = with_intervals(tables[index], intervals)
            progress.advance(task)
    return tables


def remarks_on(scored: Scored) -> list[str]:
    """What a reader of the numbers has to know about the folder, one sentence each."""
    from analysis.predictions.folder import listed
    from analysis.predictions.maps import iou_map, ring_means

    found, remarks = scored.found, []
    if found.missing:
        number = len(found.missing) + len(found.paths)
        remarks.append(
            f"{len(found.missing)} of {number} images of the split have no prediction and are left "
            f"out of every number ({listed(found.missing)})."
        )
    if scored.resized:
        remarks.append(
            f"{len(scored.resized)} predictions were resized to their label by the nearest pixel "
            f"({listed(scored.resized)})."
        )
    if found.extra:
        remarks.append(
            f"{len(found.extra)} other PNG files of the folder belong to no image of the split and "
            f"were not read ({listed(found.extra)})."
        )
    if scored.maps is None:
        remarks.append("The images differ in size, so there is no map by pixel.")
        return remarks
    means = 100 * ring_means(iou_map(scored.maps), 5)
    remarks.append(
        f"Mean IoU by pixel (classes that never occur at a pixel left out): centre {means[0]:.2f}, "
        f"edge {means[-1]:.2f} (first and last of five rings)."
    )
    return remarks


def _scored(arguments: dict[str, str], overrides: list[str]) -> Scored:
    from rich.console import Console
    from rich.progress import Progress

    from analysis.predictions.scoring import score_folder

    dataset, options = _dataset(overrides), _options(arguments)
    folder, split = Path(arguments["predictions"]), arguments["split"]
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("counting", total=len(dataset.names(split)))
        return score_folder(folder, dataset, split, options, lambda: progress.advance(task))


def _dataset(overrides: list[str]) -> MFNet:
    from rgbt.config import build, check_node, compose
    from rgbt.data.mfnet import MFNet

    for word in overrides:
        key = word.lstrip("+~").partition("=")[0]
        if key.split(".")[0] != "dataset":
            raise InputError(
                f"'{key}' has no effect on a score; expected dataset=... or dataset.<key>=..., or "
                f"one of {', '.join(OWN)}."
            )
    with composing(overrides):
        node = compose(overrides).dataset
        check_node(node, "dataset")
        dataset = build(node)
    if not isinstance(dataset, MFNet):
        raise InputError(
            f"dataset: expected a data set in MFNet's layout, got {type(dataset).__name__}; choose "
            "dataset=mfnet or dataset=synth."
        )
    return dataset


def _options(arguments: dict[str, str]) -> Options:
    from typing import Any

    from analysis.predictions.scoring import PARTITIONS, Options

    partition = arguments["partition"]
    check_choice("partition", partition, ("all", *PARTITIONS))
    chosen: dict[str, Any] = {
        key: arguments[key] for key in ("missing", "resize", "suffix", "name")
    }
    return Options(
        partitions=PARTITIONS if partition == "all" else (cast(Any, partition),),
        regions=_whole_number(arguments, "regions", 1, 255),
        form=cast(Any, arguments["format"]),
        threads=_whole_number(arguments, "threads", 0, MAX_THREADS),
        **chosen,
    )


def _stored(
    arguments: dict[str, str], overrides: list[str]
) -> tuple[list[tuple[str, Counts]], list[str]]:
    from analysis.results import open_counts
    from rgbt.tracking.terminal import tell

    set_here = [key for key, default in OF_A_FOLDER.items() if arguments[key] != default]
    for key in [*set_here, *overrides]:
        raise InputError(
            f"'{key.partition('=')[0]}' has no effect on stored counts, which are counted already; "
            "leave it out, or give a folder with predictions=..."
        )
    found = open_counts(arguments["counts"], Path(arguments["runs_dir"]), arguments["split"])
    tell(
        "stored counts hold no pixels, so there is no map by pixel; write predictions with "
        "python -m rgbt.predict run=... input=<split> out=folder and score that folder."
    )
    return [(stored.label, stored.counts) for stored in found], []


def _resampling(arguments: dict[str, str]) -> Resampling | None:
    from analysis.uncertainty import Resampling

    resamples = _whole_number(arguments, "resamples", 0, 1_000_000)
    if resamples == 0:
        return None
    try:
        level = float(arguments["level"])
    except ValueError as error:
        raise InputError(f"level={arguments['level']}: expected a number such as 0.95.") from error
    blocks = arguments["blocks"]
    number: int | Literal["auto"] = (
        int(blocks) if blocks.isdecimal() else cast("Literal['auto']", blocks)
    )
    return Resampling(resamples=resamples, level=level, blocks=number)


def _intervals(
    table: ScoreTable, counts: Counts, settings: Resampling
) -> list[tuple[object, tuple[float, float]]]:
    return []


def _whole_number(arguments: dict[str, str], key: str, low: int, high: int) -> int:
    text = arguments[key]
    if not text.isdecimal():
        raise InputError(f"{key}={text}: expected a whole number from {low} to {high}.")
    check_range(key, int(text), low, high)
    return int(text)


if __name__ == "__main__":
    plain_command(OWN, main)()
