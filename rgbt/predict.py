"""Predict images with a trained network: ``rgbt predict run=... input=... out=folder``.

The command writes a colour overlay and a PNG of class indices for every image. With
pseudo_labels=true it writes labels and confidences of a split instead, to train other networks on
(`rgbt.evaluation.pseudo_labels`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rgbt.checks import InputError
from rgbt.config.common_options import (
    CorruptionName,
    Head,
    Modality,
    NetworkOptions,
    Severity,
)
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand


@dataclass(frozen=True, kw_only=True)
class Options(NetworkOptions):
    """Options of the command."""

    out: Annotated[Path, Help("folder for the predictions, created if it is missing")]
    input: Annotated[
        str,
        Help(
            "one of: a folder of new images with the layout of the run's data set; a folder with "
            "subfolders rgb and thermal of equal file names; a PNG of four channels (R, G, B, "
            "thermal) or a folder of such files; a split of the data set. Labels are not needed"
        ),
    ] = ""
    rgb: Annotated[str, Help("RGB file of one pair; use it with thermal, instead of input")] = ""
    thermal: Annotated[str, Help("thermal file of the pair")] = ""
    modality: Modality = "default"
    head: Head = "as trained"
    corruption: CorruptionName = "none"
    severity: Severity = ""
    label_map: Annotated[
        str,
        Help(
            "map of classes, a file of conf/label_map, for a network that was trained on other "
            "classes than those of the data set: vistas_to_freiburg (66 classes), "
            "cityscapes_to_freiburg, freiburg_to_mfnet"
        ),
    ] = "none"
    pseudo_labels: Annotated[
        bool,
        Help(
            "true: write labels/NAME.png (class indices, 255 below the threshold), "
            "confidence/NAME.png (16 bit) and pseudo_labels.json for a split; rerun the command "
            "to resume"
        ),
    ] = False
    threshold: Annotated[
        float,
        Help("smallest confidence, 0 to 1, at which a pixel gets a label; 0: every pixel gets one"),
    ] = 0.0


def main(options: Options, overrides: list[str]) -> int:
    """Write NAME_overlay.png and NAME.png (class indices, 0..K-1) for every input image.

    Overrides such as dataset=mfnet dataset.root=/data/MFNet, and settings of the corruption:
    corruption.block=16 corruption.seed=1
    """
    from rgbt.evaluation import pseudo_labels
    from rgbt.evaluation.corruption_request import requested_corruption, split_overrides
    from rgbt.evaluation.images import chosen_images, write_images
    from rgbt.evaluation.request import EvaluationRequest, NetworkRequest
    from rgbt.tracking.terminal import path_lines, print_rich, rich_table
    from rgbt.training.overview import announce_network

    if not options.pseudo_labels and options.threshold:
        raise InputError(
            f"threshold={options.threshold:g} requires pseudo_labels=true; class maps and "
            "overlays always show every pixel."
        )
    if options.pseudo_labels and options.corruption != "none":
        raise InputError(
            f"corruption={options.corruption} has no effect on pseudo-labels, which are made of "
            "clean images; omit one of corruption= and pseudo_labels=."
        )
    label_map = pseudo_labels.label_map_of(options.label_map)
    labelling = pseudo_labels.Labelling(options.threshold, label_map)
    request = EvaluationRequest.from_options(options.input, options.modality, options.head)
    words, overrides = split_overrides(overrides)
    network = NetworkRequest(options, overrides)
    corruption = requested_corruption(options.corruption, options.severity, words, network.trust)
    opened = network.open(label_map)
    announce_network(opened)
    session, out = opened.session, options.out
    if not options.pseudo_labels:
        images = chosen_images(session, options.input, options.rgb, options.thermal)
        if corruption is not None:
            images = corruption.images(images, session, options.input)
        print(write_images(session, images, request, out, label_map))
        return 0
    splits = session.dataset.splits
    if request.split not in splits or options.rgb or options.thermal:
        raise InputError(
            f"input={request.split}: pseudo_labels=true requires a split of "
            f"{session.dataset.name} as input, one of: {', '.join(splits)}."
        )
    teacher = opened.folder.parent.name if options.run else opened.label
    labels = pseudo_labels.write_pseudo_labels(session, teacher, request, labelling, out)
    print_rich(rich_table(pseudo_labels.summary(labels)))
    print_rich(path_lines([("pseudo-labels", str(labels.folder.resolve()))]))
    return 0


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
