"""Measure temporal consistency of a run, of weights, or of any method: ``rgbt consistency``.

TC is the agreement of the predictions of two frames of a scene; CA counts agreement on the correct
class.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Interval as Bounds

from rgbt.checks import InputError
from rgbt.config.common_options import Modality, NetworkOptions, PredictionFormatOptions, Split
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand

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
    if not any(word.split("=")[0] == "consistency" for word in overrides):
        overrides = ["consistency=views", *overrides]
    if options.export is None:
        _measure(options, overrides)
        return 0
    from rgbt.evaluation.pairs.frames import composed_pairs
    from rgbt.evaluation.pairs.others import write_images
    from rgbt.terminal import path_lines, print_rich

    pairs = composed_pairs(overrides, options.split, frames=options.frames)
    listed = write_images(pairs, options.export)
    written = f"{len(listed.images)} of {len(listed.pairs)} pairs in {options.export.resolve()}"
    print_rich(path_lines([("images", written)]))
    return 0


def _measure(options: Options, overrides: list[str]) -> None:
    from rgbt.assembly.load_run import open_named
    from rgbt.evaluation.measure import measurement_of, path_of
    from rgbt.evaluation.pairs import files
    from rgbt.evaluation.pairs.count import changes_grid, consistency_table, count_pairs
    from rgbt.evaluation.pairs.frames import composed_pairs, flow_source, pairs_of
    from rgbt.evaluation.pairs.others import count_predictions
    from rgbt.evaluation.predict import chosen
    from rgbt.runs.folder import RunFolder
    from rgbt.tables import consistency_grid
    from rgbt.terminal import path_lines, print_rich, rich_table

    split, out, session = options.split, options.out, None
    flow = flow_source(options.frames, options.flow)
    how: Any = {"frames": options.frames, "flow": flow, "least_used": options.least_used}
    if options.predictions:
        pairs = composed_pairs(overrides, split, **how)
        exported = options.pairs or options.predictions
        found = count_predictions(options.predictions, exported, options, pairs)
        label = options.predictions.resolve().name
    else:
        session = open_named(options, overrides)
        pairs = pairs_of(session, split, **how)
        wanted = measurement_of(session, split, chosen(options.modality)[0])
        found = count_pairs(session, wanted, pairs, pairs.pictured)
        label = session.label
    first = next(iter(found.counts.values()))
    folder = out if session is None else out or path_of(session, first.measurement).parent
    table = consistency_table(found.counts, pairs.regions.absent)
    views = first.partition.partition("-")[2] or "published"
    title = f"Consistency of {label} ({pairs.dataset.name}, {split}; {options.frames}: {views})"
    print_rich(rich_table(consistency_grid(table, title)))
    least_used = options.least_used if options.frames == "video" else 0.0
    if found.records:
        print_rich(rich_table(changes_grid(found.counts)))
        print_rich("\n".join(files.flow_sentences(found.records, least_used)))
    if folder is not None:
        print_rich(path_lines(files.write_pairs(found, folder, pairs.dataset)))
    if session is not None and wanted.is_own and options.frames == "virtual" and not out:
        files.add_to_result(RunFolder(session.folder), session, split, table)


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
