"""Write predictions of single images as colour overlays and PNGs of class indices."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rgbt.build.session import Session
from rgbt.checks import InputError
from rgbt.data.batches import collate
from rgbt.data.label_map import LabelMap
from rgbt.data.to_predict import ToPredict, of_files, of_path, of_split
from rgbt.engine.progress import progress
from rgbt.evaluation.prediction import Predictor
from rgbt.evaluation.request import EvaluationRequest
from rgbt.evaluation.segmentation import legend_of
from rgbt.files.atomic import write_atomic
from rgbt.tracking.pictures import overlay
from rgbt.tracking.terminal import info
from rgbt.types import Batch, Sample


def chosen_images(session: Session, source: str, rgb: str, thermal: str) -> ToPredict:
    """The images of the options ``input``, or ``rgb`` and ``thermal``.

    Raises:
        InputError: neither or both are given, or there are no such images.
    """
    if bool(rgb) != bool(thermal) or bool(source) == bool(rgb):
        given = {"input": source, "rgb": rgb, "thermal": thermal}
        raise InputError(
            "expected either input=FOLDER (or a split, or a file of four channels) or rgb=FILE "
            "thermal=FILE, got "
            + (" and ".join(key for key, value in given.items() if value) or "none")
            + " of input, rgb and thermal."
        )
    dataset = session.dataset
    if rgb:
        return of_files(dataset, Path(rgb), Path(thermal))
    if source in dataset.splits:
        return of_split(dataset, source)
    return of_path(dataset, source, session.loading.on_error)


def write_images(
    session: Session,
    images: ToPredict,
    request: EvaluationRequest,
    out: Path,
    label_map: LabelMap | None,
) -> str:
    """Write NAME_overlay.png and NAME.png of every image to `out`, with a progress bar.

    Returns:
        how many images were written, and where.

    Raises:
        InputError: an input image would be overwritten, or cannot be read.
    """
    images.check_out(out)
    legend = legend_of(session.dataset)
    predictor = Predictor(session, session.model, request)
    written = 0
    with progress() as display:
        task = display.add_task("predicting", total=len(images.names), note="images")
        for sample in images.samples(session.loading.on_error):
            classes = predictor.classes(batch_of(session, sample))[0].cpu().numpy()
            classes = classes if label_map is None else label_map(classes)
            painted = overlay(sample.rgb, classes, legend)
            write_png(out / f"{sample.name}_overlay.png", painted[..., ::-1])
            write_png(out / f"{sample.name}.png", classes)
            written += 1
            display.advance(task)
    for reason in list(images.skipped.values())[:1]:
        info(f"{len(images.skipped)} image(s) skipped; the first: {reason}")
    for path in images.others[:1]:
        info(f"{len(images.others)} image(s) belong to no pair and were not read; first: {path}")
    return f"{written} images in {out.resolve()}"


def batch_of(session: Session, sample: Sample) -> Batch:
    """One image on the device; one at a time, because images of a folder may have any sizes."""
    return collate([session.transform.test(sample)], "").to(session.fabric.device)


def write_png(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write an image of 8 or 16 bit, three channels in the order B, G, R."""
    encoded, content = cv2.imencode(".png", image)
    assert encoded, "images of 8 and 16 bit can be encoded"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, content.tobytes())
