"""The table at the end of a grid: values by hand."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rgbt.runs.result import RunResult
from sweeps.point import Outcome, Point
from sweeps.show.seed_groups import group_grid, unfinished_grid
from tests.sweeps.fakes import finish


def made(folder: Path, label: str, **scores: float) -> Outcome:
    test: Mapping[str, float] = {name.replace("__", "/"): value for name, value in scores.items()}
    run = finish(folder / label.replace(" ", "_"), test=test)
    key = run.path.name
    return Outcome(Point(label, ()), "finished", results=(RunResult(run.path),), keys=(key,))


def test_group_grid_shows_mean_and_sample_sd(tmp_path: Path) -> None:
    outcomes = [
        made(tmp_path, "sigma_div=1 seed=0", mIoU=0.40, Var=2.0, region__1=0.5),
        made(tmp_path, "sigma_div=1 seed=1", mIoU=0.44, Var=4.0, region__1=0.5),
        made(tmp_path, "sigma_div=1 seed=2", mIoU=0.48, Var=6.0, region__1=0.5),
        made(tmp_path, "sigma_div=2 seed=0", mIoU=0.30, Var=1.0, region__1=0.25),
        Outcome(Point("sigma_div=2 seed=1", ()), "failed", "a bad day", keys=("k",)),
        Outcome(Point("sigma_div=3 seed=0", ()), "running", keys=("l",)),
        Outcome(Point("sigma_div=3 seed=1", ()), "failed", "a bad day", keys=("m",)),
    ]
    grid = group_grid("study", outcomes)
    assert grid.header == ("configuration", "seeds", "mIoU", "Var", "region/1")
    assert grid.rows == (
        ("sigma_div=1", "3", "44.00 ± 4.00", "4.00 ± 2.00", "50.00 ± 0.00"),
        ("sigma_div=2", "1 of 2", "30.00", "1.00", "25.00"),
        ("sigma_div=3", "0 of 2", "-", "-", "-"),
    )
    assert unfinished_grid(outcomes).rows == (
        ("sigma_div=2 seed=1", "failed", "k", "a bad day"),
        ("sigma_div=3 seed=0", "running", "l", ""),
        ("sigma_div=3 seed=1", "failed", "m", "a bad day"),
    )


def test_a_seed_that_was_typed_twice_counts_once(tmp_path: Path) -> None:
    first, second = (made(tmp_path, f"x=1 seed={n}", mIoU=0.4 + n / 10, Var=2.0) for n in (0, 1))
    (row,) = group_grid("study", [first, first, second]).rows
    assert row[1:3] == ("2", "45.00 ± 7.07")
