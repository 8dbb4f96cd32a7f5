"""Evaluate a run, or weights from a file: ``rgbt evaluate run=runs/<key>``.

The command writes the counts and prints the tables derived from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rgbt.checks import InputError
from rgbt.config.common_options import (
    BatchNorm,
    BatchNormSplits,
    CorruptionName,
    Head,
    NetworkOptions,
    RegionsFile,
    Severity,
    Split,
)
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.metrics.details import WIDTH

if TYPE_CHECKING:
    from rgbt.assembly.session import Session
    from rgbt.metrics.counts import Counts
    from rgbt.metrics.details import Details
    from rgbt.metrics.measurement import Measurement

# Value of `modality`: each view of the network.
ALL = "all"


@dataclass(frozen=True)
class Options(NetworkOptions):
    """Options of the command."""

    split: Split = "test"
    modality: Annotated[
        str,
        Help("input images: rgbt, rgb, thermal, default (as designed), or all and a table of them"),
    ] = "default"
    regions: RegionsFile = "as trained"
    head: Head = "as trained"
    corruption: CorruptionName = "none"
    severity: Severity = ""
    batch_norm: BatchNorm = "as trained"
    batch_norm_splits: BatchNormSplits = ""
    details: Annotated[
        str,
        Help(
            "what else to count, a list: boundary (boundary IoU), calibration (ECE), distance "
            "(IoU by distance), size (recall by size of the object); all; none. Distance and size "
            "require a data set with scene maps, such as dataset=synth_calibrated"
        ),
    ] = "none"
    boundary_width: Annotated[
        float, Help("width of a boundary as a share of the image diagonal, 0.001 to 0.2")
    ] = WIDTH
    boundary_border: Annotated[
        bool, Help("whether the border of the image is an outline of masks, as Cheng et al. coded")
    ] = False
    distances: Annotated[str, Help("edges between bins of distance in metres")] = "10,20,40"
    sizes: Annotated[str, Help("edges between bins of size in pixels of an object")] = "64,256,1024"
    out: Annotated[
        Path | None,
        Help("file for the counts, details beside it; default: in the run folder, by its content"),
    ] = None


def main(options: Options, overrides: list[str]) -> int:
    """Evaluate a run, on its own data set or another one, or a network with weights from a file.

    Overrides such as dataset=mfnet dataset.root=/data/MFNet data.eval_batch_size=1, and settings
    of the corruption: corruption.block=16 corruption.seed=1
    """
    from rgbt.assembly.load_run import open_named
    from rgbt.config.corruption_node import split_overrides
    from rgbt.config.stored_config import parse_trust
    from rgbt.evaluation import measure, tables
    from rgbt.evaluation.corruption import corrupted, requested_corruption
    from rgbt.evaluation.predict import chosen
    from rgbt.metrics.details import requested
    from rgbt.requirements import NetworkRecord, record_of
    from rgbt.terminal import print_rich, rich_table
    from rgbt.training.report import announce_network

    split, out = options.split, options.out
    if out is not None and (out.is_dir() or options.modality == ALL):
        raise InputError(f"out={out} must be the file of a single evaluation's counts.")
    boundary = options.boundary_width, options.boundary_border
    details = requested(options.details, boundary, options.distances, options.sizes)
    words, overrides = split_overrides(overrides)
    given = options.corruption, options.severity, words, parse_trust(options.trust)
    corruption = requested_corruption(*given)
    view, head = chosen("default" if options.modality == ALL else options.modality, options.head)
    opened = open_named(options, overrides, options.regions)
    if corruption is not None:
        opened = corrupted(opened, *corruption, split)
    views = record_of(opened.model, NetworkRecord).views if options.modality == ALL else (view,)
    of_norm = options.batch_norm, options.batch_norm_splits
    by_view = {}
    for view in views:
        wanted = measure.measurement_of(opened, split, view, head, *of_norm)
        if view == views[0]:
            measure.predictor_of(opened, wanted)  # refuses what cannot be measured
            announce_network(opened)
        counts, note = _counted(opened, wanted, details, out)
        by_view[wanted.view] = next(iter(counts.values()))
        print_rich(tables.overview(opened, counts, note))
        measure.draw_missing(opened, by_view[wanted.view])
    if len(by_view) > 1:
        print_rich(rich_table(tables.views_table(by_view, opened.label)))
    return 0


def _counted(
    session: Session, wanted: Measurement, details: Sequence[Details], out: Path | None
) -> tuple[dict[Path, Counts], str]:
    """The counts by their files, which are measured where they are missing, and a note on them."""
    from rgbt.evaluation import measure

    files = measure.files_of(session, wanted, details, out)
    counts = measure.stored(session, files)
    if len(counts) == len(files):
        return counts, "measured before"
    made = measure.measure(session, wanted, details)
    note = f"{len(made.skipped)} images were unreadable" if made.skipped else ""
    return measure.store(files, made, counts), note


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
