"""Blocks of images that are resampled together."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pytest

from analysis.uncertainty.blocks import Resampling, block_length, make_blocks
from rgbt.checks import InputError
from rgbt.metrics.counts import FEWEST

ROOT = Path(__file__).resolve().parents[3]
LISTS = Path(os.environ.get("RGBT_SHARED", ROOT.parent / "shared")) / "realdata"


def mfnet(count: int, letter: str = "D") -> list[str]:
    return [f"{number:05d}{letter}" for number in range(1, count + 1)]


def numbered(*runs: tuple[int, int]) -> list[str]:
    """Names of runs of consecutive numbers, each from its first to before its last."""
    return [f"{number:05d}D" for first, last in runs for number in range(first, last)]


def autoregressive(rng: np.random.Generator, count: int, keeps: float) -> np.ndarray:
    values = rng.normal(size=count)
    for place in range(1, count):
        values[place] += keeps * values[place - 1]
    return values


def politis_white(series: np.ndarray) -> int:
    """The circular block length of one series, loop by loop from the paper's Section 3.2.

    But for the window, whose m is the last of the lags 1, 2, ... that are all correlated more than
    1.96 / sqrt(n). The formula has no meaning where the estimated spectrum at 0 is not positive: 1.
    """
    n = len(series)
    centred = series - series.mean()
    r_hat = [sum(centred[i] * centred[i + k] for i in range(n - k)) / n for k in range(n)]
    most, m = math.ceil(math.sqrt(n)) + 5, 0
    while m < most and r_hat[m + 1] / r_hat[0] > 1.96 / math.sqrt(n):
        m += 1
    if m == 0:
        return 1
    big_m = min(2 * m, most)

    def flat_top(t: float) -> float:
        return 1.0 if abs(t) <= 0.5 else max(0.0, 2 * (1 - abs(t)))

    lags = range(-big_m, big_m + 1)
    g_hat = sum(flat_top(k / big_m) * abs(k) * r_hat[abs(k)] for k in lags)
    g_zero = sum(flat_top(k / big_m) * r_hat[abs(k)] for k in lags)
    if g_zero <= 0:
        return 1
    return max(1, math.ceil((2 * g_hat**2 / (4 / 3 * g_zero**2)) ** (1 / 3) * n ** (1 / 3)))


@pytest.mark.parametrize("keeps", [0.0, 0.3, 0.6, 0.9, -0.5])
def test_length_is_that_of_the_paper(keeps: float):
    for seed in range(6):
        series = autoregressive(np.random.default_rng(seed), 90, keeps)
        assert block_length(series, [np.arange(90)]) == politis_white(series)


def test_length_follows_the_frames_of_each_sequence():
    series = autoregressive(np.random.default_rng(0), 300, 0.9)
    length = block_length(series, [np.arange(300)])
    assert length > 5
    # The same values, in sequences of one image each: no neighbours, nothing correlated.
    assert block_length(series, [np.array([place]) for place in range(300)]) == 1
    assert block_length(np.full(50, 3.0), [np.arange(50)]) == 1


FRAMES = [f"frame{number}" for number in range(1, 41)]  # frame10 sorts before frame2 as text
VIDEOS = [f"V{v:02d}_I{frame:03d}" for v in range(12) for frame in range(11)]
SETS = [
    *numbered((1, 6), (8, 11)),  # a frame that is missing ends no run, as in MFNet
    *numbered(*((100 * k, 100 * k + 8) for k in range(1, 12))),
]
# KP: every 80th frame of one recording, every 43rd of another; 1040 numbers are a gap.
STEPS = [f"set10_V000_I{start + 80 * k:05d}" for start in (50, 1730) for k in range(9)]
STEPS += [f"set11_V{v:03d}_I{50 + 43 * k:05d}" for v in range(10) for k in range(8)]


@pytest.mark.parametrize(
    ("names", "choice", "said", "sizes"),
    [
        (mfnet(12), "none", "12 single images", [1] * 12),
        (mfnet(12), 1, "12 single images", [1] * 12),
        (FRAMES, 4, "10 blocks of up to 4 neighbouring frames", [4] * 10),
        ([f"2021_{name}_left2" for name in mfnet(40, "")], 4, "10 blocks of up to 4 nei", [4] * 10),
        (mfnet(30) + mfnet(30, "N"), 5, "12 blocks of up to 5 neighbouring", [5] * 12),
        # Pieces do not cross sequences and are nearly equal.
        (VIDEOS, 4, "36 blocks of up to 4 neighbouring frames", [3] * 12 + [4] * 24),
        (VIDEOS, "sequence", "12 sequences", [11] * 12),
        (["a", "b", "c3"], "auto", "3 single images (their names show no neighbours)", [1] * 3),
        (SETS, "auto", "12 blocks of 8 neighbouring frames", [8] * 12),
        (STEPS, "auto", "12 blocks of 8 to 9 neighbouring frames", [8] * 10 + [9] * 2),
    ],
)
def test_blocks_are_neighbours_of_one_sequence(names, choice, said: str, sizes: list[int]):
    shuffled = np.random.default_rng(0).permutation(names).tolist()
    blocks = make_blocks(shuffled, choice)
    assert blocks.said.startswith(said)
    if choice == "auto":
        assert ("as if it were independent" in blocks.reason) == ("single" in said)
    found = [np.array(shuffled)[blocks.index == n].tolist() for n in range(blocks.count)]
    assert sorted(map(len, found)) == sizes
    for block in found:
        places = sorted(names.index(name) for name in block)
        assert places == list(range(places[0], places[0] + len(block)))


@pytest.mark.parametrize(
    ("names", "choice", "word"),
    [
        ([f"{c}_{n}" for n, c in enumerate("abcdefghijklm")], 5, "show no neighbouring frames"),
        (mfnet(100), 20, "blocks=20: 100 images make 5 blocks of up to 20"),
    ],
)
def test_blocks_that_cannot_be_made_are_refused(names: list[str], choice, word: str):
    with pytest.raises(InputError, match=word):
        make_blocks(names, choice)


def test_auto_cuts_runs_of_which_one_is_too_long():
    """The test part of MFNet: one run by day and one at night."""
    names, rng = [*mfnet(205), *mfnet(188, "N")], np.random.default_rng(0)
    alike = np.concatenate([autoregressive(rng, count, 0.8) for count in (205, 188)])
    blocks = make_blocks(names, "auto", np.stack([rng.normal(size=393), alike]))
    assert 20 < blocks.count < 150  # the longest length of the two series
    assert blocks.reason.startswith(
        "The names form 2 runs of consecutive numbers (188 to 205 images), one of them more than "
        "1/10 of all images; they are cut at "
    )
    alone = make_blocks(names, "auto", rng.normal(size=(1, 393)))
    assert alone.said == "393 single images"
    assert "not shown to be correlated, each image is drawn alone" in alone.reason
    assert make_blocks(mfnet(40), "auto", np.arange(40.0)[None]).count == FEWEST
    # Without thermal, all nights score low: independent images, two levels.
    levels = rng.normal(size=393) + np.repeat([4.0, -4.0], (205, 188))
    assert make_blocks(names, "auto", levels[None]).said == "393 single images"


@pytest.mark.parametrize("choice", ["auto", 5, "none"])
def test_no_block_holds_images_of_two_strata(choice):
    """Days and nights in one sequence; every resample keeps the number of blocks of both."""
    names = numbered(*((100 * k, 100 * k + 10) for k in range(1, 13)))
    night = np.array([place % 20 >= 10 for place in range(120)])
    night[0] = True  # one frame of a day
    blocks = make_blocks(names, choice, strata=night)
    assert all(len(set(night[blocks.index == number])) == 1 for number in range(blocks.count))
    at_night = [bool(night[blocks.index == number][0]) for number in range(blocks.count)]
    assert at_night == sorted(at_night)
    assert blocks.sizes == (at_night.count(False), at_night.count(True))
    drawn = next(blocks.draws(Resampling(resamples=100)))
    assert (drawn[:, : blocks.sizes[0]].sum(1) == blocks.sizes[0]).all()
    assert (drawn[:, blocks.sizes[0] :].sum(1) == blocks.sizes[1]).all()
    np.testing.assert_array_equal(
        blocks.summed(night), np.bincount(blocks.index, weights=night, minlength=blocks.count)
    )


@pytest.mark.skipif(not LISTS.is_dir(), reason="the lists of names are not there")
@pytest.mark.parametrize(
    ("name", "runs"),
    [
        ("mfnet_names/train", "6 runs of consecutive numbers (2 to 384 images)"),
        ("kp_names/train_day", "20 runs of consecutive numbers (4 to 28 images)"),
        ("kp_names/test", "9 runs of consecutive numbers (20 to 52 images)"),
    ],
)
def test_auto_on_the_lists_of_mfnet_and_kp(name: str, runs: str):
    """Measured: gaps inside runs of at most 3 numbers or 2 steps, between runs of 12 or 7."""
    names = (LISTS / f"{name}.txt").read_text().split()
    assert runs in make_blocks(names, "auto").reason
