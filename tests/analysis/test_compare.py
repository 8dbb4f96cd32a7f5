"""``rgbt compare`` as a user calls it."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.compare import entry, metrics_of
from analysis.uncertainty import Resampling, compare
from rgbt.metrics.counts import Counts
from tests.analysis.test_results import COMMAS, make_run
from tests.analysis.uncertainty.simulated import Population, counts_of
from tests.commands import Call, assert_one_sentence

FAST = ("resamples=200", "blocks=none")
SETTINGS = Resampling(resamples=200, blocks="none")


def pair(night: tuple[bool, ...] | None = None) -> tuple[Counts, Counts]:
    arrays = Population().pair(np.random.default_rng(0), 40, 1, Population(skill=2.6))
    return counts_of(arrays[0][0], night=night), counts_of(arrays[1][0], night=night)


def saved(folder: Path, a: Counts, b: Counts) -> tuple[str, str]:
    a.save(folder / "crm.npz")
    b.save(folder / "grbm.npz")
    return f"a={folder}/crm.npz", f"b={folder}/grbm.npz"


@pytest.fixture
def files(tmp_path: Path) -> tuple[str, str]:
    return saved(tmp_path, *pair())


def first_column(path: Path) -> list[str]:
    return [line.split(",")[0] for line in path.read_text().splitlines()[1:]]


# What it says.


def test_table_and_sentence_hold_the_numbers_of_the_comparison(call: Call, files: tuple[str, str]):
    code, out, err = call(entry, *files, *FAST)
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0].strip() == "grbm minus crm: 40 single images, ring2"
    rows = {
        line.split()[0]: line for line in lines if line.startswith(("  mIoU", "  Var", "  reg"))
    }
    assert list(rows) == ["mIoU", "Var", "region/1", "region/2"]
    (found,) = compare(*([each] for each in pair()), ["mIoU"], SETTINGS).differences
    assert found.interval is not None
    words = rows["mIoU"].split()
    assert words[1:4] == [f"{found.a.value:.2f}", f"{found.b.value:.2f}", f"{found.value:+.2f}"]
    assert words[4:7] == [f"{found.interval.low:+.2f}", "to", f"{found.interval.high:+.2f}"]
    assert found.difference.p < 0.00025
    assert words[7] == "<0.001"
    said = next(line for line in lines if line.startswith("As trained here, the mIoU of grbm is "))
    assert said.endswith("all 4 scores compared, p < 0.001.")
    assert any("Student, 200 resamples" in line for line in lines)


def test_seeds_have_their_columns(call: Call, tmp_path: Path):
    population = Population(training_sd=0.1)
    sides = population.pair(np.random.default_rng(0), 40, 3, population)
    for name, arrays in zip("ab", sides, strict=True):
        for seed, array in enumerate(arrays):
            counts_of(array).save(tmp_path / f"{name}{seed}.npz")
    arguments = [f"{n}=" + ",".join(f"{tmp_path}/{n}{seed}.npz" for seed in range(3)) for n in "ab"]
    code, out, _ = call(entry, *arguments, *FAST, "metrics=mIoU, Var", "level=0.9")
    assert code == 0
    assert "90 % over images and seeds" in out
    assert "a0 + a1 + a2" in out
    assert "3 trainings each and 40 images" in out
    assert "±" in out


@pytest.mark.parametrize("name", [COMMAS, "grbm sizes=[large,small]", "x=[/y]"])
def test_group_names_are_shown_whole(call: Call, tmp_path: Path, name: str):
    """rich takes [word] for a style."""
    runs = tmp_path / "runs"
    for key, group, counts in zip("ab", (name, "crm"), pair(), strict=True):
        counts.save(make_run(runs, key, group, 0) / "counts_test.npz")
    code, out, err = call(entry, f"a={name}", "b=crm", f"runs_dir={runs}", *FAST)
    assert (code, err) == (0, "")
    assert f"crm minus {name}: 40 single images" in out
    assert f"than that of {name} (" in out
    assert name in next(line for line in out.splitlines() if "difference" in line)


def test_equal_names_get_distinct_labels(call: Call, tmp_path: Path):
    for folder, counts in zip(("x", "y"), pair(), strict=True):
        (tmp_path / folder).mkdir()
        counts.save(tmp_path / folder / "counts_test.npz")
        counts.save(tmp_path / folder / "mine.npz")
    for name, said in (("mine", "b: mine minus a: mine"), ("counts_test", "y minus x")):
        arguments = (f"{side}={tmp_path}/{f}/{name}.npz" for side, f in zip("ab", "xy"))
        code, out, _ = call(entry, *arguments, *FAST)
        assert code == 0
        assert said in out


def test_files_hold_all_digits(call: Call, files: tuple[str, str], tmp_path: Path):
    out_dir = tmp_path / "new" / "out"
    metrics = ("mIoU", "class/cone")
    code, out, _ = call(entry, *files, *FAST, f"metrics={','.join(metrics)}", f"out={out_dir}")
    assert code == 0
    text = (out_dir / "comparison.md").read_text()
    assert (
        next(line for line in out.splitlines() if "mIoU of " in line and "against" in line) in text
    )
    rows = list(csv.DictReader((out_dir / "comparison.csv").open()))
    expected = compare(*([each] for each in pair()), metrics, SETTINGS).differences
    assert [row["metric"] for row in rows] == list(metrics)
    for row, each in zip(rows, expected, strict=True):
        assert each.interval is not None
        numbers = {
            **{"a": each.a.value, "b": each.b.value, "difference": each.value},
            **{"images_low": each.interval.low, "images_high": each.interval.high},
            **{"p": each.difference.p, "p_holm": each.p_corrected, "seeds_a": 1, "seeds_b": 1},
        }
        assert {key: float(row[key]) for key in numbers} == numbers
        assert row["both_low"] == row["both_high"] == ""
        assert f"{each.value:+.2f}" in text


def test_nothing_to_score_is_empty(call: Call, tmp_path: Path):
    emptied = []
    for counts in pair():
        array = counts.counts.copy()
        array[..., 0] += array[..., 3]
        array[..., 3, :] = array[..., 3] = 0
        emptied.append(replace(counts, counts=array))
    words = (*saved(tmp_path, *emptied), *FAST, "absent=exclude", "metrics=class/cone")
    code, out, err = call(entry, *words, f"out={tmp_path}")
    assert (code, err) == (0, "")
    assert "class/cone of crm and grbm cannot be compared: nothing to score." in out
    row = (tmp_path / "comparison.csv").read_text().splitlines()[1]
    assert row == "class/cone,,,1,1,,,,,,,"


@pytest.mark.parametrize(("at_night", "parts"), [(0, ""), (9, "day"), (10, "day night")])
def test_auto_takes_parts_of_ten_images(call: Call, tmp_path: Path, at_night: int, parts: str):
    night = tuple(place < at_night for place in range(40)) if at_night else None
    words = (*saved(tmp_path, *pair(night)), *FAST)
    assert call(entry, *words, f"out={tmp_path}")[0] == 0
    metrics = ["mIoU", "Var", "region/1", "region/2", *(f"{p}/mIoU" for p in parts.split())]
    assert first_column(tmp_path / "comparison.csv") == metrics
    assert metrics_of("auto", [*pair(night), pair()[0]], SETTINGS) == metrics[:4]  # one tells none
    if at_night == 9:
        code, _, err = call(entry, *words, "metrics=night/mIoU")
        assert code == 2
        assert_one_sentence(err, "9 of 40 single images are too few")


def test_missing_images_are_refused_or_excluded(call: Call, tmp_path: Path):
    a, b = pair()
    lacking = saved(tmp_path, a.select(a.names[:35]), b.select(b.names[3:][::-1]))
    code, out, err = call(entry, *lacking, *FAST)
    assert (code, out) == (2, "")
    assert_one_sentence(err, "missing=leave_out")
    code, out, err = call(entry, *lacking, *FAST, "missing=leave_out", "metrics=mIoU")
    assert code == 0
    assert "grbm minus crm: 32 single images" in out
    assert "8 of 40 images are not in all counts and were excluded" in err
    both = a.names[3:35]
    (found,) = compare([a.select(both)], [b.select(both)], ["mIoU"], SETTINGS).differences
    assert f"{found.b.value:.2f} against {found.a.value:.2f}" in out


# What it refuses: one sentence, exit code 2.


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["metrics=mIuo"], "did you mean 'mIoU'?"),
        (["metrics="], "expected metrics, separated by commas"),
        (["metrics=region/9"], "the counts have the regions 1 to 2"),
        (["metrics=class/cat"], "did you mean 'car'?"),
        (["metrics=night/mIoU"], "does not contain both images marked as day"),
        (["metric=mIoU"], "did you mean 'metrics'?"),
        (["mIoU"], "expected key=value"),
        (["level=2"], "level must be between 0.5 and 0.999, got 2"),
        (["resamples=5"], "'resamples'"),
        (["seed=-1"], "'seed'"),
        (["blocks=0"], "'blocks'"),
        (["blocks=20"], "blocks=20: 40 images make 2 blocks"),
        (["blocks=sequence"], "blocks=sequence: 40 images make 1 sequences"),
        (["method=t"], "'method'"),
        (["absent=zero"], "'absent'"),
        (["split=val"], "is of split 'test', not of split=val"),
        (["condition=noise", "frames=next"], "is of single frames; omit frames="),
        (["out={}/crm.npz"], "is a file; choose a folder"),
        (["b={}/crm.npz"], "a and b both contain"),
        (["a={0}/crm.npz,{0}/crm.npz"], "names the same counts twice"),
        (["b=crn"], "did you mean 'crm'?"),
        (["b={}/empty"], "nor counts (.npz, or a folder of rgbt score)"),
        (["b={}/none.npz"], "the file of counts"),
        (["b="], "'b' has no value; give a run, a file of counts, or a group of runs. Groups in"),
        (["b="], ": crm."),
        (["b=crm,"], "expected runs, files of counts or a group"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(
    call: Call, files: tuple[str, str], tmp_path: Path, arguments: list[str], word: str
):
    make_run(tmp_path / "runs", "aaa0", "crm", 0)
    (tmp_path / "empty").mkdir()
    given = dict(each.split("=", 1) for each in (*files, *FAST, f"runs_dir={tmp_path}/runs"))
    words = [each.format(tmp_path) for each in arguments]
    given |= dict(each.split("=", 1) for each in words if "=" in each)
    all_words = [f"{key}={text}" for key, text in given.items()]
    code, out, err = call(entry, *all_words, *(each for each in words if "=" not in each))
    assert (code, out) == (2, "")
    assert_one_sentence(err, word)
