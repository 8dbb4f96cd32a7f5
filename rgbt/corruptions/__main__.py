"""Draw corruptions of one pair: ``python -m rgbt.corruptions dataset=synth out=sheet.png``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rgbt.checks import InputError, nearest
from rgbt.config.command import built, plain_command

if TYPE_CHECKING:
    from rgbt.data.dataset import LabelledDataset

OWN = {"out": "", "corruptions": "", "split": "test", "name": ""}
SUFFIXES = (".png", ".jpg")
POSITION = 11
"""Of the sample in its split: late enough for a delay of ten frames."""


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Draw a pair under every severity of the corruptions: RGB left, thermal right.

    out       picture to write, .png or .jpg
    corruptions  files of conf/corruption with commas, such as frozen,noise:rgb, or all; default:
              those of one image alone are left out where both can be corrupted
    split     split of the data set, whose order tells earlier frames
    name      of the sample; default: the twelfth of the split
    overrides such as dataset=mfnet dataset.root=/data/MFNet (default: the embedded data), of the
              draws corruption.seed=1
    """
    from rgbt.evaluation.corruption_request import (
        choose_corruptions,
        split_overrides,
        standard_corruptions,
    )
    from rgbt.evaluation.corruption_sheet import draw, sheet

    path = _path(arguments["out"])
    words, overrides = split_overrides(overrides)
    known = standard_corruptions()
    usual = [name for name in known if name.partition(":")[0] not in known or ":" not in name]
    chosen = choose_corruptions(arguments["corruptions"] or ",".join(usual), words)
    dataset: LabelledDataset = built("dataset", overrides)
    listed = dataset.names(arguments["split"])
    name = arguments["name"] or listed[min(POSITION, len(listed) - 1)]
    if name not in listed:
        near = nearest(name, listed[:20])
        raise InputError(f"name={name}: split '{arguments['split']}' has no such sample; {near}.")
    kinds = [each.corruption for each in chosen]
    lines = sheet(dataset, kinds, name, arguments["split"], chosen[0].seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    draw(lines).savefig(path, dpi=95)
    print(path)
    return 0


def _path(out: str) -> Path:
    path = Path(out).expanduser()
    if path.suffix not in SUFFIXES:
        raise InputError(f"out must name the picture to write, .png or .jpg, got '{out}'.")
    return path


if __name__ == "__main__":
    plain_command(OWN, main)()
