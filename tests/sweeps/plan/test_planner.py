"""From points to run keys, with the configuration of the project and a small data set."""

from __future__ import annotations

from pathlib import Path

import pytest

from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.runs.specify import specify
from sweeps.plan.planner import Planner
from sweeps.point import Point


@pytest.fixture
def base(data: Path, tmp_path: Path) -> tuple[str, ...]:
    return (
        *("+experiment=grbm", "dataset=mfnet", f"dataset.root={data}"),
        *("tracking=none", f"runs_dir={tmp_path / 'runs'}", "trainer.max_steps=6"),
    )


@pytest.fixture
def planner(base: tuple[str, ...]) -> Planner:
    return Planner(base)


def test_plan_uses_run_key_of_command(planner: Planner, base: tuple[str, ...]) -> None:
    label = "patch_size=${px:64}"
    plan = planner.plan(Point(label, ("seed=3", f"masker.{label}")))
    (run,) = plan.runs
    assert run.key == plan.key == specify(compose([*base, *plan.point.overrides])).key
    assert run.overrides == (*base, *plan.point.overrides)
    shown = (run.trainer.max_steps, run.scale.pixel_factor, plan.point.label)
    assert shown == (6, 1.0, "patch_size=64")
    assert planner.plan(Point("p", plan.point.overrides[1:], seeds=(3,))).key == plan.key


EVALUATIONS = (
    ("modality=thermal", "regions=ring9"),
    ("frames=aligned",),
    ("corruption=noise", "severity=8"),
    ("corruption=noise:rgb", "severity=8"),
    ("head=own",),
)


def test_plan_key_hashes_runs_and_evaluations(planner: Planner) -> None:
    plan = planner.plan(Point("p", (), seeds=(0, 1)))
    runs = [planner.plan(Point("p", (f"seed={seed}",))).key for seed in (0, 1)]
    assert [run.key for run in plan.runs] == runs
    keys = {planner.plan(Point("p", (), evaluations=(words,))).key for words in EVALUATIONS}
    assert len({*runs, plan.key, *keys}) == 3 + len(EVALUATIONS)
    same = planner.plan(Point("q", (), evaluations=((*EVALUATIONS[0],),))).key
    assert same in keys


def test_the_data_set_is_named_by_its_files(planner: Planner, data: Path) -> None:
    def named(by: Planner, *words: str) -> list[str]:
        return [*by.plan(Point("p", words)).fingerprints.values()]

    dataset = named(planner)
    assert named(planner, "seed=1") == dataset
    image = next((data / "images").iterdir())
    image.write_bytes(image.read_bytes() + b"0")
    assert named(planner) == dataset, "looked at once"
    assert named(Planner(planner.base)) != dataset


def test_a_data_set_without_images_is_refused_in_one_line(planner: Planner) -> None:
    with pytest.raises(InputError, match=r"^[^\n]*/nowhere/to/be/found[^\n]*$"):
        planner.plan(Point("p", ("dataset.root=/nowhere/to/be/found",)))
