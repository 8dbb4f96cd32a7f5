"""Keys of runs that were made before: the same commands name the same folders."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rgbt.config.compose import conf_dir
from rgbt.config.schema import check
from rgbt.spec import run_key as identity
from rgbt.spec.run_key import run_key
from tests.composed import composed

RECORDED: dict[str, dict[str, str]] = json.loads(
    Path(__file__).with_name("run_keys.json").read_text()
)
"""Key of every experiment by what was typed beside it, recorded on 2026-11-22. An experiment that
is added gets its line here; a line that changes means that runs on users' disks are not found."""

TYPED = {
    "demo": [],
    "smoke": ["+debug=smoke"],
    "paper": ["scale=paper", "dataset.root=x"],
}
QUICK = {
    *(("grbm", "smoke"), ("grbm", "paper"), ("cmx_released", "demo"), ("rtfnet", "demo")),
    *(("temporal_con", "paper"), ("multi_head_night_stage1", "demo")),
}


@pytest.fixture(autouse=True)
def composed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(identity, "compose", composed)


@pytest.mark.parametrize(
    ("experiment", "typed"),
    [
        pytest.param(name, typed, marks=() if (name, typed) in QUICK else pytest.mark.slow)
        for name, keys in RECORDED.items()
        for typed in keys
    ],
)
def test_run_key_of_an_experiment_is_the_recorded_one(experiment: str, typed: str) -> None:
    config = composed([f"+experiment={experiment}", *TYPED[typed]])
    check(config)
    assert run_key(config) == RECORDED[experiment][typed]


def test_every_experiment_has_recorded_keys() -> None:
    assert sorted(RECORDED) == sorted(p.stem for p in (conf_dir() / "experiment").glob("*.yaml"))
