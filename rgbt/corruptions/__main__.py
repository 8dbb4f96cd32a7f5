"""Draw corruptions of one pair of images: ``rgbt corruptions dataset=synth out=sheet.png``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, nearest
from rgbt.config.command import built
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rgbt.dataset import LabelledDataset
    from rgbt.evaluation.request import CorruptionRequest
    from rgbt.types import Sample

SUFFIXES = (".png", ".jpg")
POSITION = 11
"""Of the sample in its split: late enough for a delay of ten frames."""

CELL = 2.4
"""Width in inches of a pair: RGB left, thermal right."""


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    out: Annotated[str, Help("picture file to write, .png or .jpg")] = ""
    corruptions: Annotated[
        str,
        Help(
            "files of conf/corruption separated by commas, such as frozen,noise:rgb, or all; by "
            "default without the variants of a single image if both can be corrupted"
        ),
    ] = ""
    split: Annotated[
        str, Help("split of the data set; its order defines which frames are earlier")
    ] = "test"
    name: Annotated[str, Help("name of the sample; default: the twelfth of the split")] = ""


def main(options: Options, overrides: list[str]) -> int:
    """Draw a pair under every severity of the corruptions: RGB left, thermal right.

    Overrides choose the data set, dataset=mfnet dataset.root=/data/MFNet (default: the embedded
    data set), and the random draws, corruption.seed=1
    """
    from rgbt.evaluation.request import (
        choose_corruptions,
        split_overrides,
        standard_corruptions,
    )

    path = Path(options.out).expanduser()
    if path.suffix not in SUFFIXES:
        raise InputError(
            f"out must be the path of a picture to write, .png or .jpg, got '{options.out}'."
        )
    words, overrides = split_overrides(overrides)
    known = standard_corruptions()
    usual = [name for name in known if name.partition(":")[0] not in known or ":" not in name]
    chosen = choose_corruptions(options.corruptions or ",".join(usual), words)
    dataset: LabelledDataset = built("dataset", overrides)
    listed = dataset.names(options.split)
    name = options.name or listed[min(POSITION, len(listed) - 1)]
    if name not in listed:
        near = nearest(name, listed[:20])
        raise InputError(
            f"name={name}: split '{options.split}' has no sample of this name; {near}."
        )
    lines = sheet(dataset, chosen, name, options.split)
    path.parent.mkdir(parents=True, exist_ok=True)
    draw(lines).savefig(path, dpi=95)
    print(path)
    return 0


def sheet(
    source: LabelledDataset, chosen: Sequence[CorruptionRequest], name: str, split: str
) -> list[list[tuple[str, Sample]]]:
    """The sample `name` with captions for every corruption: clean, then under every severity."""
    from rgbt.evaluation.request import CorruptedDataset

    lines = []
    for each in chosen:
        unit = each.corruption.unit
        pairs = [(each.corruption.title, source.read(name))]
        for level in each.ladder():
            caption = f"{level.severity:g} {unit}" if unit else ""
            pairs.append((caption, CorruptedDataset(source, level, split).read(name)))
        lines.append(pairs)
    return lines


def side_by_side(sample: Sample) -> NDArray[np.uint8]:
    """(H, 2 W, 3): RGB left, thermal right."""
    return np.hstack([sample.rgb, np.repeat(sample.thermal[..., None], 3, axis=2)])


def draw(lines: Sequence[list[tuple[str, Sample]]]) -> Figure:
    """The picture, drawn without a display."""
    from matplotlib.figure import Figure

    columns = max(map(len, lines))
    height, width = lines[0][0][1].thermal.shape
    cell_height = CELL * height / (2 * width) + 0.2
    figure = Figure(figsize=(CELL * columns, cell_height * len(lines)))
    figure.set_layout_engine("constrained", w_pad=0.01, h_pad=0.03, wspace=0.01, hspace=0.01)
    grid = figure.subplots(len(lines), columns, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for row, line in zip(grid, lines, strict=True):
        for axes, (caption, sample) in zip(row, line, strict=False):
            axes.imshow(side_by_side(sample))
            axes.set_title(caption, fontsize=7, loc="left", pad=2)
    return figure


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
