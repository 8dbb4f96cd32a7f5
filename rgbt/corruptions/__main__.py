"""Draw degradations of one pair: ``python -m rgbt.corruptions dataset=synth out=sheet.png``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rgbt.checks import InputError, nearest
from rgbt.config.command import built
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand

if TYPE_CHECKING:
    from rgbt.data.dataset import LabelledDataset

SUFFIXES = (".png", ".jpg")
PLACE = 11
"""Of the sample in its split: late enough for a delay of ten frames."""

BOTH = ("occluded", "noise", "blur")
"""Kinds that have files of RGB alone and of thermal alone beside them."""


@dataclass(frozen=True)
class Options:
    """What is drawn."""

    out: Annotated[str, Help("picture to write, .png or .jpg")] = ""
    degradations: Annotated[
        str,
        Help(
            "files of conf/degradation with commas, or all; default: those of one image alone are "
            "left out where both can fail"
        ),
    ] = ""
    split: Annotated[
        str, Help("split of the data set, whose order says which frames are earlier")
    ] = "test"
    name: Annotated[str, Help("of the sample; default: the twelfth of the split")] = ""


def main(options: Options, overrides: list[str]) -> int:
    """Draw a pair under every severity of the degradations: RGB left, thermal right.

    Overrides choose the data set, dataset=mfnet dataset.root=/data/MFNet (default: the embedded
    data), and what is drawn at random, degradation.seed=1
    """
    from rgbt.corruptions.sheet import draw, sheet
    from rgbt.evaluation.corrupted import known_degradations, own_words
    from rgbt.robustness import chosen_of

    path = _path(options.out)
    words, overrides = own_words(overrides)
    names = options.degradations or ",".join(
        name for name in known_degradations() if not name.startswith(tuple(f"{b}_" for b in BOTH))
    )
    chosen = chosen_of(names, words)
    dataset: LabelledDataset = built("dataset", overrides)
    listed = dataset.names(options.split)
    name = options.name or listed[min(PLACE, len(listed) - 1)]
    if name not in listed:
        near = nearest(name, listed[:20])
        raise InputError(f"name={name}: split '{options.split}' has no such sample; {near}.")
    kinds = [each.degradation for each in chosen]
    lines = sheet(dataset, kinds, name, options.split, chosen[0].seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    draw(lines).savefig(path, dpi=95)
    print(path)
    return 0


def _path(out: str) -> Path:
    path = Path(out).expanduser()
    if path.suffix not in SUFFIXES:
        raise InputError(f"out must name the picture to write, .png or .jpg, got '{out}'.")
    return path


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
