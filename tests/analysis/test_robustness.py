"""Counts of corrupted images of runs; two methods compared on them."""

from __future__ import annotations

from pathlib import Path

import pytest

from analysis.compare import entry
from analysis.results import open_counts
from analysis.robustness import levels_of, trainings
from rgbt.checks import InputError
from rgbt.evaluation.robustness import CLEAN, FOLDER
from rgbt.metrics.named import value
from tests.analysis.robust_runs import SCORES, less, write_levels, write_run
from tests.commands import Call


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    write_run(tmp_path, "k0", "crm", 0, SCORES)
    write_run(tmp_path, "k1", "crm", 1, less(10))
    write_run(tmp_path, "k2", "none", 0, less(5))
    return tmp_path


def test_is_read_as_the_command_writes_it() -> None:
    from analysis import results

    assert (results.CLEAN, results.ROBUSTNESS) == (CLEAN, FOLDER)


def test_levels_by_title_and_rising_severity(runs: Path) -> None:
    found = levels_of(runs / "k0" / "evaluations" / "robustness" / "test")
    assert [(level.path.stem, level.severity) for level in found] == [
        ("clean", 0.0),
        ("rgb_removed-1", 1.0),
        ("features-thermal", 1.0),
        ("noise-8", 8.0),
        ("noise-16", 16.0),
    ]
    mious = [value("mIoU", level.counts, "released") for level in found]
    assert mious == pytest.approx([80, 20, 30, 60, 40], abs=1e-3)


def test_runs_groups_and_folders_are_trainings(runs: Path) -> None:
    of_group = trainings("crm", runs)
    assert [each.label for each in of_group] == ["crm", "crm"]
    assert value("mIoU", of_group[1].clean, "released") == pytest.approx(70, abs=1e-3)
    assert [level.severity for level in of_group[0].of("noise")] == [8.0, 16.0]
    assert of_group[0].of("frozen") == ()
    folder = write_levels(runs / "elsewhere", SCORES)
    assert [each.label for each in trainings(f"{folder},k2", runs)] == ["elsewhere", "none"]


def test_same_trainings_on_corrupted_images(runs: Path) -> None:
    noisy = open_counts("crm", runs, condition="noise 16")
    assert [value("mIoU", each.counts, "released") for each in noisy] == pytest.approx(
        [40, 30], abs=1e-3
    )
    assert [each.seed for each in noisy] == [0, 1]
    assert noisy[0].path.name == "noise-16.npz"
    for text in ("rgb_removed", "rgb_removed 1"):
        (black, _) = open_counts("crm", runs, condition=text)
        assert value("mIoU", black.counts, "released") == pytest.approx(20, abs=1e-3)


@pytest.mark.parametrize("condition", ["nois 16", "noise 12", "noise"])
def test_missing_condition_is_reported(runs: Path, condition: str) -> None:
    known = "clean, features-thermal 1, noise 16, noise 8, rgb_removed 1"
    with pytest.raises(InputError, match=f"condition={condition} of .* is not one of {known}"):
        open_counts("k0", runs, condition=condition)


def test_inputs_without_measurements_are_reported(runs: Path) -> None:
    place = runs / "k0" / "evaluations" / "robustness"
    (place / "test" / "noise-8.npz").write_bytes(b"x")
    with pytest.raises(InputError, match=r"noise-8.npz' is not a readable file of counts"):
        trainings("k0", runs)
    (place / "test" / "noise-8.json").write_text("{}")
    with pytest.raises(InputError, match=r"noise-8.json is not of rgbt robustness \('row'\)"):
        trainings("k0", runs)
    (place / "test" / "noise-8.json").write_text("{")
    with pytest.raises(InputError, match=r"noise-8.json is damaged"):
        trainings("k0", runs)
    (place / "test" / "noise-8.json").unlink()
    (place / "test" / "clean.json").unlink()
    with pytest.raises(InputError, match=r"has no counts of clean images"):
        trainings("k0", runs)


def test_compare_takes_corrupted_images(call: Call, runs: Path) -> None:
    where = (f"runs_dir={runs}", "metrics=mIoU", "resamples=100", "blocks=none")
    code, out, err = call(entry, "a=k2", "b=k0", "condition=noise 16", *where)
    assert code == 0, err
    # 40 against 35 on noisy images (80 against 75 on clean ones).
    assert "crm (noise 16) minus none (noise 16)" in out
    assert "35.00" in out
    assert "40.00" in out
    code, out, err = call(entry, "a=k2", "b=k0", "condition=rgb_removed", *where)
    assert code == 0, err
    assert "15.00" in out
