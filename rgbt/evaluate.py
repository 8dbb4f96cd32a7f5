"""Evaluate a run, or weights from a file: ``rgbt evaluate run=runs/<key>``.

The command writes the counts and prints the tables derived from them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

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
        Help("file for the counts, details beside it; default: evaluations/ in the run folder"),
    ] = None


def main(options: Options, overrides: list[str]) -> int:
    """Evaluate a run, on its own data set or another one, or a network with weights from a file.

    Overrides such as dataset=mfnet dataset.root=/data/MFNet data.eval_batch_size=1, and settings
    of the corruption: corruption.block=16 corruption.seed=1
    """
    from rgbt.evaluation import request as requests
    from rgbt.evaluation import segmentation
    from rgbt.evaluation.prediction import check_request
    from rgbt.metrics.details import requested
    from rgbt.requirements import record_of
    from rgbt.terminal import print_rich, rich_table
    from rgbt.training.report import announce_network

    if options.out is not None and (options.out.is_dir() or options.modality == ALL):
        raise InputError(f"out={options.out} must be the file of a single evaluation's counts.")
    boundary = options.boundary_width, options.boundary_border
    details = requested(options.details, boundary, options.distances, options.sizes)
    words, overrides = requests.split_overrides(overrides)
    network = requests.NetworkRequest(options, overrides, options.regions)
    corruption = requests.requested_corruption(
        options.corruption, options.severity, words, network.trust
    )
    modality = "default" if options.modality == ALL else options.modality
    request = requests.EvaluationRequest.from_options(
        options.split, modality, options.head, corruption, details
    )
    batch_norm = requests.BatchNormRequest.from_options(
        options.batch_norm, options.batch_norm_splits
    )
    opened = network.open()
    check_request(opened, replace(request, batch_norm=batch_norm))
    announce_network(opened)
    views = record_of(opened.model).views if options.modality == ALL else (request.view,)
    by_view = {}
    for each in (replace(request, view=view, batch_norm=batch_norm) for view in views):
        result = segmentation.evaluate(opened, opened.model, each)
        by_view[result.view] = result.counts
        path = options.out or segmentation.counts_path(opened, network, each, result)
        result.save(path)
        print_rich(segmentation.overview(opened, each, result, path))
    if len(by_view) > 1:
        print_rich(rich_table(segmentation.views_table(by_view, opened.label)))
    return 0


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
