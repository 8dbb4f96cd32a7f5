"""Blocks of images that are resampled together."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pytest

from analysis.uncertainty.blocks import (
    FEWEST,
    ImageBlocks,
    Resampling,
    block_length,
    make_blocks,
)
from rgbt.checks import InputError

NOTHING = np.empty((0, 0))
ROOT = Path(__file__).resolve().parents[3]
LISTS = Path(os.environ.get("RGBT_SHARED", ROOT.parent / "shared")) / "realdata"


def members(blocks: ImageBlocks, names: list[str]) -> set[frozenset[str]]:
    assert blocks.index.shape == (len(names),)
    assert set(blocks.index.tolist()) == set(range(blocks.count))
    return {
        frozenset(np.array(names)[blocks.index == number].tolist())
        for number in range(blocks.count)
    }


def mfnet(count: int, letter: str = "D") -> list[str]:
    return [f"{number:05d}{letter}" for number in range(1, count + 1)]


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
    most = math.ceil(math.sqrt(n)) + 5
    m = 0
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
    d_hat = 4 / 3 * g_zero**2
    length = (2 * g_hat**2 / d_hat) ** (1 / 3) * n ** (1 / 3)
    return max(1, math.ceil(length))


@pytest.mark.parametrize("keeps", [0.0, 0.3, 0.6, 0.9, -0.5])
@pytest.mark.parametrize("count", [60, 393])
def test_length_is_that_of_the_paper(keeps: float, count: int):
    for seed in range(4):
        series = autoregressive(np.random.default_rng(seed), count, keeps)
        assert block_length(series, [np.arange(count)]) == politis_white(series)


def test_length_follows_the_frames_of_each_sequence():
    series = autoregressive(np.random.default_rng(0), 300, 0.9)
    length = block_length(series, [np.arange(300)])
    assert length > 5
    # The same values, in sequences of one image each: no neighbours, nothing correlated.
    assert block_length(series, [np.array([place]) for place in range(300)]) == 1
    order = np.random.default_rng(1).permutation(300)
    shuffled = np.empty(300)
    shuffled[order] = series  # frame i lies at order[i]
    assert block_length(shuffled, [order]) == length
    assert block_length(np.full(50, 3.0), [np.arange(50)]) == 1


# Blocks by names.

FRAMES = [f"frame{number}" for number in range(1, 41)]  # frame10 sorts before frame2 as text
VIDEOS = [f"V{v:02d}_I{frame:03d}" for v in range(12) for frame in range(11)]


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
        (VIDEOS, 500, "12 blocks of up to 11 neighbouring frames", [11] * 12),
        (VIDEOS, "sequence", "12 sequences", [11] * 12),
        (["a", "b", "c3"], "auto", "3 single images (their names show no neighbours)", [1] * 3),
    ],
)
def test_blocks_are_neighbours_of_one_sequence(names, choice, said: str, sizes: list[int]):
    shuffled = np.random.default_rng(0).permutation(names).tolist()
    blocks = make_blocks(shuffled, choice, NOTHING)
    assert blocks.said.startswith(said)
    assert blocks.reason == "" or choice == "auto"
    found = members(blocks, shuffled)
    assert sorted(map(len, found)) == sizes
    for block in found:
        places = sorted(names.index(name) for name in block)
        assert places == list(range(places[0], places[0] + len(block)))


def test_auto_uses_the_longest_block_that_gives_enough_blocks():
    rng = np.random.default_rng(0)
    noise, alike = rng.normal(size=300), autoregressive(rng, 300, 0.8)
    length = block_length(alike, [np.arange(300)])
    assert length > block_length(noise, [np.arange(300)])
    blocks = make_blocks(mfnet(300), "auto", np.stack([noise, alike]))
    assert blocks.count == math.ceil(300 / length)
    ramp = np.arange(40.0)[None]
    assert block_length(ramp[0], [np.arange(40)]) > 4
    assert make_blocks(mfnet(40), "auto", ramp).count == FEWEST
    assert make_blocks(mfnet(7), "auto", ramp[:, :7]).said == "7 single images"


@pytest.mark.parametrize(
    ("names", "choice", "word"),
    [
        (
            [*mfnet(20), "final"],
            "sequence",
            "blocks=sequence: names such as '00001D' show no neigh",
        ),
        ([*mfnet(20), "final"], 5, "blocks=5: names such as '00001D' show no neigh"),
        ([f"{c}_{n}" for n, c in enumerate("abcdefghijklm")], 5, "show no neighbouring frames"),
        (mfnet(100), 20, "blocks=20: 100 images make 5 blocks of up to 20"),
        (mfnet(100) + mfnet(100, "N"), "sequence", "200 images make 2 sequences"),
    ],
)
def test_blocks_that_cannot_be_made_are_refused(names: list[str], choice, word: str):
    with pytest.raises(InputError, match=word):
        make_blocks(names, choice, NOTHING)


def numbered(*runs: tuple[int, int]) -> list[str]:
    """Names of runs of consecutive numbers, each from its first to before its last."""
    return [f"{number:05d}D" for first, last in runs for number in range(first, last)]


def test_auto_takes_runs_of_consecutive_numbers():
    """A frame that is missing ends no run: in MFNet 00044 is followed by 00047."""
    names = [*numbered((1, 6), (8, 11)), *numbered(*((100 * k, 100 * k + 8) for k in range(1, 12)))]
    shuffled = list(np.random.default_rng(0).permutation(names))
    blocks = make_blocks(shuffled, "auto", NOTHING)
    expected = {frozenset(numbered((1, 6), (8, 11)))}
    expected |= {frozenset(numbered((100 * k, 100 * k + 8))) for k in range(1, 12)}
    assert members(blocks, shuffled) == expected
    assert blocks.said == "12 blocks of 8 neighbouring frames"
    assert blocks.reason == (
        "The names form 12 runs of consecutive numbers (8 images); each is one block."
    )


def test_auto_takes_the_step_of_each_sequence():
    """KP: every 80th frame of one recording, every 43rd of another; 1040 numbers are a gap."""
    names = [f"set10_V000_I{50 + 80 * k:05d}" for k in range(9)]
    names += [f"set10_V000_I{1730 + 80 * k:05d}" for k in range(9)]
    names += [f"set11_V{v:03d}_I{50 + 43 * k:05d}" for v in range(10) for k in range(8)]
    blocks = make_blocks(names, "auto", NOTHING)
    assert blocks.said == "12 blocks of 8 to 9 neighbouring frames"
    assert {len(block) for block in members(blocks, names)} == {8, 9}


def test_auto_cuts_runs_of_which_one_is_too_long():
    """The test part of MFNet: one run by day and one at night."""
    names = [*mfnet(205), *mfnet(188, "N")]
    rng = np.random.default_rng(0)
    series = np.concatenate([autoregressive(rng, count, 0.8) for count in (205, 188)])[None]
    blocks = make_blocks(names, "auto", series)
    assert 20 < blocks.count < 150
    assert blocks.reason.startswith(
        "The names form 2 runs of consecutive numbers (188 to 205 images), one of them more than "
        "1/10 of all images; they are cut at "
    )
    alone = make_blocks(names, "auto", rng.normal(size=(1, 393)))
    assert alone.said == "393 single images"
    assert "not shown to be correlated, each image is drawn alone" in alone.reason


def test_auto_does_not_take_levels_of_day_and_night_for_correlation():
    """Without thermal, all nights score low: independent images, two levels."""
    names = [*mfnet(150), *mfnet(150, "N")]
    noise = np.random.default_rng(0).normal(size=300)
    levels = noise + np.repeat([4.0, -4.0], 150)
    assert make_blocks(names, "auto", levels[None]).said == "300 single images"


def test_auto_explains_single_images():
    for names in (["b", "a", "c"], [f"{video}_7" for video in "abcdefghijkl"], mfnet(12)):
        blocks = make_blocks(names, "auto", np.zeros((1, len(names))))
        assert blocks.count == len(names)
        assert "each image is drawn alone, as if it were independent evidence" in blocks.reason
    assert make_blocks(mfnet(12), "none", NOTHING).reason == ""


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
def test_auto_on_the_lists_of_mfnet_and_kp():
    """Measured: gaps inside runs of at most 3 numbers or 2 steps, between runs of 12 or 7."""
    found = {}
    for name in ("mfnet_names/train", "mfnet_names/test", "kp_names/train_day", "kp_names/test"):
        names = (LISTS / f"{name}.txt").read_text().split()
        found[name] = make_blocks(names, "auto", np.zeros((1, len(names))))
    assert "6 runs of consecutive numbers (2 to 384 images)" in found["mfnet_names/train"].reason
    assert "2 runs of consecutive numbers (188 to 205 images)" in found["mfnet_names/test"].reason
    assert "9 runs of consecutive numbers (20 to 52 images)" in found["kp_names/test"].reason
    assert "20 runs of consecutive numbers (4 to 28 images)" in found["kp_names/train_day"].reason
