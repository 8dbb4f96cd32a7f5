"""Predict images with a trained network: ``python -m rgbt.predict run=... input=... out=folder``.

For every image a colour overlay and a PNG of class indices are written; with pseudo_labels=true
labels and confidences of a split instead, to train other networks on (`rgbt.pseudo`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, cast, get_args

from rgbt.checks import InputError, check_choice
from rgbt.command import plain_command

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from rgbt.data.domains import TestedHead
    from rgbt.data.label_map import LabelMap
    from rgbt.session import Session
    from rgbt.stored import Stored
    from rgbt.types import Sample, View

OWN = {
    "run": "",
    "input": None,
    "out": None,
    "runs_dir": "runs",
    "modality": "default",
    "head": "as trained",
    "checkpoint": "best",
    "label_map": "none",
    "pseudo_labels": "false",
    "threshold": "0",
}


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Write NAME_overlay.png and NAME.png (class indices, 0..K-1) for every input image.

    run       run folder, config key or MLflow run id; without one, name a network and its weights:
              model=mfnet model.weights=final.pth dataset.root=/data/MFNet (scale=paper)
    input     a 4-channel PNG (R, G, B, thermal), a folder of such, or a split of the data set
    out       folder, made where it is missing
    modality  rgbt, rgb or thermal: what is predicted from; default: what the network is made for
    head      of a network with a head per domain: own, source or target
    checkpoint  best (by validation mIoU) or last, of a run
    label_map a file of conf/label_map, for a network that knows other classes than the data set:
              vistas_to_freiburg (of 66 classes), cityscapes_to_freiburg, freiburg_to_mfnet
    pseudo_labels  true: of a split, write labels/NAME.png (class indices, 255 where not sure),
              confidence/NAME.png (16 bit) and pseudo_labels.json; called again it goes on
    threshold smallest confidence of a pixel that gets a label, 0 to 1; 0: every pixel gets one
    overrides such as dataset=mfnet dataset.root=/data/MFNet
    """
    from rgbt.overview import announce_stored
    from rgbt.pseudo import label_map_of
    from rgbt.stored import open_trained

    check_choice("pseudo_labels", arguments["pseudo_labels"], ("true", "false"))
    as_labels = arguments["pseudo_labels"] == "true"
    if not as_labels and arguments["threshold"] != OWN["threshold"]:
        raise InputError(
            f"threshold={arguments['threshold']} is for pseudo_labels=true; class maps and "
            "overlays show every pixel."
        )
    label_map = label_map_of(arguments["label_map"])
    runs_dir = Path(arguments["runs_dir"])
    stored = open_trained(arguments["run"], runs_dir, overrides, arguments["checkpoint"], label_map)
    announce_stored(stored)
    if as_labels:
        _pseudo_labels(arguments, stored, label_map)
    else:
        _pictures(arguments, stored.session, label_map)
    return 0


def _pseudo_labels(arguments: dict[str, str], stored: Stored, label_map: LabelMap | None) -> None:
    from rgbt.pseudo import summary, teacher_of, write_pseudo_labels
    from rgbt.session import view_of
    from rgbt.tracking.terminal import place_lines, rich_table, show

    session, split = stored.session, arguments["input"]
    if split not in session.dataset.splits:
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

    from rgbt.engine.progress import progress
    from rgbt.session import view_of
    from rgbt.tracking.pictures import overlay

    view, head = view_of(session, arguments["modality"]), _head(arguments["head"])
    samples, total = _samples(session, arguments["input"])
    out = Path(arguments["out"])
    if out.resolve() in (
        Path(arguments["input"]).resolve(),
        Path(arguments["input"]).parent.resolve(),
    ):
        raise InputError(
            f"out={out} holds the input images, which would be overwritten; take another."
        )
    out.mkdir(parents=True, exist_ok=True)
    palette = np.array(session.dataset.palette, np.uint8)
    with progress() as display:
        task = display.add_task("predicting", total=total, note="images")
        for sample, predicted in _classes(session, samples, view, head):
            classes = predicted if label_map is None else label_map(predicted)
            painted = overlay(sample.rgb, classes, palette)
            _write(out / f"{sample.name}_overlay.png", painted[..., ::-1])
            _write(out / f"{sample.name}.png", classes)
            display.advance(task)
    print(f"{total} images in {out.resolve()}")


def _head(asked: str) -> TestedHead | None:
    from rgbt.data.domains import TestedHead

    if asked == OWN["head"]:
        return None
    check_choice("head", asked, get_args(TestedHead))
    return cast("TestedHead", asked)


def _write(path: Path, image: NDArray[np.uint8]) -> None:
    import cv2

    if not cv2.imwrite(str(path), image):
        raise InputError(f"{path} could not be written; is the folder writable, the disk full?")


def _classes(
    session: Session, samples: Iterable[Sample], view: View, head: TestedHead | None
) -> Iterator[tuple[Sample, NDArray[np.uint8]]]:
    from rgbt.data.batches import collate
    from rgbt.engine.evaluate import predictions
    from rgbt.session import heads_of

    heads = heads_of(session, view, head)
    for sample in samples:
        # One image at a time: a folder may hold images of any size.
        batch = collate([session.transform.test(sample)], "")
        for found in predictions(session.model, [batch], session.fabric, view, heads):
            yield sample, found.classes[0].numpy()


def _samples(session: Session, source: str) -> tuple[Iterator[Sample], int]:
    """The images that `source` names, and how many they are."""
    from rgbt.data.files import read_packed
    from rgbt.types import Sample

    dataset, path = session.dataset, Path(source)
    if source in dataset.splits:
        names = dataset.names(source)
        return (dataset.read(name) for name in names), len(names)
    files = sorted(path.glob("*.png")) if path.is_dir() else [path]
    if not path.exists() or not files:
        raise InputError(
            f"input={source}: expected a 4-channel PNG, a folder that holds some, or a split of "
            f"{dataset.name} ({', '.join(dataset.splits)})."
        )

    def read(file: Path) -> Sample:
        rgb, thermal = read_packed(file)
        return Sample(rgb=rgb, thermal=thermal, label=None, name=file.stem)

    return map(read, files), len(files)


if __name__ == "__main__":
    plain_command(OWN, main)()
