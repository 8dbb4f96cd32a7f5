"""Measure temporal consistency of a run, of weights, or of any method: ``rgbt consistency``.

TC is the agreement of the predictions of two frames of a scene; CA counts agreement on the correct
class.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from annotated_types import Interval as Bounds

from rgbt.checks import InputError
from rgbt.config.common_options import (
    Modality,
    NetworkOptions,
    PredictionFormatOptions,
    Split,
)
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand

if TYPE_CHECKING:
    from rgbt.evaluation.prediction import EvaluationData
    from rgbt.evaluation.temporal_consistency import Pairs

OF_PREDICTIONS = ("pairs", "format", "palette", "prefix", "suffix")
"""Options without effect on a network and on images of pairs."""

OF_A_NETWORK = ("run", "runs_dir", "checkpoint", "modality", "trust")
"""Options without effect on images of pairs and on predictions of another method."""


@dataclass(frozen=True)
class Options(NetworkOptions, PredictionFormatOptions):
    """Options of the command."""

    frames: Annotated[
        Literal["virtual", "next", "video"],
        Help(
            "virtual: virtual views of every image, with three published sets of angles; reported "
            'as "aligned" (the first prediction is warped to the second frame, as in the paper) '
            'and "released" (it is not warped). next: real second frames with known motion '
            "(dataset=synth dataset.ego_forward_m=0.5, or a data set with a folder next/). video: "
            "images with consecutive numbers, along an estimated flow; also measures the warping "
            "error and flicker"
        ),
    ] = "virtual"
    flow: Annotated[
        Literal["default", "exact", "rgb", "thermal", "both"],
        Help(
            "how points are followed to the next frame: exact (stored beside frames=next, the "
            "default there), or estimated from rgb, from thermal, or from the better of both at "
            "each pixel (both, the default of frames=video). With frames=next the estimated flow "
            "is counted beside the exact one"
        ),
    ] = "default"
    least_used: Annotated[
        float,
        Bounds(ge=0, le=1),
        Help(
            "frames=video: pairs in which a smaller share of the pixels has a reliable flow are "
            "left out"
        ),
    ] = 0.1
    split: Split = "test"
    modality: Modality = "default"
    export: Annotated[
        Path | None,
        Help(
            "instead of a run: write both frames of every pair as images to this folder, for a "
            "method outside of rgbt; nothing is measured"
        ),
    ] = None
    predictions: Annotated[
        Path | None,
        Help(
            "instead of a run: folder of label images that any method predicted of exported "
            "images, NAME.png and NAME_view1.png, ..."
        ),
    ] = None
    pairs: Annotated[
        Path | None,
        Help("folder of the export of these predictions; default: that of the predictions"),
    ] = None
    out: Annotated[
        Path | None,
        Help(
            "folder for the counts and a picture; default: evaluations/ in the run folder, and "
            "none for predictions. Counts of other images, other views or another motion have "
            "names of their own there"
        ),
    ] = None


def main(options: Options, overrides: list[str]) -> int:
    """Measure TC and CA of a run, of a network with weights from a file, or of predictions.

    Overrides such as consistency.sets=[my.csv] consistency.view.camera.fx=700 dataset=mfnet; all
    other settings are those of conf/consistency/views.yaml, not those of the run.

    For a method outside of rgbt: rgbt consistency export=images dataset=mfnet dataset.root=...,
    predict every image in images/rgb and images/thermal, then
    rgbt consistency predictions=predicted pairs=images dataset=mfnet dataset.root=...
    With frames=video nothing is exported: the predictions are those of the images themselves.
    """
    if not any(item.split("=")[0] == "consistency" for item in overrides):
        overrides = ["consistency=views", *overrides]
    if options.export is None and options.predictions is None:
        _check_without(options, OF_PREDICTIONS, "a network")
        return _measure_network(options, overrides)
    _check_without(options, OF_A_NETWORK, "images of pairs and on predictions")
    if options.predictions is None:
        _check_without(options, (*OF_PREDICTIONS, "out"), "export=...")
        return _export(options, overrides)
    if options.export is not None:
        raise InputError("expected one of export=... and predictions=..., got both.")
    return _measure_predictions(options, overrides)


def _check_without(options: Options, names: tuple[str, ...], what: str) -> None:
    default = Options()
    for name in names:
        if getattr(options, name) != getattr(default, name):
            raise InputError(f"'{name}' has no effect on {what}; omit it.")


def _export(options: Options, overrides: list[str]) -> int:
    from rgbt.evaluation.pair_images import write_images
    from rgbt.evaluation.pair_list import PairSource
    from rgbt.tracking.terminal import path_lines, print_rich

    assert options.export is not None, "the caller has checked it"
    if options.frames == "video":
        raise InputError(
            "frames=video compares images of the data set itself; predict these as NAME.png, then "
            "give predictions=FOLDER."
        )
    _check_without(options, ("flow", "least_used"), "export=...")
    listed = write_images(
        PairSource.compose(overrides), options.split, options.frames, options.export
    )
    written = f"{len(listed.images)} of {len(listed.pairs)} pairs in {options.export.resolve()}"
    print_rich(path_lines([("images", written)]))
    return 0


def _measure_predictions(options: Options, overrides: list[str]) -> int:
    from rgbt.data.prediction_files import Affixes, opened_folder
    from rgbt.data.prediction_format import FormatOptions
    from rgbt.evaluation.consistency_files import write_pairs
    from rgbt.evaluation.pair_images import FolderFrames, FolderPairs
    from rgbt.evaluation.pair_list import PairSource, list_pairs
    from rgbt.evaluation.pairing import Pairing
    from rgbt.evaluation.request import EvaluationRequest
    from rgbt.evaluation.temporal_consistency import count_predicted
    from rgbt.metrics.pair_list import read_list
    from rgbt.metrics.pairs import file_name
    from rgbt.tracking.terminal import info, path_lines, print_rich

    split, folder, out = options.split, options.predictions, options.out
    assert folder is not None, "the caller has checked it"
    given = FormatOptions(
        form=options.format,
        palette=options.palette,
        affixes=Affixes(options.prefix, options.suffix),
    )
    pairing = Pairing.of(options.frames, options.flow, options.least_used)
    with opened_folder(folder) as opened:
        predictor: FolderFrames
        if pairing.frames == "video":
            _check_without(options, ("pairs",), "frames=video")
            source = PairSource.compose(overrides)
            predictor = FolderFrames(opened, source, pairing.images(source, split), given)
        else:
            listed, source = read_list(options.pairs or folder), PairSource.compose(overrides)
            wanted = list_pairs(source, split, pairing.frames)
            predictor = FolderPairs(opened, source, listed, wanted, given)
        request = EvaluationRequest(split=split, keep=pairing.pictured(source, split))
        pairs = count_predicted(source, predictor, request, pairing)
    info(predictor.sentence)
    _show(pairs, source, folder.resolve().name, options)
    if out is not None:
        paths = {
            each: out / Path(file_name(each, split, pairing.file_mark(source, each))).name
            for each in pairs.counts
        }
        print_rich(path_lines(write_pairs(pairs, paths, source.dataset)))
    return 0


def _show(pairs: Pairs, data: EvaluationData, label: str, options: Options) -> None:
    """Print TC and CA by class, and what an estimated flow is like."""
    from rgbt.evaluation.flow_record import flow_sentences
    from rgbt.evaluation.temporal_consistency import changes_grid, consistency_table
    from rgbt.tracking.tables import consistency_grid
    from rgbt.tracking.terminal import print_rich, rich_table

    table = consistency_table(pairs.counts, data.regions.absent)
    views = next(iter(pairs.counts.values())).partition.partition("-")[2] or "published"
    if options.frames == "video":
        views = f"{options.split} by consecutive numbers"
    on = f"{data.dataset.name}, {options.split}; {options.frames}: {views}"
    print_rich(rich_table(consistency_grid(table, f"Consistency of {label} ({on})")))
    if pairs.records:
        print_rich(rich_table(changes_grid(pairs.counts)))
        least_used = options.least_used if options.frames == "video" else 0.0
        for sentence in flow_sentences(pairs.records, least_used):
            print_rich(sentence)


def _measure_network(options: Options, overrides: list[str]) -> int:
    from rgbt.evaluation.consistency_files import PairFiles, add_to_result
    from rgbt.evaluation.pairing import Pairing
    from rgbt.evaluation.request import EvaluationRequest, NetworkRequest
    from rgbt.evaluation.temporal_consistency import consistency_table, count_pairs
    from rgbt.tracking.run_folder import RunFolder
    from rgbt.tracking.terminal import path_lines, print_rich

    split, out = options.split, options.out
    pairing = Pairing.of(options.frames, options.flow, options.least_used)
    network = NetworkRequest(options, overrides)
    network.check_comparable(out)
    request = EvaluationRequest.from_options(split, options.modality)
    opened = network.open()
    session = opened.session
    files = PairFiles(opened, network, request, pairing, out)
    request = replace(request, keep=pairing.pictured(session, split))
    pairs = count_pairs(session, session.model, request, pairing)
    _show(pairs, session, opened.label, options)
    print_rich(path_lines(files.write(pairs)))
    if pairing.frames == "virtual" and options.run and not (out or files.suffixes):
        table = consistency_table(pairs.counts, session.regions.absent)
        add_to_result(RunFolder(opened.folder.parent), session, split, table)
    return 0


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
