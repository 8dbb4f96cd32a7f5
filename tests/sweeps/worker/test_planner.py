"""From points to run keys, with the configuration of the project and a small data set."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest

from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.spec.specify import specify
from rgbt.tracking.mlflow_store import NoTracking
from sweeps.evaluation import ExtraEvaluation
from sweeps.point import Point
from sweeps.worker.planner import Planner
from sweeps.worker.point_list import PointList, preview_points
from sweeps.worker.run_store import RunStore
from tests.sweeps.fakes import finish, settings


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
    assert (run.steps, run.pixel_factor, plan.point.label) == (6, 0.5, "patch_size=32")
    assert planner.plan(Point("p", plan.point.overrides[1:], seeds=(3,))).key == plan.key


THERMAL = ExtraEvaluation("thermal", "ring9")
AS_TRAINED = {"modality": "default", "regions": "as trained"}


@pytest.mark.parametrize(
    ("seeds", "evaluations", "identities"),
    [
        ((0, 1), (), []),
        ((1,), (THERMAL,), [{"modality": "thermal", "regions": "ring9"}]),
        ((1,), (ExtraEvaluation(frames="aligned"),), [{**AS_TRAINED, "frames": "aligned"}]),
        (
            (1,),
            (ExtraEvaluation(corruption="removed:rgb"), ExtraEvaluation(head="own")),
            [{**AS_TRAINED, "degradation": "rgb_removed"}, {**AS_TRAINED, "head": "own"}],
        ),
        (
            (1,),
            (ExtraEvaluation(corruption="noise", severity=8),),
            [{**AS_TRAINED, "degradation": "noise", "severity": 8}],
        ),
    ],
    ids=["seeds", "modality", "frames", "two", "severity"],
)
def test_plan_key_hashes_runs_and_evaluations(
    planner: Planner,
    seeds: tuple[int, ...],
    evaluations: tuple[ExtraEvaluation, ...],
    identities: list[dict[str, Any]],
) -> None:
    """Keys of older studies stay what they were."""
    plan = planner.plan(Point("p", (), seeds=seeds, evaluations=evaluations))
    keys = [planner.plan(Point("p", (f"seed={seed}",))).key for seed in seeds]
    assert [run.key for run in plan.runs] == keys
    text = json.dumps([keys, identities])
    assert plan.key == hashlib.sha256(text.encode()).hexdigest()[:12]


def test_the_data_set_is_named_by_its_files(planner: Planner, data: Path) -> None:
    dataset = planner.plan(Point("p", ())).runs[0].dataset
    assert planner.plan(Point("q", ("seed=1",))).runs[0].dataset == dataset
    image = next((data / "images").iterdir())
    image.write_bytes(image.read_bytes() + b"0")
    assert planner.plan(Point("p", ())).runs[0].dataset == dataset, "looked at once"
    assert Planner(planner.base).plan(Point("p", ())).runs[0].dataset != dataset


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("masker.sigma=1", "'masker.sigma' is not a key of the configuration"),
        ("masker=grid", "there is no masker 'grid'"),
        ("trainer.max_steps=many", "trainer.max_steps"),
        ("+masker.sigma=1", "'masker.sigma' is not a setting"),
        ("masker", "'masker' is not a valid override"),
        ("dataset.root=/nowhere/to/be/found", "/nowhere/to/be/found"),
    ],
)
def test_conflicting_settings_are_reported_in_one_sentence(
    planner: Planner, override: str, said: str
) -> None:
    with pytest.raises(InputError) as error:
        planner.plan(Point("p", (override,)))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_survey_writes_nothing_and_lists_existing_runs(
    base: tuple[str, ...], planner: Planner, tmp_path: Path
) -> None:
    runs_dir = tmp_path / "runs"
    points = (Point("a", ("seed=1",)), Point("b", ("seed=2",)), Point("c", ("masker=grid",)))
    wanted = PointList("table/x", "x", "list", points, RunStore(runs_dir, NoTracking()), base, None)
    outcomes = preview_points(wanted, settings())
    assert [outcome.state for outcome in outcomes] == ["waiting", "waiting", "failed"]
    assert "there is no masker 'grid'" in outcomes[2].reason
    assert outcomes[2].keys == ()
    assert not runs_dir.exists()

    run = planner.plan(points[1]).runs[0]
    finish(runs_dir / run.key, dataset=run.dataset)
    before = sorted(runs_dir.rglob("*"))
    outcomes = preview_points(wanted, settings())
    assert [outcome.state for outcome in outcomes] == ["waiting", "finished", "failed"]
    assert outcomes[1].keys == (run.key,)
    assert outcomes[1].seconds == 2.5
    assert sorted(runs_dir.rglob("*")) == before
