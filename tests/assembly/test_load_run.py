"""A finished run opened again: warnings where its data set has other splits now."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from rgbt.assembly import load_run
from rgbt.assembly.session import names_key
from rgbt.files.plain_files import write_json


def session(name: str | None = "rig", **splits: tuple[str, ...]) -> SimpleNamespace:
    return SimpleNamespace(
        domains=SimpleNamespace(named={"source": SimpleNamespace(split="train")}),
        dataset=SimpleNamespace(name="rig", root=Path("/data/rig")),
        names=splits,
        spec=SimpleNamespace(dataset=SimpleNamespace(plain={"name": name})),
    )


def test_other_splits_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    warnings: list[str] = []
    monkeypatch.setattr(load_run, "warn", warnings.append)
    before, other = (session(train=("a", image), test=("c",)) for image in "bc")
    marker = tmp_path / "dataset.json"
    load_run._warn_of_other_splits(tmp_path, other)
    marker.write_text("{")
    load_run._warn_of_other_splits(tmp_path, other)
    write_json(marker, {"names": names_key(before), "files": "x"})
    for opened in (before, session(None, train=("a", "c"), test=("b",))):
        load_run._warn_of_other_splits(tmp_path, opened)
    assert warnings == [], "unknown, the same, a data set without name"
    load_run._warn_of_other_splits(tmp_path, other)
    (line,) = warnings
    assert "training images may be among the evaluated" in line
