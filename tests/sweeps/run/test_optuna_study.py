"""Studies of searches: their storage, who drives them, and what must not change."""

from __future__ import annotations

from pathlib import Path

import pytest

from rgbt.checks import InputError
from sweeps import attributes as names
from sweeps.run.optuna_study import (
    driving,
    known_studies,
    open_storage,
    open_study,
    storage_url,
    study_folder,
)
from sweeps.settings import Objective

UP = (Objective("test/mIoU", "maximize"),)
BOTH = (*UP, Objective("test/Var", "minimize"))


@pytest.mark.parametrize("shared", [None, "sqlite:///{}/all.db"])
def test_studies_are_there_again_in_their_files_or_in_one(
    tmp_path: Path, shared: str | None
) -> None:
    where = shared and shared.format(tmp_path)
    assert known_studies(where, tmp_path) == {}
    assert list(tmp_path.iterdir()) == [], "looking for a study makes nothing"
    for name in ("a/b", "c"):
        study_folder(tmp_path, name).mkdir(parents=True)
        storage = open_storage(storage_url(where, tmp_path, name))
        open_study(name, storage, BOTH, {names.SIGNATURE: name})
    found = known_studies(where, tmp_path)
    assert sorted(found) == ["a/b", "c"]
    assert len(list(tmp_path.rglob("*.db"))) == (1 if shared else 2)
    study = found["c"]
    assert study.user_attrs == {names.SIGNATURE: "c", names.METRICS: ["test/mIoU", "test/Var"]}
    assert study.metric_names == ["test/mIoU", "test/Var"]
    assert [direction.name for direction in study.directions] == ["MAXIMIZE", "MINIMIZE"]


@pytest.mark.parametrize(
    "address",
    [
        *("studies.txt", "nonsense://user:secret@host/x", "sqlite:////no/such/folder/x.db"),
        "postgresql://me:secret@127.0.0.1:9/x",
    ],
)
def test_an_invalid_address_is_named_without_its_password(address: str) -> None:
    with pytest.raises(InputError, match=r"^storage=[^\n]*$") as error:
        open_storage(address)
    assert "secret" not in str(error.value)


def test_another_search_of_the_same_name_is_refused(tmp_path: Path) -> None:
    storage = open_storage(f"sqlite:///{tmp_path}/x.db")
    for _ in range(2):
        open_study("study", storage, UP, {names.SIGNATURE: "a"})
    with pytest.raises(InputError, match="^study=study: .* metrics"):
        open_study("study", storage, BOTH, {names.SIGNATURE: "a"})
    with pytest.raises(InputError, match="^study=study: .* signature"):
        open_study("study", storage, UP, {names.SIGNATURE: "b"})


def test_one_process_drives_a_study(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with driving(tmp_path, "a") as first, driving(tmp_path, "a") as second:
        assert (first, second) == (True, False)
        with driving(tmp_path, "b") as other:
            assert other
    assert "study a is driven by process" in capsys.readouterr().err
    with driving(tmp_path, "a") as again:
        assert again
    with pytest.raises(InputError, match="study=a;b: only letters"), driving(tmp_path, "a;b"):
        pass
