"""Evaluate a run, or weights from a file: ``rgbt evaluate run=runs/<key>``.

The command writes the counts and prints the tables derived from them.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from rgbt.metrics.details import DISTANCES, SIZES, WIDTH

ALL = "all"
"""Value of `modality`: each view of the network."""


def _text(edges: Sequence[float]) -> str:
    return ",".join(f"{edge:g}" for edge in edges)


@dataclass(frozen=True)
class Options(NetworkOptions):
    """Options of the command."""

    split: Split = "test"
    modality: Annotated[
        str,
        Help(
            "input images of the network: rgbt, rgb or thermal; by default those that it was "
            "designed for; all: each that it predicts from, and a table of them"
        ),
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
    distances: Annotated[str, Help("edges between bins of distance in metres")] = _text(DISTANCES)
    sizes: Annotated[str, Help("edges between bins of size in pixels of an object")] = _text(SIZES)
    out: Annotated[
        Path | None,
        Help("file for the counts, details beside it; default: evaluations/ in the run folder"),
    ] = None


def main(options: Options, overrides: list[str]) -> int:
    """Evaluate a run, on its own data set or another one, or a network with weights from a file.

    Overrides such as dataset=mfnet dataset.root=/data/MFNet data.eval_batch_size=1, and settings
    of the corruption: corruption.block=16 corruption.seed=1
    """
    from rgbt.evaluation.corruption_request import requested_corruption, split_overrides
    from rgbt.evaluation.details import save_details, score_table, views_table
    from rgbt.evaluation.request import (
        DEFAULT_VIEW,
        BatchNormRequest,
        EvaluationRequest,
        NetworkRequest,
    )
    from rgbt.evaluation.segmentation import counts_path, evaluate, label_of, overview
    from rgbt.metrics.details import requested
    from rgbt.requirements import record_of
    from rgbt.tracking.terminal import path_lines, print_rich, rich_table
    from rgbt.training.overview import announce_network

    _check_out(options)
    boundary = options.boundary_width, options.boundary_border
    details = requested(options.details, boundary, options.distances, options.sizes)
    words, overrides = split_overrides(overrides)
    network = NetworkRequest(options, overrides, options.regions)
    corruption = requested_corruption(options.corruption, options.severity, words, network.trust)
    modality = DEFAULT_VIEW if options.modality == ALL else options.modality
    request = EvaluationRequest.from_options(
        options.split, modality, options.head, corruption, details
    )
    batch_norm = BatchNormRequest.from_options(options.batch_norm, options.batch_norm_splits)
    opened = network.open()
    announce_network(opened)
    views = record_of(opened.session.model).views if options.modality == ALL else (request.view,)
    by_view = {}
    for each in (replace(request, view=view, batch_norm=batch_norm) for view in views):
        result = evaluate(opened.session, opened.session.model, each)
        by_view[result.view] = result.counts
        path = options.out or counts_path(opened, network, each, result)
        path.parent.mkdir(parents=True, exist_ok=True)
        result.counts.save(path)
        files = save_details(result.details, path)
        print_rich(overview(opened, each, result, path))
        for counts in result.details.values():
            print_rich(rich_table(score_table(counts, label_of(opened, each, result.view))))
        if files:
            print_rich(path_lines(files))
    if len(by_view) > 1:
        print_rich(rich_table(views_table(by_view, opened.label)))
    return 0


def _check_out(options: Options) -> None:
    if options.out is None:
        return
    if options.out.is_dir():
        raise InputError(
            f"out={options.out} is a folder; give a file name for the counts, such as "
            "out=counts.npz."
        )
    if options.modality == ALL:
        raise InputError(
            f"out={options.out} is the file of a single evaluation, but modality=all makes "
            "several; omit out=."
        )


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
