"""``rgbt compare`` as a user calls it: runs, files, pairs of frames, and two measurements."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.compare import entry, metrics_of
from analysis.uncertainty import Resampling, compare
from rgbt.checks import InputError
from rgbt.metrics.counting import pair_counts
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from rgbt.metrics.pairs import PROTOCOLS, file_name
from tests.analysis.robust_runs import SCORES, less, write_run
from tests.analysis.test_results import COMMAS, make_run
from tests.analysis.uncertainty.simulated import Population, counts_of, pairs_of
from tests.commands import Call, assert_one_sentence

FAST = ("resamples=200", "blocks=none")
SETTINGS = Resampling(resamples=200, blocks="none")
IMAGES = 40
NIGHT = tuple(place < 15 for place in range(IMAGES))


def pair(night: tuple[bool, ...] | None = None) -> tuple[Counts, Counts]:
    arrays = Population().pair(np.random.default_rng(0), IMAGES, 1, Population(skill=2.6))
    return counts_of(arrays[0][0], night=night), counts_of(arrays[1][0], night=night)


def saved(folder: Path, a: Counts, b: Counts) -> tuple[str, str]:
    a.save(folder / "crm.npz")
    b.save(folder / "grbm.npz")
    return f"a={folder}/crm.npz", f"b={folder}/grbm.npz"


@pytest.fixture
def files(tmp_path: Path) -> tuple[str, str]:
    return saved(tmp_path, *pair())


def lines_of(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / "comparison.csv").open()))


def test_table_sentence_and_files_hold_the_numbers_of_the_comparison(
    call: Call, files: tuple[str, str], tmp_path: Path
) -> None:
    code, out, err = call(entry, *files, *FAST, f"out={tmp_path / 'new' / 'out'}")
    assert (code, err) == (0, "")
    assert out.splitlines()[0].strip() == "grbm minus crm: 40 single images, ring2"
    assert "all 4 scores compared, p < 0.001." in out
    assert "Student, 200 resamples" in out
    text = (tmp_path / "new" / "out" / "comparison.md").read_text()
    assert next(line for line in out.splitlines() if "As trained here" in line) in text
    found = compare(*([each] for each in pair()), ["mIoU", "Var", "region/1", "region/2"], SETTINGS)
    rows = lines_of(tmp_path / "new" / "out")
    assert [row["metric"] for row in rows] == [each.metric for each in found.differences]
    for row, each in zip(rows, found.differences, strict=True):
        numbers = {
            **{"a": each.a.value, "b": each.b.value, "difference": each.value},
            **{"images_low": each.interval.low, "images_high": each.interval.high},
            **{"p": each.difference.p, "p_holm": each.p_corrected, "seeds_a": 1, "seeds_b": 1},
        }
        assert {key: float(row[key]) for key in numbers} == numbers
        assert row["both_low"] == row["both_high"] == ""
        shown = [f"{each.a.value:.2f}", f"{each.b.value:.2f}", f"{each.value:+.2f}"]
        ends = f"{each.interval.low:+.2f} to {each.interval.high:+.2f}"
        assert " | ".join([each.metric, *shown, ends]) in text


def test_seeds_have_their_columns(call: Call, tmp_path: Path) -> None:
    population = Population(training_sd=0.1)
    sides = population.pair(np.random.default_rng(0), IMAGES, 3, population)
    for name, arrays in zip("ab", sides, strict=True):
        for seed, array in enumerate(arrays):
            counts_of(array).save(tmp_path / f"{name}{seed}.npz")
    arguments = [f"{n}=" + ",".join(f"{tmp_path}/{n}{seed}.npz" for seed in range(3)) for n in "ab"]
    code, out, _ = call(entry, *arguments, *FAST, "metrics=mIoU, Var", "level=0.9")
    assert code == 0
    for words in ("90 % over images and seeds", "a0 + a1 + a2", "3 trainings each and 40", "±"):
        assert words in out


@pytest.mark.parametrize("name", [COMMAS, "grbm sizes=[large,small]", "x=[/y]"])
def test_group_names_are_shown_whole(call: Call, tmp_path: Path, name: str) -> None:
    """rich takes [word] for a style."""
    runs = tmp_path / "runs"
    for key, group, counts in zip("ab", (name, "crm"), pair(), strict=True):
        counts.save(make_run(runs, key, group, 0) / "counts_test.npz")
    code, out, err = call(entry, f"a={name}", "b=crm", f"runs_dir={runs}", *FAST)
    assert (code, err) == (0, "")
    assert f"crm minus {name}: 40 single images" in out
    assert f"than that of {name} (" in out


def test_equal_names_get_distinct_labels(call: Call, tmp_path: Path) -> None:
    for folder, counts in zip(("x", "y"), pair(), strict=True):
        (tmp_path / folder).mkdir()
        counts.save(tmp_path / folder / "counts_test.npz")
        counts.save(tmp_path / folder / "mine.npz")
    for name, said in (("mine", "b: mine minus a: mine"), ("counts_test", "y minus x")):
        arguments = (f"{side}={tmp_path}/{f}/{name}.npz" for side, f in zip("ab", "xy"))
        assert said in call(entry, *arguments, *FAST)[1]


def test_nothing_to_score_is_empty(call: Call, tmp_path: Path) -> None:
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
def test_auto_takes_parts_of_ten_images(at_night: int, parts: str) -> None:
    night = tuple(place < at_night for place in range(IMAGES)) if at_night else None
    metrics = ["mIoU", "Var", "region/1", "region/2", *(f"{p}/mIoU" for p in parts.split())]
    assert metrics_of("auto", pair(night), SETTINGS) == metrics
    assert metrics_of("auto", [*pair(night), pair()[0]], SETTINGS) == metrics[:4]  # one tells none


def test_missing_images_are_refused_or_excluded(call: Call, tmp_path: Path) -> None:
    a, b = pair()
    lacking = saved(tmp_path, a.select(a.names[:35]), b.select(b.names[3:][::-1]))
    code, _, err = call(entry, *lacking, *FAST)
    assert code == 2
    assert_one_sentence(err, "missing=leave_out")
    code, out, err = call(entry, *lacking, *FAST, "missing=leave_out", "metrics=mIoU")
    assert code == 0
    assert "grbm minus crm: 32 single images" in out
    assert "8 of 40 images are not in all counts and were excluded" in err
    both = a.names[3:35]
    (found,) = compare([a.select(both)], [b.select(both)], ["mIoU"], SETTINGS).differences
    assert f"{found.b.value:.2f} against {found.a.value:.2f}" in out


def test_corrupted_images_are_compared(call: Call, tmp_path: Path) -> None:
    write_run(tmp_path, "k0", "crm", 0, SCORES)
    write_run(tmp_path, "k2", "none", 0, less(5))
    where = (f"runs_dir={tmp_path}", "metrics=mIoU", *FAST)
    code, out, err = call(entry, "a=k2", "b=k0", "condition=noise 16", *where)
    assert code == 0, err
    # 40 against 35 on noisy images (80 against 75 on clean ones).
    assert "crm (noise 16) minus none (noise 16)" in out
    assert "40.00 against 35.00" in out
    assert "20.00 against 15.00" in call(entry, "a=k2", "b=k0", "condition=rgb_removed", *where)[1]


# Pairs of frames.

AGREE = {"plain": 0.5, "temporal": 0.7}


@pytest.fixture(scope="module")
def paired_runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two groups of two seeds, with pairs by two protocols; a run without any."""
    runs = tmp_path_factory.mktemp("pairs") / "runs"
    for group, agree in AGREE.items():
        for seed in range(2):
            folder = make_run(runs, f"{group}{seed}", group, seed)
            (folder / "evaluations").mkdir()
            for protocol in ("aligned", "released"):
                counts = replace(pairs_of(IMAGES, agree, seed, NIGHT), partition=f"{protocol}3")
                counts.save(folder / file_name(protocol, "test"))
    make_run(runs, "bare0", "bare", 0)
    return runs


def test_difference_in_tc_has_its_interval_over_images_and_seeds(
    call: Call, paired_runs: Path, tmp_path: Path
) -> None:
    words = (f"runs_dir={paired_runs}", "a=plain", "b=temporal", *FAST, "frames=aligned")
    code, out, err = call(entry, *words, f"out={tmp_path}")
    assert (code, err) == (0, "")
    assert "temporal minus plain: 40 single images, aligned3" in out
    rows = lines_of(tmp_path)
    auto = ["TC", "CA", "day/TC", "day/CA", "night/TC", "night/CA"]
    assert [row["metric"] for row in rows] == auto
    plain, temporal = (
        np.mean([value("TC", pairs_of(IMAGES, agree, seed), "released") for seed in (0, 1)])
        for agree in AGREE.values()
    )
    assert float(rows[0]["difference"]) == pytest.approx(temporal - plain)
    assert 0 < float(rows[0]["both_low"]) < temporal - plain


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_auto_metrics_are_those_of_the_protocol(protocol: str) -> None:
    counts = replace(pairs_of(IMAGES, 0.5, night=NIGHT), partition=f"{protocol}3")
    whole = {
        "released": ["TC", "CA_released"],
        "flow": ["TC", "CA", "warping_error"],
        "triples": ["flicker"],
    }.get(protocol, ["TC", "CA"])
    parts = [f"{part}/{metric}" for part in ("day", "night") for metric in whole]
    assert metrics_of("auto", [counts], Resampling()) == [*whole, *parts]


@pytest.mark.parametrize(("a", "b"), [("next1-0a1b2c", "next1-d4e5f6"), ("aligned3", "aligned3-0")])
def test_other_second_frames_are_not_compared(a: str, b: str) -> None:
    of_a, of_b = (replace(pairs_of(IMAGES, 0.5), partition=each) for each in (a, b))
    with pytest.raises(InputError, match="second frames of pairs, differ"):
        compare([of_a], [of_b], ["TC"], Resampling())


# Two measurements of one training, such as along an estimated and along the exact flow.


def along(partition: str, wrong: int, left_out: int = 0) -> Counts:
    """24 pairs of 100 pixels, half of class 0; `wrong` + (number of the pair) % 3 change."""
    found = []
    for index in range(24):
        first = np.repeat([0, 1], 50)[None]
        second, valid = first.copy(), np.ones((1, 100), bool)
        second[0, : wrong + index % 3] = 1
        valid[0, 100 - left_out :] = False
        found.append(pair_counts(first, second, first, 2, valid))
    names = tuple(f"v{index % 12}_{index // 12:03d}" for index in range(24))
    given = {"classes": ("road", "car"), "partition": partition, "names": names}
    return counts_of(np.stack(found), **given)


def test_two_measurements_of_trainings_are_compared_in_pairs(call: Call, tmp_path: Path) -> None:
    """They count other pixels of the same pairs; the trainings differ by much."""
    words = ["metrics=warping_error,TC", *FAST, f"out={tmp_path / 'out'}"]
    for side, partition, more, left_out in (("a", "next1-ab", 4, 0), ("b", "flow1-12", 6, 20)):
        for seed in range(2):
            along(partition, more + 20 * seed, left_out).save(tmp_path / f"{side}{seed}.npz")
        words.append(f"{side}={tmp_path}/{side}0.npz,{tmp_path}/{side}1.npz")
    code, _, err = call(entry, *words)
    assert code == 2
    assert "counts by next1-ab cannot be compared with counts by flow1" in err
    code, out, err = call(entry, *words, "paired=true")
    assert code == 0, err
    assert "seeds in pairs" in out
    error, whole = lines_of(tmp_path / "out")
    # 5 and 25 of 100 pixels against 7 and 27 of 80: 3.75 and 8.75 percent points more.
    assert float(error["difference"]) == pytest.approx(6.25)
    assert float(whole["difference"]) < 0
    half = (float(error["both_high"]) - float(error["both_low"])) / 2
    assert half == pytest.approx(12.706 * 2.5, rel=0.01)  # 12.706: Student, one degree of freedom


def test_triples_of_two_methods_have_other_classes_in_the_first_frame() -> None:
    a = along("triples1", 4)
    b = replace(a, counts=a.counts[:, ::-1])
    found = compare([a], [b], ["flicker"], SETTINGS)
    assert found.differences[0].metric == "flicker"
    with pytest.raises(InputError, match="has different labels in the two counts"):
        compare([a], [replace(b, counts=b.counts * 2)], ["flicker"], SETTINGS)


# What it refuses: one sentence, exit code 2.


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["metrics=mIuo"], "did you mean 'mIoU'?"),
        (["metrics=region/9"], "the counts have the regions 1 to 2"),
        (["metrics=night/mIoU"], "does not contain both images marked as day"),
        (["metric=mIoU"], "did you mean 'metrics'?"),
        (["level=2"], "level must be between 0.5 and 0.999, got 2"),
        (["resamples=5"], "'resamples'"),
        (["blocks=20"], "blocks=20: 40 images make 2 blocks"),
        (["split=val"], "is of split 'test', not of split=val"),
        (["condition=noise", "frames=next"], "is of single frames; omit frames="),
        (["out={}/crm.npz"], "is a file; choose a folder"),
        (["b={}/crm.npz"], "a and b both contain"),
        (["a={0}/crm.npz,{0}/crm.npz"], "names the same counts twice"),
        (["b=crn"], "did you mean 'crm'?"),
        (["b={}/empty"], "nor counts (.npz, or a folder of rgbt score)"),
        (["b={}/none.npz"], "the file of counts"),
        (["b="], "Groups in {}/runs: crm."),
        (["frames=aligned"], "crm.npz is by ring2, not frames=aligned"),
        (["b=aaa0", "frames=next"], "frames=next is not counted in {}/runs/aaa0, which has none"),
        (["metrics=TC"], "'TC' is a score of pairs of frames"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(
    call: Call, files: tuple[str, str], tmp_path: Path, arguments: list[str], word: str
) -> None:
    make_run(tmp_path / "runs", "aaa0", "crm", 0)
    (tmp_path / "empty").mkdir()
    words = (*files, *FAST, f"runs_dir={tmp_path}/runs", "archive=none")
    given = dict(each.split("=", 1) for each in words)
    if "aaa0" in arguments[0]:
        given["a"] = "aaa0"
    given |= dict(each.format(tmp_path).split("=", 1) for each in arguments)
    code, out, err = call(entry, *(f"{key}={text}" for key, text in given.items()))
    assert (code, out) == (2, "")
    assert_one_sentence(err, word.format(tmp_path))
