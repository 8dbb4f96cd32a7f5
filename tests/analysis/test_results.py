"""Counts opened by the names of runs, groups and files."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.results import groups_in, label_of, open_counts
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.runs.folder import Description, RunFolder, counts_name
from tests.analysis.uncertainty.simulated import Population, counts_of

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
    some(seed).save(run.path / counts_name("test"))
    replace(some(seed + 100), split="val").save(run.path / counts_name("val"))
    (run.path / "mlflow.json").write_text(json.dumps({"run_id": f"mlflow-{key}"}))
    if finished:
        run.finish({"mIoU": 0.5})
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
    assert [each.key or "-" for each in found] == keys.split()
    assert label_of(found) == label
    for each in found:
        if each.run is not None and each.seed is not None:
            assert each.path == (runs / each.key / "counts_test.npz").resolve()
            np.testing.assert_array_equal(each.counts.counts, some(each.seed).counts)


def test_split_and_home_folder_take_effect(runs: Path, monkeypatch: pytest.MonkeyPatch):
    (found,) = open_counts("aaa1", runs, split="val")
    np.testing.assert_array_equal(found.counts.counts, some(101).counts)
    monkeypatch.setenv("HOME", str(runs.parent))
    (found,) = open_counts("~/other method.npz")
    np.testing.assert_array_equal(found.counts.counts, some(7).counts)


def test_folder_of_scores_is_opened_by_rings(tmp_path: Path):
    """As `analysis.score` leaves it: rings and strips."""
    for seed, name in enumerate(("horizontal5", "ring5", "vertical5")):
        some(seed).save(tmp_path / f"counts_{name}.npz")
    (found,) = open_counts(str(tmp_path), tmp_path)
    assert (found.label, found.key, found.seed) == (tmp_path.name, "", None)
    assert found.path.name == "counts_ring5.npz"


@pytest.mark.parametrize("names", [("ring5", "ring9"), ("horizontal5", "vertical5")])
def test_ambiguous_folder_of_scores_is_refused(tmp_path: Path, names: tuple[str, str]):
    for name in names:
        some().save(tmp_path / f"counts_{name}.npz")
    files = ", ".join(f"counts_{name}.npz" for name in names)
    with pytest.raises(InputError, match=f"{files}; name one"):
        open_counts(str(tmp_path), tmp_path)


@pytest.mark.parametrize(
    ("text", "options", "word"),
    [
        ("aab0", {}, "'aab0' is not a run folder.*crm scale=demo"),
        ("/no/such/folder", {}, "is not a run folder"),
        ("mlflow-none", {}, "is not a run folder"),
        ("crm scale=dem", {}, "did you mean 'crm scale=demo'"),
        (f"{LONG}1", {}, "is not a run folder"),
        ("abc", {"runs_dir": "none"}, "'abc' is not a run folder"),
        ("crm", {"runs_dir": "none"}, r"neither a run \(config.yaml\) nor counts .*rgbt score"),
        ("none.npz", {}, "the file of counts"),
        ("images.npz", {}, "is not a readable file of counts"),
        ("", {}, "expected runs, files of counts or a group"),
        ("aaa0,,aaa1", {}, "expected runs, files of counts or a group"),
        ("aaa0", {"split": "all"}, "no counts of the split 'all'.*rgbt.evaluate"),
        ("other method.npz", {"split": "val"}, "is of split 'test', not of split=val"),
        ("aaa0,mlflow-aaa0", {}, "twice; one training counts once"),
        (f"{CRM},aaa1", {}, "twice; one training counts once"),
        ("aaa0,runs/aaa0/counts_test.npz", {}, "twice"),
        ("aaa0,link.npz", {}, "twice"),
        ("other method.npz,copy.npz", {}, "hold the same counts; one training"),
        ("aaa0,ggg0", {}, f"names seed 0 of '{CRM}' twice"),  # same overrides, another default
    ],
)
def test_other_inputs_and_repeated_runs_are_refused(
    runs: Path, text: str, options: dict[str, str], word: str
):
    (runs.parent / "link.npz").symlink_to(runs / "aaa0" / "counts_test.npz")
    some(7).save(runs.parent / "copy.npz")
    np.savez(runs.parent / "images.npz", x=np.zeros(3))
    if "ggg0" in text:
        make_run(runs, "ggg0", CRM, 0)
    with pytest.raises(InputError, match=word):
        open_counts(text, **{"runs_dir": runs, **options})


@pytest.mark.parametrize("text", ["{", "{}", "[]"])
def test_damaged_run_stops_nothing_else(runs: Path, capsys: pytest.CaptureFixture[str], text: str):
    broken = make_run(runs, "hhh0", CRM, 9)
    for name in ("run.json", "mlflow.json"):
        (broken / name).write_text(text)
    assert len(open_counts("other method.npz", runs)) == 1
    assert CRM in groups_in(runs)
    with pytest.raises(InputError, match="is not a run folder"):
        open_counts("mlflow-nobody", runs)
    open_counts("aaa9", runs)
    assert "is not finished" in capsys.readouterr().err
