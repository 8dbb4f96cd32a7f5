"""A stored run opened again: what is told where its data set is divided otherwise by now."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from rgbt import stored
from rgbt.checks import InputError
from rgbt.session import names_key


def session(**splits: tuple[str, ...]) -> SimpleNamespace:
    def names(split: str) -> tuple[str, ...]:
        if split not in splits:
            raise InputError(f"no split {split}")
        return splits[split]

    return SimpleNamespace(
        domains=SimpleNamespace(named={"source": SimpleNamespace(split="train")}),
        dataset=SimpleNamespace(names=names, name="rig", root=Path("/data/rig")),
        config=SimpleNamespace(dataset={"name": "rig"}),
    )


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    lines: list[str] = []
    monkeypatch.setattr(stored, "tell", lines.append)
    return lines


def test_other_splits_are_told(tmp_path: Path, said: list[str]) -> None:
    before = session(train=("a", "b"), test=("c",))
    (tmp_path / "dataset.json").write_text(json.dumps({"names": names_key(before), "files": "x"}))
    stored._tell_other_splits(tmp_path, "rig", before)
    stored._tell_other_splits(tmp_path, "other", session(train=("a", "c"), test=("b",)))
    stored._tell_other_splits(tmp_path, "rig", session(test=("c",)))
    assert said == [], "the same splits, another data set, no training images at hand"
    stored._tell_other_splits(tmp_path, "rig", session(train=("a", "c"), test=("b",)))
    (line,) = said
    assert "may hold images of its training" in line
    assert "rig (/data/rig)" in line


def test_without_a_note_nothing_is_told(tmp_path: Path, said: list[str]) -> None:
    stored._tell_other_splits(tmp_path, "rig", session(train=("a",), test=("b",)))
    (tmp_path / "dataset.json").write_text("{")
    stored._tell_other_splits(tmp_path, "rig", session(train=("a",), test=("b",)))
    assert said == []
