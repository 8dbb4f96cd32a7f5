"""How images are drawn anew: neighbouring frames of a drive are no separate evidence."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rgbt.checks import InputError, check_choice, check_range
from rgbt.metrics.counts import FEWEST
from rgbt.metrics.metric import Absent
from rgbt.randomness import numpy_generator

NamedBlocks = Literal["auto", "none", "sequence"]
Places = NDArray[np.int64]
Values = NDArray[np.float64]

# Most resamples: more take time without a visible effect.
MOST = 1_000_000

# Most numbers in a set of draws that is kept, because many scores need the same draws.
KEPT = 2**21

# Resamples computed at once, which limits the memory that their counts take.
CHUNK = 500

# Number of typical steps between two frames above which the second one begins another run. In the
# lists of MFNet neighbours are 1 or 3 numbers apart (a frame is left out), or at least 12. In those
# of KP they are 1 or 2 steps of a recording (43 to 203 numbers) apart, or at least 7.
GAP = 3.0

ALONE = "each image is drawn alone, as if it were independent evidence"

# Standard errors ``1 / sqrt(n)`` above which an autocorrelation counts as one.
BAND = 1.96


@dataclass(frozen=True, kw_only=True)
class Resampling:
    """Settings of intervals and tests; InputError: a value out of range.

    Attributes:
        resamples: number of resamples, 100..`MOST`.
        level: confidence level of the intervals, 0.5..0.999.
        blocks: what is drawn together, because neighbouring frames show nearly the same:
            "none" single images; a number: that many neighbours; "sequence": whole sequences (names
            that are equal but for one number); "auto": runs of consecutively numbered frames, cut
            where one is too long for that at the distance over which the scores of the images are
            correlated (Politis and White, 2004).
        absent: how a class without pixels scores (`rgbt.metrics.scores`); None: as counted.
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
        else:
            check_choice("blocks", self.blocks, get_args(NamedBlocks))


@dataclass(frozen=True)
class ImageBlocks:
    """A partition of N images.

    Attributes:
        index: (N,) int64, block 0..count-1 of every image; those of one stratum follow each other.
        sizes: number of blocks of each stratum.
        said: what they are, e.g. "40 blocks of up to 10 neighbouring frames".
        reason: of "auto", the sentence that says why these; "" for blocks that were set by hand.
    """

    index: Places
    sizes: tuple[int, ...]
    said: str
    reason: str = ""

    @property
    def count(self) -> int:
        """Number of blocks."""
        return sum(self.sizes)

    def summed(self, values: NDArray[np.number]) -> Values:
        """Add (N, ...) values of images up to (B, ...) sums of blocks; whole numbers are exact."""
        order = np.argsort(self.index, kind="stable")
        starts = np.searchsorted(self.index[order], np.arange(self.count))
        return np.add.reduceat(values[order].astype(np.float64, copy=False), starts)

    def draws(self, settings: Resampling) -> Iterator[Values]:
        """Yield how often each resample draws each block, (chunk, B), for some resamples at once.

        Each stratum keeps its number of blocks.
        """
        given = self.sizes, settings.resamples, settings.seed
        is_small = self.count * settings.resamples <= KEPT
        return iter(_kept_draws(*given)) if is_small else _draws(*given)


def _draws(sizes: tuple[int, ...], resamples: int, seed: int) -> Iterator[Values]:
    rng = numpy_generator(seed, "bootstrap")
    for start in range(0, resamples, CHUNK):
        number = min(CHUNK, resamples - start)
        parts = [rng.multinomial(n, np.full(n, 1.0 / n), number) for n in sizes]
        yield np.hstack(parts).astype(np.float64)


@lru_cache(maxsize=4)
def _kept_draws(sizes: tuple[int, ...], resamples: int, seed: int) -> tuple[Values, ...]:
    return tuple(_draws(sizes, resamples, seed))


def make_blocks(
    names: Sequence[str],
    choice: NamedBlocks | int,
    series: Values | None = None,
    strata: ArrayLike | None = None,
) -> ImageBlocks:
    """Make the blocks of N images; names of one sequence differ in one number alone.

    `choice` is that of `Resampling.blocks`. "auto" alone reads `series`, (L, N), the influence of
    every image on each of L scores, and takes the longest of their block lengths. No block holds
    images of two `strata`, (N,), such as day and night; None: there is one.

    Raises:
        InputError: fewer than `FEWEST` blocks, or names without the number of a frame.
    """
    parts = np.zeros(len(names), np.int64) if strata is None else np.asarray(strata, np.int64)
    singles, said = [*np.arange(len(names))[:, None]], f"{len(names)} single images"
    if choice in ("none", 1):
        return _joined(singles, parts, said)
    sequences = _sequences(tuple(names), tuple(parts.tolist()))
    if not sequences:
        such = f"names such as '{names[0]}' show no neighbouring frames (that differ in one number)"
        if choice != "auto":
            raise InputError(f"blocks={choice}: {such}; use blocks=none.")
        said, reason = f"{said} (their names show no neighbours)", f"N{such[1:]}; {ALONE}."
        return _joined(singles, parts, said, reason)
    if choice == "auto":
        none = np.empty((0, len(names)))
        pieces, sizes, reason = _automatic(sequences, none if series is None else series)
        found = f"{len(pieces)} blocks of {sizes} neighbouring frames" if pieces else said
        return _joined(pieces or singles, parts, found, reason)
    if isinstance(choice, int):
        pieces = _cut([places for _, places in sequences], choice)
        said = f"{len(pieces)} blocks of up to {max(map(len, pieces))} neighbouring frames"
    else:
        pieces = [places for _, places in sequences]
        said = f"{len(pieces)} sequences"
    if len(pieces) < FEWEST:
        raise InputError(
            f"blocks={choice}: {len(names)} images make {said}, but an interval needs at least "
            f"{FEWEST}; use shorter blocks, or blocks=auto."
        )
    return _joined(pieces, parts, said)


def block_length(series: Values, sequences: Sequence[Places]) -> int:
    """Return how many neighbours to draw together, so that resampling sees their correlation.

        b = (2 G^2 / D)^(1/3) n^(1/3),  G = sum |k| w(k) R(k),  D = 4/3 (sum w(k) R(k))^2

    with the autocovariances R over lags k within sequences and the flat-top window w, which is 1
    up to the last of the lags 1, 2, ... that are all correlated beyond chance. 1 where direct
    neighbours are not: likeness of frames shows there first.

    Source: Politis and White, Econometric Reviews 23 (2004), with the correction of Patton,
    Politis and White (2009). Their rule for the window looks at any lag, with a bound that at 100
    images passes over correlations of 0.28; this one is for frames.

    `series` are (N,) values of the images, `sequences` the places of the images of each sequence in
    the order of their frames. The length is 1 or more.
    """
    count = len(series)
    centred = series - series.mean()
    covered = math.ceil(math.sqrt(count)) + 5

    def autocovariance(lag: int) -> float:
        """Divide the sum over pairs `lag` frames apart in one sequence by the number of images."""
        total = 0.0
        for places in sequences:
            if len(places) > lag:
                along = centred[places]
                total += along[: len(along) - lag] @ along[lag:]
        return float(total) / count

    lags = np.array([autocovariance(lag) for lag in range(covered + 1)])
    above = lags[1:] > BAND / math.sqrt(count) * lags[0]
    last = len(above) if above.all() else int(np.argmin(above))
    if lags[0] <= 0 or last == 0:
        return 1
    steps = np.arange(1, min(2 * last, covered) + 1)
    weights = np.minimum(1.0, 2.0 * (1.0 - steps / steps[-1]))
    long_run = lags[0] + 2.0 * (weights * lags[steps]).sum()
    slope = 2.0 * (weights * steps * lags[steps]).sum()
    if long_run <= 0:
        return 1
    length = (2.0 * slope**2 / (4.0 / 3.0 * long_run**2)) ** (1 / 3) * count ** (1 / 3)
    return max(1, math.ceil(float(length)))


def _automatic(
    sequences: Sequence[tuple[Values, Places]], series: Values
) -> tuple[list[Places], str, str]:
    """Find runs of consecutive frames, or pieces ([]: single images), their sizes, the reason."""
    runs: list[Places] = []
    for frames, places in sequences:
        steps = np.diff(frames)
        far = steps > GAP * np.median(steps) if len(steps) else steps
        runs += np.split(places, np.flatnonzero(far) + 1)
    count, longest = sum(map(len, runs)), max(map(len, runs))
    plural = "s" * (len(runs) > 1)
    said = f"{len(runs)} run{plural} of consecutive numbers ({_range(runs)} images)"
    if longest * FEWEST <= count:
        return runs, _range(runs), f"The names form {said}; each is one block."
    # Sequences, such as days and nights, may score at different levels, which would look like a
    # correlation between all frames of each of them.
    levelled = series.copy()
    for _, places in sequences:
        levelled[:, places] -= levelled[:, places].mean(1, keepdims=True)
    length = max((block_length(scores, runs) for scores in levelled), default=1)
    while length > 1 and len(_cut(runs, length)) < FEWEST:
        length -= 1
    reason = f"The names form {said}, one of them more than 1/{FEWEST} of all images"
    if length <= 1:
        return [], "", f"{reason}; scores of neighbours are not shown to be correlated, {ALONE}."
    cut = f"they are cut at {length}, the distance over which scores are correlated"
    pieces = _cut(runs, length)
    return pieces, f"up to {max(map(len, pieces))}", f"{reason}; {cut}."


def _range(pieces: Sequence[Places]) -> str:
    """Say the sizes of the pieces, for example "2 to 20", or "10" where all are equal."""
    least, most = min(map(len, pieces)), max(map(len, pieces))
    return str(most) if least == most else f"{least} to {most}"


@lru_cache(maxsize=32)
def _sequences(names: tuple[str, ...], parts: tuple[int, ...]) -> list[tuple[Values, Places]]:
    """Find the frames of every sequence, numbers and places in their order; [] if there is none.

    The frame is the last number in the names that is not the same in all of them; names that are
    equal but for it, and lie in one stratum, are one sequence. Callers share the list, because many
    contrasts are about the same images.
    """
    words = [re.split(r"(\d+)", name) for name in names]
    shapes: dict[tuple[str, ...], list[int]] = {}
    for place, texts in enumerate(words):
        shapes.setdefault(tuple(texts[::2]), []).append(place)
    if any(len(shape) == 1 for shape in shapes):
        return []
    found: dict[tuple[object, ...], list[tuple[int, int]]] = {}
    for places in shapes.values():
        numbers = range(1, len(words[places[0]]), 2)
        varied = [at for at in numbers if len({words[place][at] for place in places}) > 1]
        frame = varied[-1] if varied else numbers[-1]
        for place in places:
            rest = (parts[place], *words[place][:frame], *words[place][frame + 1 :])
            found.setdefault(rest, []).append((int(words[place][frame]), place))
    if all(len(frames) == 1 for frames in found.values()):
        return []
    sequences = []
    for frames in found.values():
        numbers_in_order, places_in_order = np.array(sorted(frames)).T
        sequences.append((numbers_in_order.astype(np.float64), places_in_order))
    return sequences


def _cut(sequences: Sequence[Places], length: int) -> list[Places]:
    """Cut sequences into pieces of nearly equal size, at most `length`."""
    pieces: list[Places] = []
    for places in sequences:
        pieces += np.array_split(places, math.ceil(len(places) / length))
    return pieces


def _joined(pieces: Sequence[Places], parts: Places, said: str, reason: str = "") -> ImageBlocks:
    """Number the pieces as blocks, stratum by stratum."""
    ordered = sorted(pieces, key=lambda piece: parts[piece[0]])
    index = np.empty(len(parts), np.int64)
    for number, piece in enumerate(ordered):
        index[piece] = number
    sizes = np.unique([parts[piece[0]] for piece in ordered], return_counts=True)[1]
    return ImageBlocks(index, tuple(sizes.tolist()), said, reason)
