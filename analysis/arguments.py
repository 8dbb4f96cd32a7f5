"""What the commands of the analysis are given, read in one way."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

from rgbt.checks import InputError, check_range, nearest
from rgbt.config.command import built

if TYPE_CHECKING:
    from analysis.uncertainty.settings import NamedBlocks
    from rgbt.dataset import LabelledDataset

MOST = 1_000_000
"""What a count may be, where nothing else limits it."""


def whole(key: str, text: str, low: int, high: int) -> int:
    """A whole number from `low` to `high`.

    Raises:
        InputError: it is none.
    """
    # Longer ones Python does not even read.
    if not text.strip().isdecimal() or len(text) > 18:
        raise InputError(f"{key}={text}: expected a whole number from {low} to {high}.")
    check_range(key, int(text), low, high)
    return int(text)


def blocks_of(text: str) -> NamedBlocks | int:
    """A number of images, or a word that `Resampling` knows and checks."""
    return whole("blocks", text, 1, MOST) if text.isdecimal() else cast("NamedBlocks", text)


def out_folder(text: str) -> Path | None:
    """The folder that `out` names, None for ""; told before any work whether it can be written.

    Raises:
        InputError: it is a file or lies below one, or may not be written.
    """
    if not text:
        return None
    out = Path(text)
    there = next(each for each in (out.absolute(), *out.absolute().parents) if each.exists())
    if not there.is_dir():
        raise InputError(f"out={text}: {there} is a file; give a folder.")
    if not os.access(there, os.W_OK):
        raise InputError(f"out={text}: {there} may not be written; give another folder.")
    return out


def decimal(key: str, text: str, example: str) -> float:
    """A number.

    Raises:
        InputError: it is none; the sentence names `example`.
    """
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{key}={text}: expected a number such as {example}.") from None


def refuse_others(overrides: Sequence[str], known: Sequence[str], own: Sequence[str]) -> None:
    """Refuse overrides that the command would not heed.

    Args:
        overrides: as given.
        known: keys of the configuration that count, each with all below it.
        own: keys of the command, for the sentence.

    Raises:
        InputError: naming the first that has no effect, with the nearest key.
    """
    for word in overrides:
        key = word.lstrip("+~").partition("=")[0]
        if key == "hydra.searchpath":  # where files of a data set of one's own lie
            continue
        if not any(key == each or key.startswith(f"{each}.") for each in known):
            raise InputError(f"'{key}' has no effect here; {nearest(key, [*own, *known])}.")


def dataset_of(overrides: Sequence[str]) -> LabelledDataset:
    """The data set that overrides choose.

    Raises:
        InputError: none is chosen, or wrong settings.
    """
    # Without this the images of another data set would be scored against the embedded one.
    if not any(word.startswith("dataset=") for word in overrides):
        raise InputError(
            "the data set has to be named: dataset=mfnet dataset.root=/data/MFNet, or "
            "dataset=synth, the embedded one."
        )
    dataset: LabelledDataset = built("dataset", overrides)
    return dataset
