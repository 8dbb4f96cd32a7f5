"""Predict images with a trained network: ``python -m rgbt.predict run=... input=... out=folder``.

For every image a colour overlay and a PNG of class indices are written; with pseudo_labels=true
labels and confidences of a split instead, to train other networks on
(`rgbt.evaluation.pseudo_labels`).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rgbt.checks import InputError, check_choice
from rgbt.config.command import plain_command

if TYPE_CHECKING:
    from rgbt.build.load_run import TrainedNetwork
    from rgbt.evaluation.pseudo_labels import Labelling
    from rgbt.evaluation.request import EvaluationRequest

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
              confidence/NAME.png (16 bit) and pseudo_labels.json; called again it resumes
    threshold smallest confidence of a pixel that gets a label, 0 to 1; 0: every pixel gets one
    overrides such as dataset=mfnet dataset.root=/data/MFNet
    """
    from rgbt.evaluation.images import chosen_images, write_images
    from rgbt.evaluation.request import EvaluationRequest, NetworkRequest
    from rgbt.training.overview import announce_network

    labelling = _labelling(arguments)
    network = NetworkRequest.from_options(arguments, overrides)
    request = EvaluationRequest.from_options(arguments, arguments["input"])
    opened = network.open(labelling.label_map)
    announce_network(opened)
    if arguments["pseudo_labels"] == "true":
        _pseudo_labels(arguments, opened, request, labelling)
        return 0
    session, out = opened.session, Path(arguments["out"])
    images = chosen_images(session, *(arguments[key] for key in ("input", "rgb", "thermal")))
    print(write_images(session, images, request, out, labelling.label_map))
    return 0


def _labelling(arguments: dict[str, str]) -> Labelling:
    """The options of labels; InputError where they do not fit."""
    from rgbt.evaluation.pseudo_labels import Labelling, label_map_of

    check_choice("pseudo_labels", arguments["pseudo_labels"], ("true", "false"))
    threshold = arguments["threshold"]
    if arguments["pseudo_labels"] == "false" and threshold != OWN["threshold"]:
        raise InputError(
            f"threshold={threshold} is for pseudo_labels=true; class maps and overlays show every "
            "pixel."
        )
    try:
        least = float(threshold)
    except ValueError as error:
        raise InputError(f"threshold={threshold}: expected a number from 0 to 1.") from error
    return Labelling(least, label_map_of(arguments["label_map"]))


def _pseudo_labels(
    arguments: dict[str, str],
    opened: TrainedNetwork,
    request: EvaluationRequest,
    labelling: Labelling,
) -> None:
    from rgbt.evaluation.pseudo_labels import summary, teacher_of, write_pseudo_labels
    from rgbt.tracking.terminal import place_lines, rich_table, show

    session, splits = opened.session, opened.session.dataset.splits
    if request.split not in splits or arguments["rgb"] or arguments["thermal"]:
        raise InputError(
            f"input={request.split}: pseudo-labels are written of a split of "
            f"{session.dataset.name}; name one of {', '.join(splits)}."
        )
    key_or_file = opened.folder.parent.name if arguments["run"] else opened.label
    teacher = teacher_of(key_or_file, session.model)
    labels = write_pseudo_labels(session, teacher, request, labelling, Path(arguments["out"]))
    show(rich_table(summary(labels)))
    show(place_lines([("pseudo-labels", str(labels.folder.resolve()))]))


if __name__ == "__main__":
    plain_command(OWN, main)()
