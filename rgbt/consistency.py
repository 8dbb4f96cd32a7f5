"""Measure temporal consistency of a run, of weights, or of any method: ``rgbt consistency``.

TC is the agreement of the predictions of two frames of a scene; CA counts agreement on the correct
class.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

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
        Literal["virtual", "next"],
        Help(
            "virtual: virtual views of every image, with three published sets of angles; reported "
            'as "aligned" (the first prediction is warped to the second frame, as in the paper) '
            'and "released" (it is not warped). next: real second frames with known motion '
            "(dataset=synth dataset.ego_forward_m=0.5, or a data set with a folder next/)"
        ),
    ] = "virtual"
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
    from rgbt.evaluation.pair_images import FolderPairs
    from rgbt.evaluation.pair_list import PairSource, list_pairs
    from rgbt.evaluation.request import EvaluationRequest
    from rgbt.evaluation.segmentation import panel_names
    from rgbt.evaluation.temporal_consistency import count_predicted
    from rgbt.metrics.pair_list import read_list
    from rgbt.metrics.pairs import file_name
    from rgbt.tracking.terminal import info, path_lines, print_rich

    split, folder, out = options.split, options.predictions, options.out
    assert folder is not None, "the caller has checked it"
    listed, source = read_list(options.pairs or folder), PairSource.compose(overrides)
    wanted = list_pairs(source, split, options.frames)
    request = EvaluationRequest(split=split, keep=panel_names(source.dataset, split))
    given = FormatOptions(
        form=options.format,
        palette=options.palette,
        affixes=Affixes(options.prefix, options.suffix),
    )
    with opened_folder(folder) as opened:
        predictor = FolderPairs(opened, source, listed, wanted, given)
        pairs = count_predicted(source, predictor, request, options.frames)
    info(predictor.sentence)
    _show(pairs, source, folder.resolve().name, options)
    if out is not None:
        mark = source.consistency.mark if options.frames == "virtual" else ""
        paths = {each: out / Path(file_name(each, split, mark)).name for each in pairs.counts}
        print_rich(path_lines(write_pairs(pairs, paths, source.dataset)))
    return 0


def _show(pairs: Pairs, data: EvaluationData, label: str, options: Options) -> None:
    """Print TC and CA by class."""
    from rgbt.evaluation.temporal_consistency import consistency_table
    from rgbt.tracking.tables import consistency_grid
    from rgbt.tracking.terminal import print_rich, rich_table

    table = consistency_table(pairs.counts, data.regions.absent)
    views = next(iter(pairs.counts.values())).partition.partition("-")[2] or "published"
    on = f"{data.dataset.name}, {options.split}; {options.frames}: {views}"
    print_rich(rich_table(consistency_grid(table, f"Consistency of {label} ({on})")))


def _measure_network(options: Options, overrides: list[str]) -> int:
    from rgbt.evaluation.consistency_files import PairFiles, add_to_result
    from rgbt.evaluation.request import EvaluationRequest, NetworkRequest
    from rgbt.evaluation.segmentation import panel_names
    from rgbt.evaluation.temporal_consistency import consistency_table, count_pairs
    from rgbt.tracking.run_folder import RunFolder
    from rgbt.tracking.terminal import path_lines, print_rich

    split, frames, out = options.split, options.frames, options.out
    network = NetworkRequest(options, overrides)
    network.check_comparable(out)
    request = EvaluationRequest.from_options(split, options.modality)
    opened = network.open()
    session = opened.session
    files = PairFiles(opened, network, request, frames, out)
    request = replace(request, keep=panel_names(session.dataset, split))
    pairs = count_pairs(session, session.model, request, frames)
    _show(pairs, session, opened.label, options)
    print_rich(path_lines(files.write(pairs)))
    if frames == "virtual" and options.run and not (out or files.suffixes):
        table = consistency_table(pairs.counts, session.regions.absent)
        add_to_result(RunFolder(opened.folder.parent), session, split, table)
    return 0


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
