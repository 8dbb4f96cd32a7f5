"""How images are drawn anew: neighbouring frames of a drive are no separate evidence."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, check_choice, check_range
from rgbt.metrics.metric import Absent

NamedBlocks = Literal["auto", "none", "sequence"]

MOST = 1_000_000
"""Most resamples: more take time without a visible effect."""


@dataclass(frozen=True, kw_only=True)
class Resampling:
    """Settings of intervals and tests.

    Attributes:
        resamples: number of resamples, 100..`MOST`.
        level: confidence level of the intervals, 0.5..0.999.
        blocks: what is drawn together, because neighbouring frames show nearly the same:
            "none" single images; a number: that many neighbours; "sequence": whole sequences (names
            that are equal but for one number); "auto": runs of consecutively numbered frames, cut
            where one is too long for that at the distance over which the scores of the images are
            correlated (Politis and White, 2004).
        absent: how a class without pixels scores, see `rgbt.metrics.scores`; None: as the counts
            say (`rgbt.metrics.counts.Counts.absent`).

    Raises:
        InputError: a value out of range.
    """

    resamples: int = 10_000
    level: float = 0.95
    blocks: NamedBlocks | int = "auto"
    seed: int = 0
    absent: Absent | None = None

    def __post_init__(self) -> None:
        check_range("resamples", self.resamples, 100, MOST)
        check_range("level", self.level, 0.5, 0.999)
        if self.absent is not None:
            check_choice("absent", self.absent, get_args(Absent))
        if isinstance(self.blocks, int):
            check_range("blocks", self.blocks, 1, MOST)
        elif self.blocks not in get_args(NamedBlocks):
            known = ", ".join(get_args(NamedBlocks))
            raise InputError(f"blocks={self.blocks}: expected {known} or a number of images.")


FEWEST = 10
"""Blocks below which an interval would rest on almost nothing."""

GAP = 3.0
"""Typical steps between frames of a sequence above which the next frame begins another run. In the
lists of MFNet neighbours are 1 or 3 numbers apart (a frame left out) or at least 12; in those of KP
1 or 2 steps of a recording (43 to 203 numbers), or at least 7."""

ALONE = "each image is drawn alone, as if it were independent evidence"

BAND = 1.96
"""Standard errors ``1 / sqrt(n)`` above which an autocorrelation counts as one."""


@dataclass(frozen=True)
class ImageBlocks:
    """A partition of N images.

    Attributes:
        index: (N,) int64, block 0..count-1 of every image.
        said: what they are, e.g. "40 blocks of up to 10 neighbouring frames".
        reason: of "auto", the sentence that says why these; "" for blocks that were set by hand.
    """

    index: NDArray[np.int64]
    count: int
    said: str
    reason: str = ""


class SequenceFrames(NamedTuple):
    """Images of one sequence in the order of their frames: numbers, and places in the split."""

    frames: NDArray[np.float64]
    places: NDArray[np.int64]


def make_blocks(
    names: Sequence[str], choice: NamedBlocks | int, series: NDArray[np.float64]
) -> ImageBlocks:
    """The blocks that `choice` asks for (see `Resampling.blocks`).

    Args:
        names: of N images; frames of one sequence differ in one number alone.
        choice: see `Resampling.blocks`.
        series: (L, N), influence of every image on each of L scores; read by "auto" alone, which
            takes the longest of their block lengths.

    Raises:
        InputError: fewer than `FEWEST` blocks, or names without a number where frames are asked
            for.
    """
    if choice == "none":
        return _singles(len(names))
    sequences = _sequences(names)
    if sequences is None and choice == "auto":
        reason = f"Names such as '{names[0]}' have no consecutive frame numbers; {ALONE}."
        return _singles(len(names), " (their names show no neighbours)", reason)
    if sequences is None:
        raise InputError(
            f"blocks={choice}: names such as '{names[0]}' show no neighbouring frames (names that "
            "differ in one number only); use blocks=none."
        )
    if choice == "auto":
        return _automatic(sequences, series)
    places = [each.places for each in sequences]
    if choice == "sequence":
        blocks = _joined(len(names), places, f"{len(places)} sequences")
    elif choice == 1:
        return _singles(len(names))
    else:
        blocks = _pieces(places, choice)
    if blocks.count < FEWEST:
        raise InputError(
            f"blocks={choice}: {len(names)} images make {blocks.said}, but an interval needs at "
            f"least {FEWEST}; use shorter blocks, or blocks=auto."
        )
    return blocks


def block_length(series: NDArray[np.float64], sequences: Sequence[NDArray[np.int64]]) -> int:
    """Neighbours to draw together, so that resampling sees their correlation.

        b = (2 G^2 / D)^(1/3) n^(1/3),  G = sum |k| w(k) R(k),  D = 4/3 (sum w(k) R(k))^2

    with the autocovariances R over lags k within sequences and the flat-top window w, which is 1
    up to the last of the lags 1, 2, ... that are all correlated beyond chance. 1 where direct
    neighbours are not: likeness of frames shows there first.

    Source: Politis and White, Econometric Reviews 23 (2004), with the correction of Patton,
    Politis and White (2009). Their rule for the window looks at any lag, with a bound that at 100
    images passes over correlations of 0.28; this one is for frames.

    Args:
        series: (N,) a value of every image.
        sequences: places of the images of each sequence, in the order of their frames.

    Returns:
        at least 1.
    """
    count = len(series)
    centred = series - series.mean()
    covered = math.ceil(math.sqrt(count)) + 5

    def autocovariance(lag: int) -> float:
        """Of pairs `lag` frames apart in one sequence, over the number of all images."""
        long = [centred[each] for each in sequences if len(each) > lag]
        return float(sum(each[: len(each) - lag] @ each[lag:] for each in long)) / count

    lags = np.array([autocovariance(lag) for lag in range(covered + 1)])
    if lags[0] <= 0:
        return 1
    above = lags[1:] / lags[0] > BAND / math.sqrt(count)
    last = len(above) if above.all() else int(np.argmin(above))
    if last == 0:
        return 1
    steps = np.arange(1, min(2 * last, covered) + 1)
    weights = np.minimum(1.0, 2.0 * (1.0 - steps / steps[-1]))
    long_run = lags[0] + 2.0 * (weights * lags[steps]).sum()
    slope = 2.0 * (weights * steps * lags[steps]).sum()
    if long_run <= 0:
        return 1
    length = (2.0 * slope**2 / (4.0 / 3.0 * long_run**2)) ** (1 / 3) * count ** (1 / 3)
    return max(1, math.ceil(float(length)))


def _automatic(sequences: Sequence[SequenceFrames], series: NDArray[np.float64]) -> ImageBlocks:
    """Runs of consecutive frames, or pieces of them where one run is too long for that."""
    runs = []
    for frames, places in sequences:
        steps = np.diff(frames)
        far = steps > GAP * np.median(steps) if len(steps) else steps
        runs += np.split(places, np.flatnonzero(far) + 1)
    sizes = [len(run) for run in runs]
    count, longest = sum(sizes), max(sizes)
    said = f"{len(runs)} run{'s' * (len(runs) > 1)} of consecutive numbers ({_range(sizes)} images)"
    if longest * FEWEST <= count:
        shown = f"{len(runs)} blocks of {_range(sizes)} neighbouring frames"
        return _joined(count, runs, shown, f"The names form {said}; each is one block.")
    reason = f"The names form {said}, one of them more than 1/{FEWEST} of all images"
    length = max(block_length(_levelled(each, sequences), runs) for each in series)
    while length > 1 and sum(math.ceil(size / length) for size in sizes) < FEWEST:
        length -= 1
    if length <= 1:
        reason += f"; scores of neighbours are not shown to be correlated, {ALONE}."
        return _singles(count, reason=reason)
    reason += f"; they are cut at {length}, the distance over which scores are correlated."
    return replace(_pieces(runs, length), reason=reason)


def _levelled(
    series: NDArray[np.float64], sequences: Sequence[SequenceFrames]
) -> NDArray[np.float64]:
    """(N,) without the mean of each sequence.

    Sequences whose names differ in a word, such as the days and nights of one data set, may score
    at different levels. That would look like a correlation between all frames of each of them.
    """
    levelled = series.copy()
    for _, places in sequences:
        levelled[places] -= series[places].mean()
    return levelled


def _range(sizes: Sequence[int]) -> str:
    """For example "2 to 20", or "10" where all are equal."""
    least, most = min(sizes), max(sizes)
    return str(most) if least == most else f"{least} to {most}"


def _sequences(names: Sequence[str]) -> list[SequenceFrames] | None:
    """The frames of every sequence; None where names tell no neighbours.

    The frame is the last number in the names that is not the same in all of them; names that are
    equal but for it are one sequence.
    """
    words = [re.split(r"(\d+)", name) for name in names]
    shapes: dict[tuple[str, ...], list[int]] = {}
    for place, parts in enumerate(words):
        shapes.setdefault(tuple(parts[::2]), []).append(place)
    if () in {shape[1:] for shape in shapes}:
        return None
    found: dict[tuple[str, ...], list[tuple[int, int]]] = {}
    for places in shapes.values():
        numbers = range(1, len(words[places[0]]), 2)
        varied = [at for at in numbers if len({words[place][at] for place in places}) > 1]
        frame = varied[-1] if varied else numbers[-1]
        for place in places:
            rest = (*words[place][:frame], *words[place][frame + 1 :])
            found.setdefault(rest, []).append((int(words[place][frame]), place))
    if all(len(frames) == 1 for frames in found.values()):
        return None
    ordered = (zip(*sorted(frames), strict=True) for frames in found.values())
    return [
        SequenceFrames(np.array(frames, np.float64), np.array(places, np.int64))
        for frames, places in ordered
    ]


def _pieces(sequences: Sequence[NDArray[np.int64]], length: int) -> ImageBlocks:
    """Sequences cut into pieces of nearly equal size, at most `length` each."""
    pieces = [
        piece for each in sequences for piece in np.array_split(each, math.ceil(len(each) / length))
    ]
    said = f"{len(pieces)} blocks of up to {max(map(len, pieces))} neighbouring frames"
    return _joined(sum(map(len, sequences)), pieces, said)


def _joined(
    count: int, pieces: Sequence[NDArray[np.int64]], said: str, reason: str = ""
) -> ImageBlocks:
    index = np.empty(count, np.int64)
    for number, piece in enumerate(pieces):
        index[piece] = number
    return ImageBlocks(index, len(pieces), said, reason)


def _singles(count: int, remark: str = "", reason: str = "") -> ImageBlocks:
    return ImageBlocks(np.arange(count), count, f"{count} single images{remark}", reason)
