"""Export a trained network: ``rgbt export run=runs/KEY out=model.onnx``.

The command writes an ONNX file, or with out=NAME.pt2 a file of torch.export, after it compared the
exported graph with the network on images of the data set.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Interval

from rgbt.checks import InputError
from rgbt.config.common_options import Head, Modality, NetworkOptions, Split
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.ranges import Pixels


@dataclass(frozen=True, kw_only=True)
class Options(NetworkOptions):
    """Options of the command."""

    out: Annotated[
        Path,
        Help("new file: NAME.onnx, or NAME.pt2 for torch.export; no existing file is overwritten"),
    ]
    modality: Modality = "default"
    head: Head = "as trained"
    image_hw: Annotated[
        tuple[Pixels, Pixels] | None,
        Help(
            "height and width of the images of the graph; default: those of the data set after its "
            "transform. The size of the batch is free"
        ),
    ] = None
    split: Split = "test"
    images: Annotated[
        int, Interval(ge=1, le=100_000), Help("images of the split that are compared")
    ] = 20
    tolerance: Annotated[
        float,
        Interval(ge=0, le=1),
        Help(
            "largest difference of scores as a share of the largest score, and largest share of "
            "pixels with another class; beyond it no file is written"
        ),
    ] = 1e-3


def main(options: Options, overrides: list[str]) -> int:
    """Write a network as one graph: images in [0, 1] to class scores, normalisation inside.

    Inputs: rgb (batch, 3, height, width) and thermal (batch, 1, height, width), float32. Output:
    scores (batch, classes, height, width). Overrides such as dataset=mfnet
    dataset.root=/data/MFNet prediction.scales=[1.0]
    """
    from rgbt.evaluation.export import ExportRequest, check_out, export
    from rgbt.evaluation.request import EvaluationRequest, NetworkRequest
    from rgbt.tracking.terminal import path_lines, print_rich
    from rgbt.training.overview import announce_network

    if options.exported is not None:
        raise InputError(
            f"exported={options.exported} is exported already; name a run with run=..."
        )
    check_out(options.out)
    named = EvaluationRequest.from_options(options.split, options.modality, options.head)
    opened = NetworkRequest(options, overrides).open()
    announce_network(opened)
    request = ExportRequest(
        out=options.out,
        view=named.view,
        head=named.head,
        image_hw=options.image_hw,
        split=options.split,
        num_images=options.images,
        tolerance=options.tolerance,
    )
    made, compared = export(opened, request)
    height, width = made.image_hw
    lines = [
        ("inputs", f"rgb (batch, 3, {height}, {width}), thermal (batch, 1, {height}, {width})"),
        ("scores", f"(batch, {len(made.classes)}, {height}, {width}) from {made.view}"),
        ("format", f"ONNX, opset {made.opset}" if made.opset else "torch.export"),
        ("compared", f"{compared.num_images} images of {options.split}"),
        ("difference", f"{compared.difference:.3g}, largest score {compared.largest:.3g}"),
        ("same class", f"{compared.equal:.4%} of the pixels"),
        ("file", str(options.out.resolve())),
    ]
    print_rich(path_lines(lines))
    return 0


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
