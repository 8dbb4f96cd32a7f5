"""``rgbt compare`` as a user calls it."""

from __future__ import annotations

import csv
import io
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.compare import Options, comparison_csv, entry, metrics_of, settings_of
from analysis.uncertainty import Resampling, compare
from rgbt.checks import InputError
from rgbt.config.options import parse
from rgbt.metrics.counts import Counts
from tests.analysis.test_results import COMMAS, make_run
from tests.analysis.uncertainty.simulated import Population, counts_of
from tests.commands import Call, assert_one_sentence

FAST = ("resamples=200", "blocks=none")


def pair(images: int = 40, skill: float = 2.6) -> tuple[Counts, Counts]:
    rng = np.random.default_rng(0)
    arrays = Population().pair(rng, images, 1, Population(skill=skill))
    return counts_of(arrays[0][0]), counts_of(arrays[1][0])


@pytest.fixture
def files(tmp_path: Path) -> tuple[str, str]:
    a, b = pair()
    a.save(tmp_path / "crm.npz")
    b.save(tmp_path / "grbm.npz")
    return f"a={tmp_path}/crm.npz", f"b={tmp_path}/grbm.npz"


# What it says.


def test_table_and_sentence(call: Call, files: tuple[str, str]):
    code, out, err = call(entry, *files, *FAST)
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0].strip() == "grbm less crm: 40 single images, ring2"
    rows = {
        line.split()[0]: line for line in lines if line.startswith(("  mIoU", "  Var", "  reg"))
    }
    assert list(rows) == ["mIoU", "Var", "region/1", "region/2"]
    expected = compare(
        *([each] for each in pair()), ["mIoU"], Resampling(resamples=200, blocks="none")
    )
    (found,) = expected.differences
    assert found.images is not None
    words = rows["mIoU"].split()
    assert words[1:4] == [f"{found.a.value:.2f}", f"{found.b.value:.2f}", f"{found.value:+.2f}"]
    assert words[4:7] == [f"{found.images.low:+.2f}", "to", f"{found.images.high:+.2f}"]
    assert words[7] == f"{found.p_images:.3f}"
    said = next(line for line in lines if line.startswith("As trained here, the mIoU of grbm is "))
    assert "higher than that of crm" in said
    assert said.endswith(
        "over 40 images; with one training each, it says nothing about other trainings of the two; "
        f"corrected for all 4 scores compared, p = {4 * found.p_images:.3f}."
    )
    assert any("percentile, 200 resamples" in line for line in lines)


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


def test_groups_of_a_store(call: Call, tmp_path: Path):
    runs = tmp_path / "runs"
    for seed in range(2):
        make_run(runs, f"aaa{seed}", "crm", seed)
        make_run(runs, f"bbb{seed}", COMMAS, seed)
    for key, skill in (("aaa", 1.5), ("bbb", 2.6)):  # the same labels for all
        rng = np.random.default_rng(0)
        arrays = Population().pair(rng, 40, 2, Population(skill=skill))[1]
        for seed in range(2):
            counts_of(arrays[seed]).save(runs / f"{key}{seed}" / "counts_test.npz")
    code, out, err = call(entry, "a=crm", f"b={COMMAS}", f"runs_dir={runs}", *FAST)
    assert (code, err) == (0, "")
    assert f"{COMMAS} less crm: 40 single images" in out
    assert f"The mIoU of {COMMAS} is " in out


@pytest.mark.parametrize("name", ["grbm sizes=[large,small]", "x=[/y]"])
def test_names_with_brackets_are_shown_whole(call: Call, tmp_path: Path, name: str):
    """rich takes [word] for a style."""
    a, b = pair()
    runs = tmp_path / "runs"
    make_run(runs, "aaa0", name, 0)
    a.save(runs / "aaa0" / "counts_test.npz")
    b.save(tmp_path / "other.npz")
    code, out, err = call(entry, "a=aaa0", f"b={tmp_path}/other.npz", f"runs_dir={runs}", *FAST)
    assert (code, err) == (0, "")
    assert f"other less {name}: 40 single images" in out
    assert f"than that of {name} (" in out
    header = next(line for line in out.splitlines() if "difference" in line)
    assert name in header


def test_names_that_are_equal_are_told_apart(call: Call, tmp_path: Path):
    for folder, counts in zip(("x", "y"), pair(), strict=True):
        (tmp_path / folder).mkdir()
        counts.save(tmp_path / folder / "counts_test.npz")
        counts.save(tmp_path / folder / "mine.npz")
    arguments = f"a={tmp_path}/x/mine.npz", f"b={tmp_path}/y/mine.npz"
    code, out, _ = call(entry, *arguments, *FAST)
    assert code == 0
    assert "b: mine less a: mine" in out
    arguments = f"a={tmp_path}/x/counts_test.npz", f"b={tmp_path}/y/counts_test.npz"
    assert "y less x" in call(entry, *arguments, *FAST)[1]


def test_files(call: Call, files: tuple[str, str], tmp_path: Path):
    out_dir = tmp_path / "new" / "out"
    metrics = ("mIoU", "class/cone")
    code, out, _ = call(entry, *files, *FAST, f"metrics={','.join(metrics)}", f"out={out_dir}")
    assert code == 0
    assert "comparison.md, comparison.csv" in out
    text = (out_dir / "comparison.md").read_text()
    said = next(line for line in out.splitlines() if "mIoU of " in line and "against" in line)
    assert said in text
    with (out_dir / "comparison.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    sides = ([each] for each in pair())
    expected = compare(*sides, metrics, Resampling(resamples=200, blocks="none")).differences
    assert [row["metric"] for row in rows] == list(metrics)
    for row, each in zip(rows, expected, strict=True):
        assert each.images is not None
        numbers = {
            **{"a": each.a.value, "b": each.b.value, "difference": each.value},
            **{"images_low": each.images.low, "images_high": each.images.high},
            **{"p_images": each.p_images, "p_holm": each.p_corrected, "seeds_a": 1, "seeds_b": 1},
        }
        assert {key: float(row[key]) for key in numbers} == numbers
        assert row["both_low"] == row["both_high"] == row["p_both"] == ""
        assert f"{each.value:+.2f}" in text


def test_same_command_same_output(call: Call, files: tuple[str, str]):
    first = call(entry, *files, *FAST)
    assert first == call(entry, *files, *FAST)
    assert first != call(entry, *files, *FAST, "seed=1")


def test_nothing_to_score(call: Call, tmp_path: Path):
    for name, counts in zip("ab", pair(), strict=True):
        array = counts.counts.copy()
        array[..., 0] += array[..., 3]
        array[..., 3, :] = array[..., 3] = 0
        replace(counts, counts=array).save(tmp_path / f"{name}.npz")
    arguments = [f"{name}={tmp_path}/{name}.npz" for name in "ab"]
    code, out, err = call(
        *(entry, *arguments, *FAST, "absent=exclude", "metrics=class/cone", f"out={tmp_path}")
    )
    assert (code, err) == (0, "")
    assert "class/cone of a and b cannot be compared: nothing to score." in out
    row = (tmp_path / "comparison.csv").read_text().splitlines()[1]
    assert row == "class/cone,,,1,1,,,,,,,,"


@pytest.mark.parametrize("at_night", [0, 15])
def test_auto_metrics(call: Call, tmp_path: Path, at_night: int):
    night = tuple(place < at_night for place in range(40)) if at_night else None
    for name, counts in zip("ab", pair(), strict=True):
        replace(counts, night=night).save(tmp_path / f"{name}.npz")
    arguments = [f"{name}={tmp_path}/{name}.npz" for name in "ab"]
    assert call(entry, *arguments, *FAST, f"out={tmp_path}")[0] == 0
    lines = (tmp_path / "comparison.csv").read_text().splitlines()[1:]
    expected = ["mIoU", "Var", "region/1", "region/2"]
    parts = ["day/mIoU", "night/mIoU"] if at_night else []
    assert [line.split(",")[0] for line in lines] == [*expected, *parts]


def test_auto_leaves_out_a_night_with_too_few_images(call: Call, tmp_path: Path):
    """Nobody asked for the night; the other lines can be told."""
    night = tuple(place < 5 for place in range(40))
    for name, counts in zip("ab", pair(), strict=True):
        replace(counts, night=night).save(tmp_path / f"{name}.npz")
    arguments = [f"{name}={tmp_path}/{name}.npz" for name in "ab"]
    code, out, err = call(entry, *arguments, *FAST)
    assert (code, err) == (0, "")
    assert "night/mIoU" not in out
    code, _, err = call(entry, *arguments, *FAST, "metrics=night/mIoU")
    assert code == 2
    assert_one_sentence(err, "5 single images are too few")


def test_auto_leaves_out_a_night_that_only_one_tells(call: Call, tmp_path: Path):
    """Label images of another method, scored as plain folders, know no night."""
    a, b = pair()
    replace(a, night=tuple(place < 15 for place in range(40))).save(tmp_path / "a.npz")
    b.save(tmp_path / "b.npz")
    code, out, err = call(entry, f"a={tmp_path}/a.npz", f"b={tmp_path}/b.npz", *FAST)
    assert (code, err) == (0, "")
    assert "the mIoU of b" in out


def test_title_counts_the_images_of_the_first_line(call: Call, tmp_path: Path):
    night = tuple(place < 15 for place in range(40))
    for name, counts in zip("ab", pair(), strict=True):
        replace(counts, night=night).save(tmp_path / f"{name}.npz")
    arguments = [f"{name}={tmp_path}/{name}.npz" for name in "ab"]
    code, out, _ = call(entry, *arguments, *FAST, "metrics=night/mIoU,mIoU")
    assert code == 0
    assert "the night/mIoU of b" in out
    assert "over 15 images" in out


# Missing images.


@pytest.fixture
def lacking(tmp_path: Path) -> tuple[str, str]:
    a, b = pair()
    a.select(a.names[:35]).save(tmp_path / "crm.npz")
    b.select(b.names[3:][::-1]).save(tmp_path / "grbm.npz")
    return f"a={tmp_path}/crm.npz", f"b={tmp_path}/grbm.npz"


def test_missing_images_are_refused(call: Call, lacking: tuple[str, str]):
    code, out, err = call(entry, *lacking, *FAST)
    assert (code, out) == (2, "")
    assert_one_sentence(err, "not of the same images: 35 of split 'test' against 37")
    assert_one_sentence(err, "missing=leave_out")


def test_missing_images_are_left_out(call: Call, lacking: tuple[str, str]):
    code, out, err = call(entry, *lacking, *FAST, "missing=leave_out", "metrics=mIoU")
    assert code == 0
    assert "grbm less crm: 32 single images" in out
    assert "8 of 40 images are not in all counts and were left out" in err
    a, b = pair()
    both = a.names[3:35]
    settings = Resampling(resamples=200, blocks="none")
    (found,) = compare([a.select(both)], [b.select(both)], ["mIoU"], settings).differences
    assert f"{found.b.value:.2f} against {found.a.value:.2f}" in out


def test_nothing_is_said_where_none_is_missing(call: Call, files: tuple[str, str]):
    code, _, err = call(entry, *files, *FAST, "missing=leave_out")
    assert (code, err) == (0, "")


def test_settings_from_options_are_those_given():
    def given(*words: str) -> Resampling:
        return settings_of(parse(Options, ["blocks=12", *words])[0])

    assert given() == Resampling(blocks=12)
    changed = given("resamples=1000", "level=.9", "seed=2")
    assert (changed.resamples, changed.level, changed.seed) == (1000, 0.9, 2)
    with pytest.raises(InputError, match="'level' must be a number"):
        given("level=")


def test_help_is_light():
    """No torch, matplotlib, mlflow or pandas for a page of help."""
    code = (
        "import sys; sys.argv = ['compare', '--help']\n"
        "from analysis.compare import entry\n"
        "try:\n    entry()\n"
        "except SystemExit as left:\n    assert not left.code\n"
        "heavy = {'torch', 'matplotlib', 'mlflow', 'pandas', 'scipy'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "  missing     refuse, or leave_out" in done.stdout


def test_csv_tells_the_trainings_of_each():
    a, b = pair()
    (found,) = csv.DictReader(
        io.StringIO(comparison_csv(compare([a, b], [b], ["mIoU"], Resampling(resamples=100))))
    )
    assert (found["seeds_a"], found["seeds_b"]) == ("2", "1")


@pytest.mark.parametrize(("nights", "expected"), [(9, False), (10, True)])
def test_auto_takes_parts_of_ten_images(nights: int, expected: bool):
    a, _ = pair()
    told = replace(a, night=tuple(index < nights for index in range(len(a.names))))
    metrics = metrics_of("auto", [told], Resampling())
    assert ("night/mIoU" in metrics) == expected
