"""Export a trained network: ``rgbt export run=runs/KEY out=model.onnx``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Interval

from rgbt.checks import InputError
from rgbt.config.common_options import Head, Modality, NetworkOptions, Split
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.ranges import Pixels


@dataclass(frozen=True, kw_only=True)
class Options(NetworkOptions):
    """Options of the command."""

    out: Annotated[Path, Help("new file NAME.onnx; no existing file is overwritten")]
    modality: Modality = "default"
    head: Head = "as trained"
    image_hw: Annotated[
        tuple[Pixels, Pixels] | Literal["dynamic"] | None,
        Help(
            "height and width of the images of the graph; default: those of most images after the "
            "transform; dynamic: open, where the network computes the same at any size"
        ),
    ] = None
    split: Split = "test"
    images: Annotated[int, Interval(ge=1, le=100_000), Help("images that are compared")] = 20
    tolerance: Annotated[
        float,
        Interval(ge=0, le=1),
        Help("largest difference of scores and classes, as a share; beyond it no file is written"),
    ] = 1e-3


def main(options: Options, overrides: list[str]) -> int:
    """Write a network as one ONNX graph: images in [0, 1] to class scores, normalisation inside.

    Overrides such as dataset=mfnet dataset.root=/data/MFNet prediction.scales=[1.0]
    """
    from rgbt.assembly.load_run import open_named
    from rgbt.evaluation.export import check_out, export, other_sizes
    from rgbt.evaluation.predict import Predictor, chosen
    from rgbt.terminal import path_lines, print_rich
    from rgbt.training.report import announce_network

    if options.exported is not None:
        raise InputError(f"exported={options.exported} is exported already; use run=...")
    check_out(options.out)
    view, head = chosen(options.modality, options.head)
    session = open_named(options, overrides)
    predictor = Predictor(session, view, head)
    session.dataset.names(options.split)
    announce_network(session)
    made, compared, sizes = export(
        predictor,
        options.out,
        options.split,
        options.image_hw,
        num_images=options.images,
        tolerance=options.tolerance,
    )
    height, width = ("height", "width") if made.dynamic else made.image_hw
    total, fitting = sum(sizes.values()), sizes.get(made.image_hw, 0)
    fits = f"{fitting} of {total} images of {options.split} are {'x'.join(map(str, made.image_hw))}"
    others = [f"{h}x{w}" for h, w in sizes if (h, w) != made.image_hw]
    refused = "" if made.dynamic or not others else ", which the file does not take"
    number, how = compared.num_images, "" if fitting else ", resized"
    if made.dynamic:
        added = other_sizes(made.image_hw)
        number -= len(added)
        how = f", one also as {', '.join(f'{h}x{w}' for h, w in added)}"
    lines = [
        ("inputs", f"rgb (batch, 3, {height}, {width}), thermal (batch, 1, {height}, {width})"),
        ("scores", f"(batch, {len(made.classes)}, {height}, {width}) from {made.view}"),
        ("sizes", f"{fits}{', others ' * bool(others)}{' '.join(others[:3])}{refused}"),
        ("compared", f"{number} images of {options.split}{how}"),
        ("difference", f"{compared.difference:.3g}, largest score {compared.largest:.3g}"),
        ("same class", f"{compared.equal:.4%} of the pixels"),
        ("file", str(options.out.resolve())),
    ]
    print_rich(path_lines(lines))
    return 0


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
