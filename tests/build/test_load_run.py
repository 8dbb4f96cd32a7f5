"""A stored run opened again: what is told where its data set is divided otherwise by now."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from omegaconf import DictConfig, OmegaConf

from rgbt.build import load_run as stored
from rgbt.build.session import names_key
from rgbt.checks import InputError
from rgbt.config.compose import conf_dir
from tests.composed import composed


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


def resolved(*overrides: str) -> DictConfig:
    """A configuration as a run stores it."""
    config = OmegaConf.create(OmegaConf.to_container(composed(overrides), resolve=True))
    assert isinstance(config, DictConfig)
    return config


OTHER = (("dataset", "synth_kp"), ("dataset.absent", "exclude"))


@pytest.mark.parametrize(
    ("trained", "pairs", "expected"),
    [
        ((), (), "released"),
        # Another data set brings its convention; another partition changes none.
        ((), OTHER, "exclude"),
        (("dataset.absent=exclude",), (("dataset", "synth_kp"),), "released"),
        (("dataset.absent=exclude",), (("metric", "ring9"),), "exclude"),
        # By hand, of the run or of the command that measures it.
        (("metric.absent=exclude",), (("dataset", "synth_kp"),), "exclude"),
        ((), (("metric", "ring9"), ("metric.absent", "exclude")), "exclude"),
    ],
)
def test_absent_classes_of_a_stored_run_count_as_the_measured_data_set_says(
    trained: tuple[str, ...], pairs: tuple[tuple[str, str], ...], expected: str
) -> None:
    config = resolved(*trained)
    stored._override(config, list(pairs))
    assert config.metric.absent == expected


def test_a_stored_partition_of_a_class_without_the_setting_is_opened() -> None:
    config = resolved()
    config.metric = {"_target_": "my_lab.Halved"}
    stored._override(config, [("data.eval_batch_size", "1")])
    assert config.metric == {"_target_": "my_lab.Halved"}
    stored._override(config, [("metric", "ring9")])
    assert config.metric.absent == "released", "that of the data set"


def test_a_data_set_of_its_own_class_leaves_absent_classes_out() -> None:
    config = composed(())
    assert config.metric.absent == "released"
    del config.dataset.absent
    assert config.metric.absent == "exclude"
    for path in sorted((conf_dir() / "dataset").glob("*.yaml")):
        text = path.read_text()
        expected = "exclude" if path.stem == "folder" else "released"
        assert f"\nabsent: {expected} #" in text or "_target_" not in text, path
