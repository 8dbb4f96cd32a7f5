"""Counts of corrupted images of runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from analysis import results
from analysis.results import open_counts
from analysis.robustness import levels_of, trainings
from rgbt.checks import InputError
from rgbt.evaluation import robustness
from rgbt.metrics.named import value
from tests.analysis.robust_runs import SCORES, less, write_levels, write_run


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    write_run(tmp_path, "k0", "crm", 0, SCORES)
    write_run(tmp_path, "k1", "crm", 1, less(10))
    write_run(tmp_path, "k2", "none", 0, less(5))
    return tmp_path


def test_trainings_have_levels_by_title_and_rising_severity(runs: Path) -> None:
    assert (results.CLEAN, results.ROBUSTNESS) == (robustness.CLEAN, robustness.FOLDER)
    first, second = trainings("crm", runs)
    assert [level.path.stem for level in first.levels] == [
        *("clean", "rgb_removed-1", "features-thermal", "noise-8", "noise-16")
    ]
    mious = [value("mIoU", level.counts, "released") for level in first.levels]
    assert mious == pytest.approx([80, 20, 30, 60, 40], abs=1e-3)
    assert value("mIoU", second.levels[0].counts, "released") == pytest.approx(70, abs=1e-3)
    assert [level.severity for level in first.levels if level.row == "noise"] == [8.0, 16.0]
    assert "frozen" not in {level.row for level in first.levels}
    folder = write_levels(runs / "elsewhere", SCORES)
    assert [each.label for each in trainings(f"{folder},k2", runs)] == ["elsewhere", "none"]


@pytest.mark.parametrize(
    ("condition", "miou"), [("noise 16", 40), ("rgb_removed", 20), ("removed:rgb 1", 20)]
)
def test_same_trainings_on_corrupted_images(runs: Path, condition: str, miou: int) -> None:
    found = open_counts("crm", runs, condition=condition)
    assert [value("mIoU", each.counts, "released") for each in found] == pytest.approx(
        [miou, miou - 10], abs=1e-3
    )
    assert [each.seed for each in found] == [0, 1]


@pytest.mark.parametrize("condition", ["nois 16", "noise 12", "noise"])
def test_missing_condition_is_reported(runs: Path, condition: str) -> None:
    known = "clean, features-thermal 1, noise 16, noise 8, rgb_removed 1"
    with pytest.raises(InputError, match=f"condition={condition} is not counted .* has {known}"):
        open_counts("k0", runs, condition=condition)


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("noise-8.npz", "x", "noise-8.npz' is not a readable file of counts"),
        ("noise-8.json", "{}", r"noise-8.json is not of rgbt robustness \('row'\)"),
        ("noise-8.json", "{", "noise-8.json is damaged"),
        (
            "noise-8.json",
            json.dumps({"row": 1, "title": "", "unit": "", "severity": "x"}),
            "is not",
        ),
        ("clean.json", "", "has no counts of clean images"),
    ],
)
def test_damaged_measurement_is_reported(runs: Path, name: str, content: str, word: str) -> None:
    place = runs / "k0" / "evaluations" / "robustness" / "test"
    (place / name).write_text(content) if content else (place / name).unlink()
    with pytest.raises(InputError, match=word):
        levels_of(place)
