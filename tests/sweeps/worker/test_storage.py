"""Opening storages and studies: by one process, by several at once, and by a preview."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from rgbt.checks import InputError
from sweeps import attributes as names
from sweeps.settings import Objective
from sweeps.worker import storage as stores
from sweeps.worker.storage import (
    find_study,
    load_study,
    open_storage,
    open_study,
)

UP = (Objective("test/mIoU", "maximize"),)
BOTH = (*UP, Objective("test/Var", "minimize"))


@pytest.mark.parametrize("named", ["{}/deep/one.journal", "sqlite:///{}/two.db"])
def test_a_study_is_there_again_in_a_named_storage(tmp_path: Path, named: str) -> None:
    where = named.format(tmp_path)
    open_study("study", open_storage(where, tmp_path), BOTH, {names.KIND: "list"})
    study = load_study("study", open_storage(where, tmp_path))
    assert study.user_attrs[names.KIND] == "list"
    assert study.user_attrs[names.METRICS] == ["test/mIoU", "test/Var"]
    assert study.metric_names == ["test/mIoU", "test/Var"]
    assert [direction.name for direction in study.directions] == ["MAXIMIZE", "MINIMIZE"]


@pytest.mark.parametrize(
    ("named", "said"),
    [
        ("studies.txt", "studies.txt: expected a file that ends in .journal"),
        ("nonsense://user:secret@host/x", "nonsense"),
    ],
)
def test_open_storage_invalid_address_raises(
    tmp_path: Path, named: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stores, "PAUSE_S", 0.0)
    with pytest.raises(InputError) as error:
        open_storage(named, tmp_path)
    assert said in str(error.value)
    assert "secret" not in str(error.value)
    assert "\n" not in str(error.value)


def test_open_storage_error_hides_password(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stores, "PAUSE_S", 0.0)
    with pytest.raises(InputError, match="its folder does not exist"):
        open_storage(f"sqlite:///{tmp_path}/no/such/folder.db", tmp_path)
    with pytest.raises(InputError) as error:
        open_storage("postgresql://me:secret@127.0.0.1:9/x", tmp_path)
    assert "cannot be opened" in str(error.value)
    assert "secret" not in str(error.value)


def test_open_storage_retries_while_tables_are_created(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stores, "PAUSE_S", 0.0)
    tries: list[int] = []

    def opening() -> str:
        tries.append(1)
        if len(tries) < 3:
            raise RuntimeError("table studies already exists")
        return "open"

    assert stores._retry(opening, "sqlite:///x") == "open"
    assert len(tries) == 3


OPEN = """
import sys
from pathlib import Path
import optuna, sqlalchemy  # loaded before the start, so that all open at the same time
from sweeps.settings import Objective
from sweeps.worker.storage import open_study, open_storage
print("ready", flush=True)
sys.stdin.readline()
storage = open_storage(sys.argv[1], Path("."))
study = open_study("study", storage, (Objective("test/mIoU", "maximize"),), {"rgbt.kind": "list"})
study.add_trial(optuna.trial.create_trial(value=1.0))
"""


@pytest.mark.parametrize(
    ("named", "processes"), [("sqlite:///{}/fresh.db", 3), ("{}/fresh.journal", 2)]
)
def test_open_storage_by_several_processes_at_once(
    tmp_path: Path, named: str, processes: int
) -> None:
    where = named.format(tmp_path)
    every = [
        subprocess.Popen(
            [sys.executable, "-c", OPEN, where],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for _ in range(processes)
    ]
    for process in every:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in every:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    ends = [(process.communicate()[1], process.returncode) for process in every]
    assert [code for _, code in ends] == [0] * processes, ends
    study = load_study("study", open_storage(where, tmp_path))
    assert [trial.number for trial in study.trials] == list(range(processes))


def test_open_study_with_other_attributes_raises(tmp_path: Path) -> None:
    storage = open_storage(None, tmp_path)
    open_study("study", storage, UP, {names.SIGNATURE: "a"})
    open_study("study", storage, UP, {names.SIGNATURE: "a"})
    with pytest.raises(InputError, match="'study' with other objectives"):
        open_study("study", storage, BOTH, {names.SIGNATURE: "a"})
    with pytest.raises(InputError, match="'study' with another space"):
        open_study("study", storage, UP, {names.SIGNATURE: "b"})
    with pytest.raises(InputError, match="'study' with another space"):
        open_study("study", storage, UP, {names.KIND: "list"})


def test_load_study_unknown_name_lists_studies(tmp_path: Path) -> None:
    storage = open_storage(None, tmp_path)
    with pytest.raises(InputError, match="no study 'x'; the storage has none"):
        load_study("x", storage)
    open_study("table/one", storage, UP, {})
    with pytest.raises(InputError, match="did you mean 'table/one'"):
        load_study("table/on", storage)


def test_looking_for_a_study_makes_nothing(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    for named in (None, f"{tmp_path}/x/one.journal", f"sqlite:///{tmp_path}/two.db"):
        assert find_study("study", named, runs) is None
    assert list(tmp_path.iterdir()) == []


def test_journal_in_the_home_folder_is_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    open_study("study", open_storage("~/one.journal", tmp_path), UP, {})
    assert (tmp_path / "one.journal").is_file()
    assert find_study("study", "~/one.journal", tmp_path) is not None
