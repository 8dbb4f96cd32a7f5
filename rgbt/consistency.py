"""Measure temporal consistency of a run, of weights, or of any method: ``rgbt consistency``.

TC is the agreement of the predictions of two frames of a scene; CA counts agreement on the correct
class.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from annotated_types import Interval as Bounds

from rgbt.checks import InputError
from rgbt.config.common_options import Modality, NetworkOptions, PredictionFormatOptions, Split
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand

if TYPE_CHECKING:
    from rgbt.evaluation.pair_frames import EvaluationData

PREDICTION_OPTIONS = ("pairs", "format", "palette", "prefix", "suffix")
NETWORK_OPTIONS = ("run", "exported", "runs_dir", "checkpoint", "modality", "trust")
WITHOUT_EFFECT = {
    "run": PREDICTION_OPTIONS,
    "predictions": NETWORK_OPTIONS,
    "export": (*NETWORK_OPTIONS, *PREDICTION_OPTIONS, "predictions", "out", "flow", "least_used"),
}


@dataclass(frozen=True)
class Options(NetworkOptions, PredictionFormatOptions):
    """Options of the command."""

    frames: Annotated[
        Literal["virtual", "next", "video"],
        Help(
            "virtual: virtual views of every image, reported as 'aligned' (the first prediction "
            "is warped to the second frame, as in the paper) and 'released' (it is not warped). "
            "next: real second frames with known motion (a folder next/, or dataset=synth "
            "dataset.ego_forward_m=0.5). video: images with consecutive numbers, along an "
            "estimated flow; also measures the warping error and flicker"
        ),
    ] = "virtual"
    flow: Annotated[
        Literal["default", "exact", "rgb", "thermal", "both"],
        Help(
            "how points are followed to the next frame: exact (the default of frames=next), or "
            "estimated from rgb, thermal, or the better of both at each pixel (both, the default "
            "of frames=video). frames=next counts an estimated flow beside the exact one"
        ),
    ] = "default"
    least_used: Annotated[
        float,
        Bounds(ge=0, le=1),
        Help("frames=video: leave out pairs with a smaller share of pixels with reliable flow"),
    ] = 0.1
    split: Split = "test"
    modality: Modality = "default"
    export: Annotated[
        Path | None,
        Help("instead of a run: write the frames of every pair to this folder, for any method"),
    ] = None
    predictions: Annotated[
        Path | None,
        Help("instead of a run: folder of label images that any method predicted"),
    ] = None
    pairs: Annotated[
        Path | None,
        Help("folder of the export of these predictions; default: that of the predictions"),
    ] = None
    out: Annotated[
        Path | None,
        Help("folder for the files; default: evaluations/ of the run, none for predictions"),
    ] = None


def main(options: Options, overrides: list[str]) -> int:
    """Measure TC and CA of a run, of a network with weights from a file, or of predictions.

    Overrides such as consistency.sets=[my.csv] consistency.view.camera.fx=700 dataset=mfnet; all
    other settings are those of conf/consistency/views.yaml, not those of the run. The scores are
    added to the result of the run; rgbt sync sends them to MLflow.

    For a method outside of rgbt: rgbt consistency export=images dataset=mfnet dataset.root=...,
    predict every image in images/rgb and images/thermal, then
    rgbt consistency predictions=predicted pairs=images dataset=mfnet dataset.root=...
    With frames=video nothing is exported: the predictions are those of the images themselves.
    """
    kind = "export" if options.export else "predictions" if options.predictions else "run"
    of_frames = {"video": ("pairs", "export")}.get(options.frames, ("least_used",))
    for name in (*WITHOUT_EFFECT[kind], *of_frames):
        if getattr(options, name) != getattr(Options(), name):
            raise InputError(f"'{name}' has no effect on {kind}=... frames={options.frames}.")
    if not any(item.split("=")[0] == "consistency" for item in overrides):
        overrides = ["consistency=views", *overrides]
    if options.export is None:
        _measure(options, overrides)
        return 0
    from rgbt.evaluation.pair_frames import PairSource
    from rgbt.evaluation.pair_predictions import write_images
    from rgbt.terminal import path_lines, print_rich

    source = PairSource.compose(overrides)
    listed = write_images(source, options.split, options.frames, options.export)
    written = f"{len(listed.images)} of {len(listed.pairs)} pairs in {options.export.resolve()}"
    print_rich(path_lines([("images", written)]))
    return 0


def _measure(options: Options, overrides: list[str]) -> None:
    from rgbt.assembly.load_run import open_named
    from rgbt.evaluation import consistency_files as files
    from rgbt.evaluation import temporal_consistency as pairs_of
    from rgbt.evaluation.measure import measurement_of, path_of
    from rgbt.evaluation.pair_frames import Pairing
    from rgbt.evaluation.pair_predictions import count_predictions
    from rgbt.evaluation.predictor import chosen
    from rgbt.runs.folder import RunFolder
    from rgbt.tables import consistency_grid
    from rgbt.terminal import path_lines, print_rich, rich_table

    split, out = options.split, options.out
    pairing = Pairing.of(options.frames, options.flow, options.least_used)
    data: EvaluationData
    is_own = False
    if options.predictions:
        folder, exported = options.predictions, options.pairs or options.predictions
        pairs, data = count_predictions(folder, exported, options, overrides, split, pairing)
        label = folder.resolve().name
    else:
        data = session = open_named(options, overrides)
        label, wanted = session.label, measurement_of(session, split, chosen(options.modality)[0])
        is_own = wanted.is_own
        kept = pairing.pictured(session, split)
        pairs = pairs_of.count_pairs(session, wanted, pairing, kept)
    paths = {}
    for protocol, counts in pairs.counts.items() if out or not options.predictions else ():
        of = counts.measurement
        paths[protocol] = out / of.file_name if out else path_of(session, of)
    table = pairs_of.consistency_table(pairs.counts, data.regions.absent)
    views = next(iter(pairs.counts.values())).partition.partition("-")[2] or "published"
    title = f"Consistency of {label} ({data.dataset.name}, {split}; {options.frames}: {views})"
    print_rich(rich_table(consistency_grid(table, title)))
    least_used = options.least_used if options.frames == "video" else 0.0
    if pairs.records:
        print_rich(rich_table(pairs_of.changes_grid(pairs.counts)))
        print_rich("\n".join(files.flow_sentences(pairs.records, least_used)))
    if paths:
        print_rich(path_lines(files.write_pairs(pairs, paths, data.dataset)))
    if pairing.frames == "virtual" and is_own and not out:
        files.add_to_result(RunFolder(session.folder), session, split, table)


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
