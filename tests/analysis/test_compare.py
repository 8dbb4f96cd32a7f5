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
from rgbt.metrics.pairs import PROTOCOLS
from rgbt.runs.folder import Description, RunFolder, lists_of
from tests.analysis.robust_runs import SCORES, less, write_run
from tests.analysis.test_results import COMMAS, make_run
from tests.analysis.uncertainty.simulated import Population, counts_of, pairs_of
from tests.commands import Call, assert_one_sentence
from tests.measured import differing, remeasured, store

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


def test_table_sentence_and_files_hold_the_compared_numbers(
    call: Call, files: tuple[str, str], tmp_path: Path
) -> None:
    code, out, err = call(entry, *files, *FAST, f"out={tmp_path / 'new' / 'out'}")
    assert (code, err) == (0, "")
    assert out.splitlines()[0].strip() == "grbm minus crm: 40 single images, ring2"
    assert "all 4 scores compared, p < 0.001." in out
    assert "Student, 200 resamples" in out
    assert "A class without a pixel counts as 0 (absent=released)." in out
    text = (tmp_path / "new" / "out" / "comparison.md").read_text()
    assert next(line for line in out.splitlines() if "As trained here" in line) in text
    found = compare(
        *([counts] for counts in pair()), ["mIoU", "Var", "region/1", "region/2"], SETTINGS
    )
    rows = lines_of(tmp_path / "new" / "out")
    assert [row["metric"] for row in rows] == [line.metric for line in found.differences]
    for row, line in zip(rows, found.differences, strict=True):
        numbers = {
            "a": line.a.value,
            "b": line.b.value,
            "difference": line.value,
            "images_low": line.interval.low,
            "images_high": line.interval.high,
            "p": line.difference.p,
            "p_holm": line.difference.p_corrected,
            "seeds_a": 1,
            "seeds_b": 1,
        }
        assert {key: float(row[key]) for key in numbers} == pytest.approx(numbers, rel=1e-6)
        assert row["both_low"] == row["both_high"] == ""
        shown = [f"{line.a.value:.2f}", f"{line.b.value:.2f}", f"{line.value:+.2f}"]
        ends = f"{line.interval.low:+.2f} to {line.interval.high:+.2f}"
        assert " | ".join([line.metric, *shown, ends]) in text


def test_other_measurements_are_said_and_are_no_seeds(call: Call, tmp_path: Path) -> None:
    a, b = pair()
    other = differing(b, view="thermal", statistics="adabn")
    code, out, err = call(entry, *saved(tmp_path, a, other), *FAST, f"out={tmp_path}")
    assert (code, err) == (0, "")
    said = "Measured differently (statistics: as trained, adabn; view: rgbt, thermal)."
    assert said in " ".join(out.split())
    assert said in (tmp_path / "comparison.md").read_text()
    with pytest.raises(InputError, match=r"seeds .* measured differently \(statistics: as trained"):
        compare([a], [b, other], ["mIoU"], SETTINGS)


@pytest.mark.parametrize("name", [COMMAS, "x=[/y]"])
def test_group_names_are_shown_whole(call: Call, tmp_path: Path, name: str) -> None:
    """rich takes [word] for a style."""
    runs = tmp_path / "runs"
    for key, group, counts in zip("ab", (name, "crm"), pair(), strict=True):
        counts.save(make_run(runs, key, group, 0) / "counts_test.npz")
    code, out, err = call(entry, f"a={name}", "b=crm", f"runs_dir={runs}", *FAST)
    assert (code, err) == (0, "")
    assert f"crm minus {name}: 40 single images" in out
    assert f"than that of {name} (" in out


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
            for protocol in ("aligned", "released"):
                store(folder, pairs_of(IMAGES, agree, seed, NIGHT), partition=f"{protocol}3")
    make_run(runs, "bare0", "bare", 0)
    return runs


def test_difference_in_tc_has_interval_over_images_and_seeds(
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
    counts = remeasured(pairs_of(IMAGES, 0.5, night=NIGHT), partition=f"{protocol}3")
    whole = {
        "released": ["TC", "CA_released"],
        "flow": ["TC", "CA", "warping_error"],
        "triples": ["flicker"],
    }.get(protocol, ["TC", "CA"])
    parts = [f"{part}/{metric}" for part in ("day", "night") for metric in whole]
    assert metrics_of("auto", [counts], Resampling()) == [*whole, *parts]


def test_triples_of_methods_differ_in_first_frame_classes() -> None:
    first = np.repeat([0, 1], 50)[None]
    found = []
    for index in range(24):
        second = first.copy()
        second[0, : 4 + index % 3] = 1
        found.append(pair_counts(first, second, first, 2, np.ones((1, 100), bool)))
    a = counts_of(np.stack(found), classes=("road", "car"), partition="triples1")
    b = replace(a, counts=a.counts[:, ::-1])
    (difference,) = compare([a], [b], ["flicker"], SETTINGS).differences
    assert difference.metric == "flicker"
    with pytest.raises(InputError, match="has different labels in the two counts"):
        compare([a], [replace(b, counts=b.counts * 2)], ["flicker"], SETTINGS)


# What it refuses: one sentence, exit code 2.


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["metrics=mIuo"], "did you mean 'mIoU'?"),
        (["level=2"], "level must be between 0.5 and 0.999, got 2"),
        (["blocks=20"], "blocks=20: 40 images make 2 blocks"),
        (["condition=noise", "frames=next"], "is of single frames; omit frames="),
        (["out={}/crm.npz"], "(Not a directory); choose another folder"),
        (["b={}/crm.npz"], "a and b both contain"),
        (["frames=aligned"], "crm.npz is by ring2, not frames=aligned"),
        (["b=aaa0", "frames=next"], "frames=next is not counted in {}/runs/aaa0, which has none"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(
    call: Call, files: tuple[str, str], tmp_path: Path, arguments: list[str], word: str
) -> None:
    make_run(tmp_path / "runs", "aaa0", "crm", 0)
    words = (*files, *FAST, f"runs_dir={tmp_path}/runs", "archive=none")
    given = dict(word.split("=", 1) for word in words)
    if "aaa0" in arguments[0]:
        given["a"] = "aaa0"
    given |= dict(word.format(tmp_path).split("=", 1) for word in arguments)
    code, out, err = call(entry, *(f"{key}={text}" for key, text in given.items()))
    assert (code, out) == (2, "")
    assert_one_sentence(err, word.format(tmp_path))


def test_different_lists_are_said(call: Call, tmp_path: Path) -> None:
    for (key, split), counts in zip((("aaa0", "train"), ("bbb0", "all")), pair(), strict=True):
        folder = make_run(tmp_path / "runs", key, key, 0)
        lists = lists_of({"domains.source.split": split})
        tags = {"rgbt.group": key, "rgbt.seed": "0", "rgbt.lists": lists}
        RunFolder(folder).describe(Description(key, tags, {}))
        counts.save(folder / "counts_test.npz")
    words = ("a=aaa0", "b=bbb0", f"runs_dir={tmp_path / 'runs'}", *FAST)
    code, out, err = call(entry, *words)
    assert (code, err) == (0, "")
    said = "aaa0 trained on train, selected on val; bbb0 trained on all, selected on val."
    assert said in " ".join(out.split())
