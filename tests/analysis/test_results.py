"""Counts found by the names that people give them."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.results import NamedCounts, groups_in, label_of, open_counts
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.tracking.run_files import Description, counts_name, read_description
from rgbt.tracking.run_folder import RunFolder
from tests.analysis.uncertainty.simulated import Population, counts_of

COMMAS = "grbm scale=demo sizes=[1,2]"


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
        make_run(runs, f"aaa{seed}", "crm scale=demo", seed)
        make_run(runs, f"bbb{seed}", COMMAS, seed)
    return runs


@pytest.fixture
def runs(stored: Path, tmp_path: Path) -> Path:
    """A copy: writing a run waits for the disk."""
    return Path(shutil.copytree(stored, tmp_path / "runs"))


def holds(named: NamedCounts, seed: int) -> bool:
    return bool((named.counts.counts == some(seed).counts).all())


@pytest.mark.parametrize("form", ["{runs}/aaa1", "aaa1", "mlflow-aaa1"])
def test_a_run(runs: Path, form: str):
    (found,) = open_counts(form.format(runs=runs), runs)
    assert (found.label, found.key, found.seed) == ("crm scale=demo", "aaa1", 1)
    assert found.path == (runs / "aaa1" / "counts_test.npz").resolve()
    assert holds(found, 1)


def test_a_run_by_a_relative_folder(runs: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(runs.parent)
    (found,) = open_counts("runs/aaa2/")
    assert holds(found, 2)


def test_another_split(runs: Path):
    (found,) = open_counts("aaa1", runs, split="val")
    assert holds(found, 101)


def test_a_run_without_a_group_is_called_by_its_key(runs: Path):
    make_run(runs, "ccc0", "", 0)
    (found,) = open_counts("ccc0", runs)
    assert (found.label, found.seed) == ("ccc0", None)


def test_a_file(runs: Path, tmp_path: Path):
    some(7).save(tmp_path / "other method.npz")
    (found,) = open_counts(str(tmp_path / "other method.npz"), runs)
    assert (found.label, found.key, found.seed) == ("other method", "", None)
    assert holds(found, 7)


def test_a_file_under_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    some(7).save(tmp_path / "mine.npz")
    assert holds(open_counts("~/mine.npz")[0], 7)


@pytest.mark.parametrize(("group", "keys"), [("crm scale=demo", "aaa"), (COMMAS, "bbb")])
def test_a_group_is_all_its_seeds(runs: Path, group: str, keys: str):
    found = open_counts(group, runs)
    assert [each.key for each in found] == [f"{keys}{seed}" for seed in range(3)]
    assert [each.seed for each in found] == [0, 1, 2]
    assert all(holds(each, each.seed) for each in found if each.seed is not None)
    assert label_of(found) == group


def test_a_group_is_its_whole_name(runs: Path):
    make_run(runs, "ddd0", "crm", 0)
    assert [each.key for each in open_counts("crm", runs)] == ["ddd0"]


def test_a_run_made_before_is_found_by_its_old_group_and_with_new_runs(runs: Path):
    """It wrote ${px:64}; what it stands for is in its parameters."""
    for seed, value in ((0, "${px:64}"), (1, "32")):
        folder = make_run(runs, f"ddd{seed}", f"grbm patch_size={value}", seed)
        run = RunFolder(folder)
        description = read_description(run.path)
        assert description is not None
        run.describe(replace(description, params={"scale.pixel_factor": "0.5"}))
    found = open_counts("grbm patch_size=32", runs)
    assert [each.key for each in found] == ["ddd0", "ddd1"]
    assert label_of(found) == "grbm patch_size=32"
    assert [each.key for each in open_counts("grbm patch_size=${px:64}", runs)] == ["ddd0"]
    assert "grbm patch_size=${px:64}" not in groups_in(runs)


def test_a_list(runs: Path, tmp_path: Path):
    some(7).save(tmp_path / "x.npz")
    found = open_counts(f"aaa2, mlflow-aaa0 ,{tmp_path}/x.npz", runs)
    assert [each.key for each in found] == ["aaa2", "aaa0", ""]
    assert label_of(found) == "crm scale=demo + x"


def test_a_group_with_commas_in_a_list(runs: Path):
    found = open_counts(f"{COMMAS},aaa0", runs)
    assert [each.key for each in found] == ["bbb0", "bbb1", "bbb2", "aaa0"]
    found = open_counts(f"aaa0,{COMMAS}", runs)
    assert [each.key for each in found] == ["aaa0", "bbb0", "bbb1", "bbb2"]


def test_a_folder_of_scores(tmp_path: Path):
    folder = tmp_path / "scored"
    folder.mkdir()
    some(7).save(folder / "counts_ring5.npz")
    (found,) = open_counts(str(folder), tmp_path)
    assert (found.label, found.key, found.seed) == ("scored", "", None)
    assert holds(found, 7)


def test_a_folder_of_scores_is_opened_by_rings(tmp_path: Path):
    """As `analysis.score` leaves it: rings and strips."""
    for seed, name in enumerate(("horizontal5", "ring5", "vertical5")):
        some(seed).save(tmp_path / f"counts_{name}.npz")
    (found,) = open_counts(str(tmp_path), tmp_path)
    assert found.path.name == "counts_ring5.npz"
    assert holds(found, 1)


@pytest.mark.parametrize("names", [("ring5", "ring9"), ("horizontal5", "vertical5")])
def test_a_folder_of_scores_that_leaves_a_choice(tmp_path: Path, names: tuple[str, str]):
    for name in names:
        some().save(tmp_path / f"counts_{name}.npz")
    files = ", ".join(f"counts_{name}.npz" for name in names)
    with pytest.raises(InputError, match=f"{files}; name one"):
        open_counts(str(tmp_path), tmp_path)


def test_a_folder_of_something_else(tmp_path: Path):
    (tmp_path / "labels").mkdir()
    with pytest.raises(InputError, match=r"neither a run \(config.yaml\) nor counts .*rgbt score"):
        open_counts(str(tmp_path / "labels"), tmp_path)


def test_a_run_that_is_not_finished_is_opened_by_name_but_not_with_its_group(runs: Path):
    """The seed that still trains must not be passed over in silence: its counts may be half."""
    make_run(runs, "aaa9", "crm scale=demo", 9, finished=False)
    assert len(open_counts("aaa9", runs)) == 1
    assert [each.key for each in open_counts("crm scale=demo", runs)] == ["aaa0", "aaa1", "aaa2"]


def test_no_counts_of_that_split(runs: Path):
    with pytest.raises(
        InputError, match=r"has counts of the splits test, val, not of 'all'.*rgbt.eval"
    ):
        open_counts("aaa0", runs, split="all")


@pytest.mark.parametrize("unknown", ["aab0", "/no/such/folder", "crm scale=dem", "mlflow-none"])
def test_no_such_thing(runs: Path, unknown: str):
    with pytest.raises(InputError, match=f"'{unknown}' is no run folder") as raised:
        open_counts(unknown, runs)
    assert "crm scale=demo" in str(raised.value)


def test_no_such_group_names_the_nearest(runs: Path):
    with pytest.raises(InputError, match="did you mean 'crm scale=demo'"):
        open_counts("crm scale=dem", runs)


def test_no_runs_at_all(tmp_path: Path):
    with pytest.raises(InputError, match="'abc' is no run folder"):
        open_counts("abc", tmp_path / "none")


def test_no_such_file(tmp_path: Path):
    with pytest.raises(InputError, match="there is no file of counts"):
        open_counts(str(tmp_path / "none.npz"))
    np.savez(tmp_path / "images.npz", x=np.zeros(3))
    with pytest.raises(InputError, match="is no file of counts"):
        open_counts(str(tmp_path / "images.npz"))


@pytest.mark.parametrize("text", ["", ",", "aaa0,", ",aaa0", "aaa0,,aaa1"])
def test_an_empty_name(runs: Path, text: str):
    with pytest.raises(InputError, match="expected runs, files of counts or a group"):
        open_counts(text, runs)


@pytest.mark.parametrize("text", ["aaa0,aaa0", "aaa0,mlflow-aaa0", "crm scale=demo,aaa1"])
def test_one_training_counts_once(runs: Path, text: str):
    with pytest.raises(InputError, match="twice; one training counts once"):
        open_counts(text, runs)


def test_one_training_counts_once_by_another_path(runs: Path, tmp_path: Path):
    with pytest.raises(InputError, match="twice"):
        open_counts(f"aaa0,{runs}/aaa0/counts_test.npz", runs)
    (tmp_path / "link.npz").symlink_to(runs / "aaa0" / "counts_test.npz")
    with pytest.raises(InputError, match="twice"):
        open_counts(f"aaa0,{tmp_path}/link.npz", runs)


def test_a_long_name_of_a_group(runs: Path):
    """File systems refuse names of more than 255 bytes; groups of many overrides have them."""
    group = "grbm " + " ".join(f"a_long_key_of_the_configuration_{n}=0.123" for n in range(10))
    assert len(group) > 255
    make_run(runs, "eee0", group, 0)
    assert [each.key for each in open_counts(group, runs)] == ["eee0"]
    with pytest.raises(InputError, match="is no run folder"):
        open_counts(group + "1", runs)


def test_a_group_called_like_a_folder_here(runs: Path, monkeypatch: pytest.MonkeyPatch):
    """A folder of that name that holds neither run nor counts does not hide the group."""
    make_run(runs, "ddd0", "crm", 0)
    (runs.parent / "crm").mkdir()
    monkeypatch.chdir(runs.parent)
    assert [each.key for each in open_counts("crm", runs)] == ["ddd0"]


def test_nothing_is_written(runs: Path):
    before = sorted(os.walk(runs))
    for text in ("aaa0", "crm scale=demo", "mlflow-aaa0"):
        open_counts(text, runs)
    with pytest.raises(InputError):
        open_counts("nothing", runs)
    assert sorted(os.walk(runs)) == before


def test_one_seed_twice_is_no_second_training(runs: Path):
    make_run(runs, "ddd0", "crm scale=demo", 0)  # same overrides, another default
    with pytest.raises(InputError, match="names seed 0 of 'crm scale=demo' twice"):
        open_counts("crm scale=demo", runs)


def test_equal_counts_are_one_training(runs: Path, tmp_path: Path):
    for name in ("one", "other"):
        some(7).save(tmp_path / f"{name}.npz")
    with pytest.raises(InputError, match="hold the same counts; one training"):
        open_counts(f"{tmp_path}/one.npz,{tmp_path}/other.npz", runs)


@pytest.mark.parametrize("text", ["{", "{}", "[]"])
def test_a_damaged_run_stops_nothing_else(runs: Path, tmp_path: Path, text: str):
    broken = make_run(runs, "eee0", "crm scale=demo", 9)
    for name in ("run.json", "mlflow.json"):
        (broken / name).write_text(text)
    some(7).save(tmp_path / "one.npz")
    assert len(open_counts(str(tmp_path / "one.npz"), runs)) == 1
    assert "crm scale=demo" in groups_in(runs)
    with pytest.raises(InputError, match="is no run folder"):
        open_counts("mlflow-nobody", runs)


def test_an_unfinished_run_is_said(runs: Path, capsys: pytest.CaptureFixture[str]):
    make_run(runs, "fff0", "new", 0, finished=False)
    open_counts("fff0", runs)
    assert "is not finished" in capsys.readouterr().err
    assert "new" not in groups_in(runs)
