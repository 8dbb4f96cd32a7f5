"""A finished run opened again: warnings where its data set has other splits now."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from rgbt.build import load_run
from rgbt.build.session import names_key
from rgbt.checks import InputError


def session(name: str | None = "rig", **splits: tuple[str, ...]) -> SimpleNamespace:
    def names(split: str) -> tuple[str, ...]:
        if split not in splits:
            raise InputError(f"no split {split}")
        return splits[split]

    return SimpleNamespace(
        domains=SimpleNamespace(named={"source": SimpleNamespace(split="train")}),
        dataset=SimpleNamespace(names=names, name="rig", root=Path("/data/rig")),
        spec=SimpleNamespace(dataset=SimpleNamespace(plain={"name": name})),
    )


@pytest.fixture
def warnings(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    lines: list[str] = []
    monkeypatch.setattr(load_run, "warn", lines.append)
    return lines


def test_other_splits_are_reported(tmp_path: Path, warnings: list[str]) -> None:
    before = session(train=("a", "b"), test=("c",))
    (tmp_path / "dataset.json").write_text(json.dumps({"names": names_key(before), "files": "x"}))
    load_run._warn_of_other_splits(tmp_path, before)
    load_run._warn_of_other_splits(tmp_path, session(None, train=("a", "c"), test=("b",)))
    load_run._warn_of_other_splits(tmp_path, session(test=("c",)))
    assert warnings == [], "the same splits, a data set without name, no training images"
    load_run._warn_of_other_splits(tmp_path, session(train=("a", "c"), test=("b",)))
    (line,) = warnings
    assert "training images may be evaluated" in line
    assert "rig (/data/rig)" in line


def test_other_splits_without_recorded_names_are_not_reported(
    tmp_path: Path, warnings: list[str]
) -> None:
    load_run._warn_of_other_splits(tmp_path, session(train=("a",), test=("b",)))
    (tmp_path / "dataset.json").write_text("{")
    load_run._warn_of_other_splits(tmp_path, session(train=("a",), test=("b",)))
    assert warnings == []
