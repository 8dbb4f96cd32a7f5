"""Predict images with a trained network: ``python -m rgbt.predict run=... input=... out=folder``.

For every image a colour overlay and a PNG of class indices are written; with pseudo_labels=true
labels and confidences of a split instead, to train other networks on
(`rgbt.evaluation.pseudo_labels`).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, cast, get_args

from rgbt.checks import InputError, check_choice
from rgbt.config.command import plain_command

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from rgbt.build.load_run import TrainedNetwork
    from rgbt.build.session import Session
    from rgbt.data.domains import TestedHead
    from rgbt.data.label_map import LabelMap
    from rgbt.data.to_predict import ToPredict
    from rgbt.types import Sample, View

OWN = {
    "run": "",
    "input": "",
    "rgb": "",
    "thermal": "",
    "out": None,
    "runs_dir": "runs",
    "modality": "default",
    "head": "as trained",
    "checkpoint": "best",
    "trust": "",
    "label_map": "none",
    "pseudo_labels": "false",
    "threshold": "0",
}


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Write NAME_overlay.png and NAME.png (class indices, 0..K-1) for every input image.

    run       run folder, config key or MLflow run id; without one, name a network and its weights:
              model=mfnet model.weights=final.pth dataset.root=/data/MFNet (scale=paper)
    input     a folder of new images, laid out as the data set of the run, or with folders rgb and
              thermal of equal names; PNG of four channels (R, G, B, thermal), one or a folder of
              such; or a split of the data set. Labels are not needed
    rgb, thermal  instead: the two files of one pair
    out       folder, made where it is missing
    modality  rgbt, rgb or thermal: what is predicted from; default: what the network is made for
    head      of a network with a head per domain: own, source or target
    checkpoint  best (by validation mIoU) or last, of a run
    trust     modules of yours that the run was made with: trust=my_lab; their code is run
    label_map a file of conf/label_map, for a network that knows other classes than the data set:
              vistas_to_freiburg (of 66 classes), cityscapes_to_freiburg, freiburg_to_mfnet
    pseudo_labels  true: of a split, write labels/NAME.png (class indices, 255 where not sure),
              confidence/NAME.png (16 bit) and pseudo_labels.json; called again it goes on
    threshold smallest confidence of a pixel that gets a label, 0 to 1; 0: every pixel gets one
    overrides such as dataset=mfnet dataset.root=/data/MFNet
    """
    from rgbt.build.load_run import open_trained
    from rgbt.config.stored_config import parse_trust
    from rgbt.evaluation.pseudo_labels import label_map_of
    from rgbt.training.overview import announce_network

    check_choice("pseudo_labels", arguments["pseudo_labels"], ("true", "false"))
    as_labels = arguments["pseudo_labels"] == "true"
    if not as_labels and arguments["threshold"] != OWN["threshold"]:
        raise InputError(
            f"threshold={arguments['threshold']} is for pseudo_labels=true; class maps and "
            "overlays show every pixel."
        )
    label_map = label_map_of(arguments["label_map"])
    runs_dir = Path(arguments["runs_dir"])
    run, checkpoint = arguments["run"], arguments["checkpoint"]
    trust = parse_trust(arguments["trust"])
    stored = open_trained(run, runs_dir, overrides, checkpoint, label_map, trust)
    announce_network(stored)
    if as_labels:
        _pseudo_labels(arguments, stored, label_map)
    else:
        _pictures(arguments, stored.session, label_map)
    return 0


def _pseudo_labels(
    arguments: dict[str, str], stored: TrainedNetwork, label_map: LabelMap | None
) -> None:
    from rgbt.build.session import view_of
    from rgbt.evaluation.pseudo_labels import summary, teacher_of, write_pseudo_labels
    from rgbt.tracking.terminal import place_lines, rich_table, show

    session, split = stored.session, arguments["input"]
    if split not in session.dataset.splits or arguments["rgb"] or arguments["thermal"]:
        raise InputError(
            f"input={split}: pseudo-labels are written of a split of {session.dataset.name}; "
            f"name one of {', '.join(session.dataset.splits)}."
        )
    try:
        threshold = float(arguments["threshold"])
    except ValueError as error:
        raise InputError(
            f"threshold={arguments['threshold']}: expected a number from 0 to 1."
        ) from error
    key_or_file = stored.folder.parent.name if arguments["run"] else stored.label
    found = write_pseudo_labels(
        session,
        teacher_of(key_or_file, session.model),
        split,
        view_of(session, arguments["modality"]),
        Path(arguments["out"]),
        threshold,
        label_map,
        _head(arguments["head"]),
    )
    show(rich_table(summary(found)))
    show(place_lines([("pseudo-labels", str(found.folder.resolve()))]))


def _pictures(arguments: dict[str, str], session: Session, label_map: LabelMap | None) -> None:
    import numpy as np

    from rgbt.build.session import view_of
    from rgbt.engine.progress import progress
    from rgbt.tracking.pictures import overlay

    view, head = view_of(session, arguments["modality"]), _head(arguments["head"])
    images, out = _chosen(arguments, session), Path(arguments["out"])
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
    from rgbt.tracking.terminal import tell

    for reason in list(images.skipped.values())[:1]:
        tell(f"{len(images.skipped)} image(s) left out; the first: {reason}")
    for path in images.others[:1]:
        tell(f"{len(images.others)} image(s) belong to no pair and were not read; first: {path}")


def _chosen(arguments: dict[str, str], session: Session) -> ToPredict:
    """The images that `input`, or `rgb` and `thermal`, name."""
    from rgbt.data.to_predict import of_files, of_path, of_split

    source, rgb, thermal = (arguments[key] for key in ("input", "rgb", "thermal"))
    if bool(rgb) != bool(thermal) or bool(source) == bool(rgb):
        raise InputError(
            "expected either input=FOLDER (or a split, or a file of four channels) or rgb=FILE "
            "thermal=FILE, got "
            + (" and ".join(key for key in ("input", "rgb", "thermal") if arguments[key]) or "none")
            + " of input, rgb and thermal."
        )
    dataset = session.dataset
    if rgb:
        return of_files(dataset, Path(rgb), Path(thermal))
    if source in dataset.splits:
        return of_split(dataset, source)
    return of_path(dataset, source, session.loading.on_error)


def _head(asked: str) -> TestedHead | None:
    from rgbt.data.domains import TestedHead

    if asked == OWN["head"]:
        return None
    check_choice("head", asked, get_args(TestedHead))
    return cast("TestedHead", asked)


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


if __name__ == "__main__":
    plain_command(OWN, main)()
