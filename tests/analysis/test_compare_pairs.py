"""``rgbt compare frames=...``: differences in TC and CA from counts of pairs."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import pytest

from analysis.compare import entry, metrics_of
from analysis.results import open_counts
from analysis.uncertainty import Resampling, compare
from rgbt.checks import InputError
from rgbt.metrics.named import value
from rgbt.metrics.pairs import PROTOCOLS, file_name
from tests.analysis.test_results import make_run
from tests.analysis.uncertainty.simulated import pairs_of
from tests.commands import Call, assert_one_sentence

FAST = ("resamples=200", "blocks=none")
IMAGES = 40
NIGHT = tuple(place < 15 for place in range(IMAGES))
AGREE = {"plain": 0.5, "temporal": 0.7}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two groups of two seeds, with pairs by two protocols; a run without any."""
    runs = tmp_path_factory.mktemp("pairs") / "runs"
    for group, agree in AGREE.items():
        for seed in range(2):
            folder = make_run(runs, f"{group}{seed}", group, seed)
            (folder / "evaluations").mkdir()
            for protocol in ("aligned", "released"):
                counts = pairs_of(IMAGES, agree, seed, NIGHT)
                counts = replace(counts, partition=f"{protocol}3")
                counts.save(folder / file_name(protocol, "test"))
    make_run(runs, "bare0", "bare", 0)
    return runs


def test_difference_in_tc_has_its_interval_over_images_and_seeds(
    call: Call, runs: Path, tmp_path: Path
):
    words = (f"runs_dir={runs}", "a=plain", "b=temporal", *FAST, "frames=aligned")
    code, out, err = call(entry, *words, f"out={tmp_path}")
    assert (code, err) == (0, "")
    assert "temporal minus plain: 40 single images, aligned3" in out
    assert "The TC of temporal is " in out
    assert "over 2 trainings each and 40 images" in out
    rows = list(csv.DictReader((tmp_path / "comparison.csv").open()))
    auto = ["TC", "CA", "day/TC", "day/CA", "night/TC", "night/CA"]
    assert [row["metric"] for row in rows] == auto
    mean = {
        group: sum(value("TC", pairs_of(IMAGES, agree, seed), "released") for seed in (0, 1)) / 2
        for group, agree in AGREE.items()
    }
    assert float(rows[0]["a"]) == pytest.approx(mean["plain"])
    assert float(rows[0]["difference"]) == pytest.approx(mean["temporal"] - mean["plain"])
    assert 0 < float(rows[0]["both_low"]) < mean["temporal"] - mean["plain"]


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_auto_metrics_are_those_of_the_protocol(protocol):
    counts = replace(pairs_of(IMAGES, 0.5, night=NIGHT), partition=f"{protocol}3")
    whole = {
        "released": ["TC", "CA_released"],
        "flow": ["TC", "CA", "warping_error"],
        "triples": ["flicker"],
    }.get(protocol, ["TC", "CA"])
    parts = [f"{part}/{metric}" for part in ("day", "night") for metric in whole]
    assert metrics_of("auto", [counts], Resampling()) == [*whole, *parts]


def test_runs_groups_and_files_are_opened(runs: Path):
    found = open_counts("plain", runs, frames="released")
    assert [each.key for each in found] == ["plain0", "plain1"]
    path = runs / "plain1" / file_name("aligned", "test")
    for frames in ("aligned", ""):
        (file,) = open_counts(str(path), runs, frames=frames)
        # Of the file's name nothing tells whose counts it holds.
        assert (file.label, file.counts.partition) == ("plain1", "aligned3")


@pytest.mark.parametrize(
    ("words", "word"),
    [
        (["a=plain0", "b=bare0", "metrics=TC"], "'TC' is a score of pairs of frames"),
        (["frames=aligned", "metrics=TC,Var"], "'Var' is a score of single frames"),
        (["frames=aligned", "metrics=class/cat/TC"], "no class 'cat'; did you mean 'car'?"),
        (["frames=next"], "plain0 split=test frames=next makes them once it is finished"),
        (
            ["frames=aligned", "split=val"],
            "no counts of pairs of frames evaluations/cons",
        ),
        (["frames=aligned", "b=bare"], "bare0 split=test frames=virtual makes them"),
        (["frames=aligned", "b={runs}/bare0/counts_test.npz"], "is by ring2, not frames=aligned"),
        (
            ["a=plain0", "b={runs}/temporal0/evaluations/consistency_released_test.npz"],
            "counts by ring2 cannot be compared with counts by released3",
        ),
    ],
)
def test_counts_that_do_not_fit_are_refused(call: Call, runs: Path, words: list[str], word: str):
    given = {"runs_dir": str(runs), "a": "plain", "b": "temporal"}
    given |= dict(each.format(runs=runs).split("=", 1) for each in words)
    code, out, err = call(entry, *FAST, *(f"{key}={text}" for key, text in given.items()))
    assert (code, out) == (2, "")
    assert_one_sentence(err, word)


@pytest.mark.parametrize(
    ("a", "b", "word"),
    [
        ("aligned3", "released3", "counts by aligned3 cannot"),
        ("next1-0a1b2c", "next1-d4e5f6", "second frames of pairs, differ"),
        ("aligned3", "aligned3-0c", "second frames of pairs, differ"),
    ],
)
def test_other_protocols_or_frames_are_not_compared(a: str, b: str, word: str):
    of_a, of_b = (replace(pairs_of(IMAGES, 0.5), partition=each) for each in (a, b))
    with pytest.raises(InputError, match=word):
        compare([of_a], [of_b], ["TC"], Resampling())
