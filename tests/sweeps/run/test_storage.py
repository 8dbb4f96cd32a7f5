"""Opening storages and studies: by one process, by several at once, and by a preview."""

from __future__ import annotations

from pathlib import Path

import pytest

from rgbt.checks import InputError
from sweeps import attributes as names
from sweeps.settings import Objective
from sweeps.run import storage as stores
from sweeps.run.storage import known_studies, open_storage, open_study

UP = (Objective("test/mIoU", "maximize"),)
BOTH = (*UP, Objective("test/Var", "minimize"))


@pytest.mark.parametrize("named", [None, "sqlite:///{}/two.db"])
def test_a_study_is_there_again_in_a_named_storage(tmp_path: Path, named: str | None) -> None:
    where = named and named.format(tmp_path)
    assert known_studies(where, tmp_path / "runs") == {}
    assert list(tmp_path.iterdir()) == [], "looking for a study makes nothing"
    open_study("study", open_storage(where, tmp_path / "runs"), BOTH, {names.KIND: "list"})
    study = known_studies(where, tmp_path / "runs")["study"]
    assert study.user_attrs[names.KIND] == "list"
    assert study.user_attrs[names.METRICS] == ["test/mIoU", "test/Var"]
    assert study.metric_names == ["test/mIoU", "test/Var"]
    assert [direction.name for direction in study.directions] == ["MAXIMIZE", "MINIMIZE"]


@pytest.mark.parametrize(
    "named",
    [
        *("studies.txt", "nonsense://user:secret@host/x", "sqlite:////no/such/folder/x.db"),
        "postgresql://me:secret@127.0.0.1:9/x",
    ],
)
def test_open_storage_invalid_address_raises_without_password(
    tmp_path: Path, named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stores, "PAUSE_S", 0.0)
    with pytest.raises(InputError, match=r"^storage=[^\n]*$") as error:
        open_storage(named, tmp_path)
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


def test_open_study_with_other_attributes_raises(tmp_path: Path) -> None:
    storage = open_storage(None, tmp_path)
    open_study("study", storage, UP, {names.SIGNATURE: "a"})
    open_study("study", storage, UP, {names.SIGNATURE: "a"})
    with pytest.raises(InputError, match="^study=study: .* metrics"):
        open_study("study", storage, BOTH, {names.SIGNATURE: "a"})
    with pytest.raises(InputError, match="^study=study: "):
        open_study("study", storage, UP, {names.SIGNATURE: "b"})
    with pytest.raises(InputError, match="^study=study: "):
        open_study("study", storage, UP, {names.KIND: "list"})
