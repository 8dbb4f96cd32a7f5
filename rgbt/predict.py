"""Predict images with a trained network: ``python -m rgbt.predict run=... input=... out=folder``.

For every image a colour overlay and a PNG of class indices are written; with pseudo_labels=true
labels and confidences of a split instead, to train other networks on
(`rgbt.evaluation.pseudo_labels`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rgbt.checks import InputError
from rgbt.config.common_options import (
    AS_TRAINED,
    Checkpoint,
    Head,
    Modality,
    RunsDir,
    Trained,
    Trust,
)
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from rgbt.build.load_run import TrainedNetwork
    from rgbt.build.session import Session
    from rgbt.data.domains import TestedHead
    from rgbt.data.label_map import LabelMap
    from rgbt.data.to_predict import ToPredict
    from rgbt.types import Sample, View


@dataclass(frozen=True)
class Options:
    """What is predicted, and how it is written."""

    out: Annotated[Path, Help("folder, created if it is missing")]
    run: Trained = ""
    input: Annotated[
        str,
        Help(
            "a folder of new images, laid out as the data set of the run, or with folders rgb and "
            "thermal of equal names; PNG of four channels (R, G, B, thermal), one or a folder of "
            "such; or a split of the data set. Labels are not needed"
        ),
    ] = ""
    rgb: Annotated[str, Help("instead of input, with thermal: the RGB file of one pair")] = ""
    thermal: Annotated[str, Help("the thermal file of that pair")] = ""
    runs_dir: RunsDir = Path("runs")
    modality: Modality = "default"
    head: Head = "as trained"
    checkpoint: Checkpoint = "best"
    trust: Trust = ""
    label_map: Annotated[
        str,
        Help(
            "a file of conf/label_map, for a network that knows other classes than the data set: "
            "vistas_to_freiburg (of 66 classes), cityscapes_to_freiburg, freiburg_to_mfnet"
        ),
    ] = "none"
    pseudo_labels: Annotated[
        bool,
        Help(
            "true: of a split, write labels/NAME.png (class indices, 255 where not sure), "
            "confidence/NAME.png (16 bit) and pseudo_labels.json; the same command resumes"
        ),
    ] = False
    threshold: Annotated[
        float,
        Help("smallest confidence of a pixel that gets a label, 0 to 1; 0: every pixel gets one"),
    ] = 0.0


def main(options: Options, overrides: list[str]) -> int:
    """Write NAME_overlay.png and NAME.png (class indices, 0..K-1) for every input image.

    Overrides such as dataset=mfnet dataset.root=/data/MFNet
    """
    from rgbt.build.load_run import open_trained
    from rgbt.config.stored_config import parse_trust
    from rgbt.evaluation.pseudo_labels import label_map_of
    from rgbt.training.overview import announce_network

    if not options.pseudo_labels and options.threshold:
        raise InputError(
            f"threshold={options.threshold} is for pseudo_labels=true; class maps and "
            "overlays show every pixel."
        )
    label_map = label_map_of(options.label_map)
    run, runs_dir, checkpoint = options.run, options.runs_dir, options.checkpoint
    trust = parse_trust(options.trust)
    stored = open_trained(run, runs_dir, overrides, checkpoint, label_map, trust)
    announce_network(stored)
    if options.pseudo_labels:
        _pseudo_labels(options, stored, label_map)
    else:
        _pictures(options, stored.session, label_map)
    return 0


def _pseudo_labels(options: Options, stored: TrainedNetwork, label_map: LabelMap | None) -> None:
    from rgbt.build.session import view_of
    from rgbt.evaluation.pseudo_labels import summary, teacher_of, write_pseudo_labels
    from rgbt.tracking.terminal import path_lines, print_rich, rich_table

    session, split = stored.session, options.input
    if split not in session.dataset.splits or options.rgb or options.thermal:
        raise InputError(
            f"input={split}: pseudo-labels are written of a split of {session.dataset.name}; "
            f"name one of {', '.join(session.dataset.splits)}."
        )
    key_or_file = stored.folder.parent.name if options.run else stored.label
    found = write_pseudo_labels(
        session,
        teacher_of(key_or_file, session.model),
        split,
        view_of(session, options.modality),
        options.out,
        options.threshold,
        label_map,
        _head(options),
    )
    print_rich(rich_table(summary(found)))
    print_rich(path_lines([("pseudo-labels", str(found.folder.resolve()))]))


def _pictures(options: Options, session: Session, label_map: LabelMap | None) -> None:
    import numpy as np

    from rgbt.build.session import view_of
    from rgbt.engine.progress import progress
    from rgbt.tracking.pictures import overlay

    view, head = view_of(session, options.modality), _head(options)
    images, out = _chosen(options, session), options.out
    images.check_out(out)
    out.mkdir(parents=True, exist_ok=True)
    palette = np.array(session.dataset.palette, np.uint8)
    written = 0
    with progress() as display:
        task = display.add_task("predicting", total=len(images.names), note="images")
        for sample, predicted in _classes(session, images, view, head):
            classes = predicted if label_map is None else label_map(predicted)
            painted = overlay(sample.rgb, classes, palette)
            _write(out / f"{sample.name}_overlay.png", painted[..., ::-1])
            _write(out / f"{sample.name}.png", classes)
            written += 1
            display.advance(task)
    _tell_what_was_left_out(images)
    print(f"{written} images in {out.resolve()}")


def _tell_what_was_left_out(images: ToPredict) -> None:
    from rgbt.tracking.terminal import info

    for reason in list(images.skipped.values())[:1]:
        info(f"{len(images.skipped)} image(s) left out; the first: {reason}")
    for path in images.others[:1]:
        info(f"{len(images.others)} image(s) belong to no pair and were not read; first: {path}")


def _chosen(options: Options, session: Session) -> ToPredict:
    """The images that `input`, or `rgb` and `thermal`, name."""
    from rgbt.data.to_predict import of_files, of_path, of_split

    source, rgb, thermal = options.input, options.rgb, options.thermal
    if bool(rgb) != bool(thermal) or bool(source) == bool(rgb):
        raise InputError(
            "expected either input=FOLDER (or a split, or a file of four channels) or rgb=FILE "
            "thermal=FILE, got "
            + (
                " and ".join(key for key in ("input", "rgb", "thermal") if getattr(options, key))
                or "none"
            )
            + " of input, rgb and thermal."
        )
    dataset = session.dataset
    if rgb:
        return of_files(dataset, Path(rgb), Path(thermal))
    if source in dataset.splits:
        return of_split(dataset, source)
    return of_path(dataset, source, session.loading.on_error)


def _head(options: Options) -> TestedHead | None:
    return None if options.head == AS_TRAINED else options.head


def _write(path: Path, image: NDArray[np.uint8]) -> None:
    import cv2

    from rgbt.files.atomic import write_atomic

    encoded, content = cv2.imencode(".png", image)
    assert encoded, "8 bit images can be encoded"
    write_atomic(path, content.tobytes())


def _classes(
    session: Session, images: ToPredict, view: View, head: TestedHead | None
) -> Iterator[tuple[Sample, NDArray[np.uint8]]]:
    from rgbt.build.session import heads_of
    from rgbt.data.batches import collate
    from rgbt.engine.evaluate import predictions

    heads = heads_of(session, view, head)
    for sample in images.samples(session.loading.on_error):
        # One image at a time: a folder may hold images of any size.
        batch = collate([session.transform.test(sample)], "")
        for found in predictions(session.model, [batch], session.fabric, view, heads):
            yield sample, found.classes[0].numpy()


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
