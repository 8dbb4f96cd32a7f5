"""Predict images with a trained network: ``rgbt predict run=... input=... out=folder``.

It writes a colour overlay and a PNG of class indices for every image, or pseudo-labels of a split.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Interval

from rgbt.checks import InputError, check_choice
from rgbt.config.common_options import CorruptionName, Head, Modality, NetworkOptions, Severity
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand


@dataclass(frozen=True, kw_only=True)
class Options(NetworkOptions):
    """Options of the command."""

    out: Annotated[Path, Help("folder for the predictions, created if it is missing")]
    input: Annotated[
        str,
        Help(
            "a folder of new images with the layout of the run's data set, or with subfolders rgb "
            "and thermal of equal file names; a PNG of four channels (R, G, B, thermal) or a "
            "folder of such files; a split of the data set. Labels are not needed"
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
        Help("file of conf/label_map, for a network that was trained on other classes"),
    ] = "none"
    pseudo_labels: Annotated[
        bool,
        Help(
            "true: write labels/NAME.png (class indices, 255 below the threshold), "
            "confidence/NAME.png (16 bit) and pseudo_labels.json for a split"
        ),
    ] = False
    threshold: Annotated[
        float,
        Interval(ge=0, le=1),
        Help("smallest confidence, 0 to 1, at which a pixel gets a label; 0: every pixel gets one"),
    ] = 0.0


def main(options: Options, overrides: list[str]) -> int:
    """Write NAME_overlay.png and NAME.png (class indices, 0..K-1) for every input image.

    Overrides such as dataset=mfnet dataset.root=/data/MFNet, and settings of the corruption:
    corruption.block=16 corruption.seed=1
    """
    from rgbt.assembly.load_run import open_named
    from rgbt.config.corruption_node import split_overrides
    from rgbt.config.stored_config import parse_trust
    from rgbt.evaluation import images
    from rgbt.evaluation.corruption import corrupted_images, requested_corruption
    from rgbt.evaluation.measure import measurement_of
    from rgbt.evaluation.predict import Predictor, chosen
    from rgbt.terminal import path_lines, print_rich, rich_table
    from rgbt.training.report import announce_network

    is_labelling, out = options.pseudo_labels, options.out
    if options.threshold and not is_labelling:
        raise InputError(f"threshold={options.threshold:g} requires pseudo_labels=true.")
    if is_labelling and (options.corruption != "none" or options.rgb or options.thermal):
        raise InputError("pseudo_labels=true predicts the clean images of a split, input=SPLIT.")
    label_map = images.label_map_of(options.label_map)
    view, head = chosen(options.modality, options.head)
    words, overrides = split_overrides(overrides)
    given = options.corruption, options.severity, words, parse_trust(options.trust)
    corruption = requested_corruption(*given)
    opened = open_named(options, overrides, label_map=label_map)
    predictor = Predictor(opened, view, head)
    if not is_labelling:
        found = images.chosen_images(opened, options.input, options.rgb, options.thermal)
        found.check_out(out)
        announce_network(opened)
        if corruption is not None:
            found = corrupted_images(found, opened, *corruption, options.input)
        print(images.write_images(opened, found, predictor, out, label_map))
        return 0
    check_choice("input", options.input, opened.dataset.splits)
    images.check_empty(out)
    announce_network(opened)
    labels = images.write_pseudo_labels(
        opened,
        measurement_of(opened, options.input, view, head),
        out,
        threshold=options.threshold,
        label_map=label_map,
    )
    print_rich(rich_table(images.labels_table(labels)))
    print_rich(path_lines([("pseudo-labels", str(labels.folder.resolve()))]))
    return 0


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
