"""Counts opened by the names of runs, groups and files."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.archive import add
from analysis.results import (
    COLUMNS,
    finished_runs,
    label_of,
    open_counts,
    results,
    row_of,
    trainings,
)
from rgbt.checks import InputError
from rgbt.files.plain_files import write_json
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import parse, value
from rgbt.runs.folder import Description, RunFolder
from rgbt.runs.result import RunResult
from tests.analysis.counts import result_of
from tests.analysis.robust_runs import SCORES, less, write_levels, write_run
from tests.analysis.uncertainty.simulated import Population, counts_of, pairs_of
from tests.measured import remeasured, store

CRM, COMMAS = "crm scale=demo", "grbm scale=demo sizes=[1,2]"
LONG = "grbm " + " ".join(f"a_long_key_of_the_configuration_{n}=0.123" for n in range(10))
"""File systems refuse names of more than 255 bytes; groups of many overrides have them."""


def some(seed: int = 0) -> Counts:
    return counts_of(Population().draw(np.random.default_rng(seed), 12, 1)[0])


def make_run(runs: Path, key: str, group: str, seed: int, *, finished: bool = True) -> Path:
    run = RunFolder(runs / key)
    run.write_config("name: x\n")
    tags = {"rgbt.group": group, "rgbt.seed": str(seed)} if group else {}
    run.describe(Description(f"{group} seed={seed}", tags, {}))
    store(run.path, some(seed))
    store(run.path, some(seed + 100), split="val")
    write_json(run.path / "mlflow.json", {"run_id": f"mlflow-{key}"})
    if finished:
        run.finish(result_of(key, some(seed)))
    return run.path


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    runs = tmp_path_factory.mktemp("stored") / "runs"
    for seed in range(3):
        make_run(runs, f"aaa{seed}", CRM, seed)
        make_run(runs, f"bbb{seed}", COMMAS, seed)
    make_run(runs, "ccc0", "", 0)
    make_run(runs, "ddd0", "crm", 5)
    make_run(runs, "eee0", LONG, 4)
    make_run(runs, "aaa9", CRM, 9, finished=False)
    return runs


@pytest.fixture
def runs(stored: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy, below the working folder: writing a run waits for the disk."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "crm").mkdir()  # a folder called like a group does not hide the group
    some(7).save(tmp_path / "other method.npz")
    return Path(shutil.copytree(stored, tmp_path / "runs"))


@pytest.mark.parametrize(
    ("text", "keys", "label"),
    [
        ("{runs}/aaa1", "aaa1", CRM),
        ("runs/aaa1/", "aaa1", CRM),
        ("aaa1", "aaa1", CRM),
        ("mlflow-aaa1", "aaa1", CRM),
        ("ccc0", "ccc0", "ccc0"),  # without a group
        # A seed that still trains is not opened with its group: its counts may be half.
        (CRM, "aaa0 aaa1 aaa2", CRM),
        ("aaa9", "aaa9", CRM),
        ("crm", "ddd0", "crm"),
        (COMMAS, "bbb0 bbb1 bbb2", COMMAS),
        (f"aaa0,{COMMAS}", "aaa0 bbb0 bbb1 bbb2", f"{CRM} + {COMMAS}"),
        ("aaa2, mlflow-aaa0 ,other method.npz", "aaa2 aaa0 -", f"{CRM} + other method"),
        (LONG, "eee0", LONG),
    ],
)
def test_names_open_runs_groups_files_and_lists(runs: Path, text: str, keys: str, label: str):
    found = open_counts(text.format(runs=runs), runs)
    assert [opened.key or "-" for opened in found] == keys.split()
    assert label_of(found) == label
    for opened in found:
        if opened.run is not None and opened.seed is not None:
            assert opened.path == (runs / opened.key / "counts_test.npz").resolve()
            np.testing.assert_array_equal(opened.counts.counts, some(opened.seed).counts)


def test_split_and_home_folder_take_effect(runs: Path, monkeypatch: pytest.MonkeyPatch):
    (found,) = open_counts("aaa1", runs, split="val")
    np.testing.assert_array_equal(found.counts.counts, some(101).counts)
    monkeypatch.setenv("HOME", str(runs.parent))
    (found,) = open_counts("~/other method.npz")
    np.testing.assert_array_equal(found.counts.counts, some(7).counts)


def test_a_file_of_a_run_is_called_after_its_measurement(runs: Path) -> None:
    path = store(runs / "aaa1", some(8), view="thermal")
    found = open_counts(str(path), runs)
    assert (label_of(found), found[0].key) == ("aaa1 · thermal alone", "")


def test_folder_of_scores_is_opened_by_rings(tmp_path: Path) -> None:
    """As `analysis.score` leaves it: rings and strips."""
    for name in ("horizontal5", "ring5"):
        some().save(tmp_path / f"counts_{name}.npz")
    (found,) = open_counts(str(tmp_path), tmp_path)
    assert (found.label, found.key, found.seed) == (tmp_path.name, "", None)
    assert found.path.name == "counts_ring5.npz"
    some().save(tmp_path / "counts_ring9.npz")
    with pytest.raises(InputError, match=r"counts_ring5.npz, counts_ring9.npz; name one of these"):
        open_counts(str(tmp_path), tmp_path)


@pytest.mark.parametrize(
    ("text", "options", "word"),
    [
        ("aab0", {}, "'aab0' is not a run.*crm scale=demo"),
        (f"{LONG}1", {}, "is not a run"),
        ("crm", {"runs_dir": "none"}, "is not a run .* nor counts"),
        ("other method.npz", {"split": "val"}, "is of split 'test', not of split=val"),
        ("aaa0,mlflow-aaa0", {}, "names the same counts twice"),
        (f"{CRM},aaa1", {}, "names the same counts twice"),
        ("other method.npz,copy.npz", {}, "names the same counts twice"),
        ("aaa0,ggg0", {}, f"names seed 0 of '{CRM}' twice"),  # same overrides, another default
    ],
)
def test_other_inputs_and_repeated_runs_are_refused(
    runs: Path, text: str, options: dict[str, str], word: str
):
    some(7).save(runs.parent / "copy.npz")
    if "ggg0" in text:
        some(77).save(make_run(runs, "ggg0", CRM, 0) / "counts_test.npz")
    with pytest.raises(InputError, match=word):
        open_counts(text, **{"runs_dir": runs, **options})


# One frame of a folder of runs and an archive.


@pytest.fixture
def archive(runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The runs of `CRM`, two of them no longer in the folder, and one with other counts."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "results"
    for key in ("aaa0", "aaa1", "aaa2"):
        add(RunResult(runs / key), folder)
    for key in ("aaa0", "aaa1"):
        shutil.rmtree(runs / key)
    some(50).save(runs / "aaa2" / "counts_test.npz")
    return folder


def test_folder_and_archive_are_one(
    runs: Path, archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = finished_runs(runs, archive)
    keys = " ".join(run.key for run in found)
    assert keys == "aaa0 aaa1 aaa2 bbb0 bbb1 bbb2 ccc0 ddd0 eee0"
    np.testing.assert_array_equal(found[1].counts().counts, some(1).counts)
    np.testing.assert_array_equal(found[2].counts().counts, some(50).counts)
    err = capsys.readouterr().err
    assert (err.count("warning"), "aaa2 is stored with other counts" in err) == (1, True)
    assert [run.key for run in finished_runs("none", archive)] == ["aaa0", "aaa1", "aaa2"]
    assert finished_runs("none", "none") == []
    for text, seeds in ((CRM, [0, 1, 2]), ("aaa1", [1])):
        opened = open_counts(text, "none", archive=archive)
        assert [evaluation.seed for evaluation in opened] == seeds
    unpacked = finished_runs("none", archive)[0].folder
    (unpacked / "mark").touch()
    assert (finished_runs("none", archive)[0].folder / "mark").exists()  # unpacked once


def test_frame_has_a_row_for_each_score(runs: Path, archive: Path) -> None:
    night = tuple(place < 4 for place in range(12))
    counts, pairs = replace(some(0), night=night, unscored=("cone",)), pairs_of(12, 0.5)
    folder = runs / "bbb0"
    store(folder, counts, view="thermal")
    kp = {"dataset": "0123456789", "dataset_name": "kp"}
    store(folder, counts, view="rgb", checkpoint="last", step=9, **kp)
    store(folder, some(100), view="thermal", split="val")
    for mark in ("", "-0c"):
        store(folder, pairs, partition=f"{pairs.partition}{mark}")
    write_run(runs, "fff0", "robust", 0, SCORES)
    counts = replace(counts, unscored=())  # what a run scores, it scores under every condition
    frame = results(runs, archive)
    at = ["run", "condition", "severity", "partition", "subset", "region", "class", "metric"]
    assert not frame.duplicated(at).any()
    assert tuple(frame.columns) == COLUMNS
    found = frame.set_index(["run", "condition", "subset", "region", "class", "metric"])["value"]
    for run, condition, of in (
        *(("bbb0", "clean", some(0)), ("aaa1", "clean", some(1)), ("bbb0", "thermal", counts)),
        ("bbb0", "rgb last-9 kp-01234567", counts),
    ):
        for name in ("mIoU", "Var", "region/2", "class/car", "class/cone/acc", "pixel_accuracy"):
            for prefix in ("", "night/")[: 1 + (of is counts)]:
                parsed = parse(f"{prefix}{name}")
                place = parsed.part or "all", parsed.region or 0, parsed.class_name or ""
                key = *place, parsed.score
                assert found[run, condition, *key] == value(f"{prefix}{name}", of, "released")
    region = remeasured(replace(counts, counts=counts.counts[:, 1:]), partition="ring1")
    person = value("class/person", region, "released")
    assert found["bbb0", "thermal", "all", 2, "person", "IoU"] == person
    of_pairs = frame[(frame["metric"] == "TC") & (frame["subset"] == "all")]
    of_pairs = of_pairs[of_pairs["class"] == ""]
    for mark in ("", "-0c"):
        (tc,) = of_pairs["value"][of_pairs["condition"] == f"aligned3{mark}"]
        assert tc == value("TC", pairs, "released")
    (aligned,) = open_counts("bbb0", runs, frames="aligned")
    assert aligned.counts.partition == "aligned3"
    chosen = (frame["metric"] == "mIoU") & (frame["subset"] == "all") & (frame["region"] == 0)
    noise = frame[chosen & (frame["condition"] == "noise")]
    assert dict(zip(noise["severity"], noise["value"].round(2))) == {8.0: 60.0, 16.0: 40.0}
    seeds = frame[frame["group"] == COMMAS].groupby("run")["seed"].first()
    assert dict(seeds) == {"bbb0": 0, "bbb1": 1, "bbb2": 2}
    assert set(results(runs, archive, evaluations=False)["condition"]) == {"clean"}
    assert len(results("none", "none")) == 0


@pytest.mark.parametrize("name", ["result.json", "run.json", "counts_test.npz"])
def test_damaged_run_is_a_remark(runs: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    (runs / "bbb1" / name).write_text("{")
    keys = set(results(runs, "none")["run"])
    assert "bbb1" not in keys
    assert {"bbb0", "aaa1"} <= keys
    assert capsys.readouterr().err.count("warning") == 1


# Corrupted images.


@pytest.fixture
def measured(tmp_path: Path) -> Path:
    write_run(tmp_path, "k0", "crm", 0, SCORES)
    write_run(tmp_path, "k1", "crm", 1, less(10))
    write_run(tmp_path, "k2", "none", 0, less(5))
    return tmp_path


def test_trainings_have_levels_by_title_and_rising_severity(measured: Path) -> None:
    (_, first), (_, second) = trainings("crm", measured)
    assert [level.path.stem for level in first] == [
        *("counts_test", "test_rgb_removed", "test_thermal", "test_noise-8", "test_noise-16")
    ]
    mious = [value("mIoU", level.counts, "released") for level in first]
    assert mious == pytest.approx([80, 20, 30, 60, 40], abs=1e-3)
    assert value("mIoU", second[0].counts, "released") == pytest.approx(70, abs=1e-3)
    assert [level.severity for level in first if level.condition == "noise"] == [8, 16]
    folder = write_levels(measured / "elsewhere", SCORES)
    assert [label for label, _ in trainings(f"{folder},k2", measured)] == ["elsewhere", "none"]


@pytest.mark.parametrize(
    ("condition", "miou"), [("noise 16", 40), ("rgb_removed", 20), ("removed:rgb 1", 20)]
)
def test_same_trainings_on_corrupted_images(measured: Path, condition: str, miou: int) -> None:
    found = open_counts("crm", measured, condition=condition)
    assert [value("mIoU", opened.counts, "released") for opened in found] == pytest.approx(
        [miou, miou - 10], abs=1e-3
    )
    assert [opened.seed for opened in found] == [0, 1]


@pytest.mark.parametrize("condition", ["nois 16", "noise 12"])
def test_missing_condition_is_reported(measured: Path, condition: str) -> None:
    known = "clean, noise 16, noise 8, rgb_removed 1, thermal of"
    with pytest.raises(InputError, match=f"condition={condition} is not counted .* has {known}"):
        open_counts("k0", measured, condition=condition)


def test_condition_of_several_severities_is_refused(measured: Path) -> None:
    with pytest.raises(InputError, match="condition=noise names test_noise-16.npz, test_noise-8"):
        open_counts("k0", measured, condition="noise")


def test_levels_of_weights_that_were_all_predicted_otherwise_are_found(tmp_path: Path) -> None:
    """What all files of a folder have in common, such as mirrored images, is no condition."""
    usual = {"weights": "ab" * 32, "changed": ("prediction.mirrored",)}
    noise = {"corruption": "noise", "title": "noise", "unit": "levels", "severity": 8.0}
    changed = ("prediction.mirrored", "severity")
    clean, noisy = remeasured(some(0), **usual), remeasured(some(1), **(usual | noise))
    noisy = remeasured(noisy, changed=changed)
    (tmp_path / "measured").mkdir()
    for name, counts in (("clean", clean), ("noise", noisy)):
        counts.save(tmp_path / "measured" / f"{name}.npz")
    ((_, levels),) = trainings(str(tmp_path / "measured"))
    assert [row_of(level) for level in levels] == ["clean", "noise"]
