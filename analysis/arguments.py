"""What the commands of the analysis are given, read in one way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rgbt.checks import InputError, check_range, nearest
from rgbt.command import built

if TYPE_CHECKING:
    from rgbt.data.mfnet import MFNet


def whole(key: str, text: str, low: int, high: int) -> int:
    """A whole number from `low` to `high`.

    Raises:
        InputError: it is none.
    """
    if not text.strip().isdecimal():
        raise InputError(f"{key}={text}: expected a whole number from {low} to {high}.")
    check_range(key, int(text), low, high)
    return int(text)


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
        if not any(key == each or key.startswith(f"{each}.") for each in known):
            raise InputError(f"'{key}' has no effect here; {nearest(key, [*own, *known])}.")


def dataset_of(overrides: Sequence[str]) -> MFNet:
    """The data set that overrides choose.

    Raises:
        InputError: wrong settings, or a data set in another layout than MFNet's.
    """
    from rgbt.data.mfnet import MFNet

    dataset = built("dataset", overrides)
    if not isinstance(dataset, MFNet):
        raise InputError(
            f"dataset: expected a data set in MFNet's layout, got {type(dataset).__name__}; choose "
            "dataset=mfnet or dataset=synth."
        )
    return dataset
