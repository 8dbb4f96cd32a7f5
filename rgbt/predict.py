"""Predict images with a trained network: ``rgbt predict run=... input=... out=folder``.

For every image a colour overlay and a PNG of class indices are written; with pseudo_labels=true
labels and confidences of a split instead, to train other networks on
(`rgbt.evaluation.pseudo_labels`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rgbt.checks import InputError
from rgbt.config.common_options import Head, Modality, NetworkOptions
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand


@dataclass(frozen=True, kw_only=True)
class Options(NetworkOptions):
    """What is predicted, and how it is written."""

    out: Annotated[Path, Help("folder, created if it is missing")]
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
    modality: Modality = "default"
    head: Head = "as trained"
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
    from rgbt.evaluation import pseudo_labels
    from rgbt.evaluation.images import chosen_images, write_images
    from rgbt.evaluation.request import EvaluationRequest, NetworkRequest
    from rgbt.tracking.terminal import path_lines, print_rich, rich_table
    from rgbt.training.overview import announce_network

    if not options.pseudo_labels and options.threshold:
        raise InputError(
            f"threshold={options.threshold:g} is for pseudo_labels=true; class maps and overlays "
            "show every pixel."
        )
    label_map = pseudo_labels.label_map_of(options.label_map)
    labelling = pseudo_labels.Labelling(options.threshold, label_map)
    request = EvaluationRequest.from_options(options.input, options.modality, options.head)
    opened = NetworkRequest(options, overrides).open(label_map)
    announce_network(opened)
    session, out = opened.session, options.out
    if not options.pseudo_labels:
        images = chosen_images(session, options.input, options.rgb, options.thermal)
        print(write_images(session, images, request, out, label_map))
        return 0
    splits = session.dataset.splits
    if request.split not in splits or options.rgb or options.thermal:
        raise InputError(
            f"input={request.split}: pseudo-labels are written of a split of "
            f"{session.dataset.name}; name one of {', '.join(splits)}."
        )
    teacher = opened.folder.parent.name if options.run else opened.label
    labels = pseudo_labels.write_pseudo_labels(session, teacher, request, labelling, out)
    print_rich(rich_table(pseudo_labels.summary(labels)))
    print_rich(path_lines([("pseudo-labels", str(labels.folder.resolve()))]))
    return 0


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
