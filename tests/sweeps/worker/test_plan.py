"""From points to run keys, with the configuration of the project and a small data set."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.spec.specify import specify
from rgbt.tracking.mlflow_store import NoTracking
from sweeps.points import Evaluation, Point
from sweeps.worker.found import Runs
from sweeps.worker.lists import PointList, survey
from sweeps.worker.plan import Planner
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


def test_a_run_is_planned_under_the_key_that_the_command_gives_it(
    planner: Planner, base: tuple[str, ...]
) -> None:
    plan = planner.plan(Point("p", ("seed=3",)))
    (run,) = plan.runs
    assert run.key == plan.key == specify(compose([*base, "seed=3"])).key
    assert run.overrides == (*base, "seed=3")
    assert run.steps == 6
    assert plan.point.label == "p"


def test_a_label_shows_the_value_of_pixels_at_the_scale(planner: Planner) -> None:
    point = Point("patch_size=${px:64}", ("masker.patch_size=${px:64}",))
    plan = planner.plan(point)
    assert (plan.point.label, plan.pixel_factor) == ("patch_size=32", 0.5)


def test_seeds_make_a_run_each_and_evaluations_a_point_of_its_own(planner: Planner) -> None:
    single = planner.plan(Point("p", ("seed=1",)))
    both = planner.plan(Point("p", (), seeds=(0, 1)))
    assert [run.overrides[-1] for run in both.runs] == ["seed=0", "seed=1"]
    assert both.runs[1].key == single.key
    assert len({run.key for run in both.runs}) == 2
    one = planner.plan(Point("p", (), seeds=(1,)))
    assert one.key == single.key

    ring, thermal = Evaluation(regions="ring9"), Evaluation("thermal")
    evaluated = [
        planner.plan(Point("p", ("seed=1",), evaluations=each))
        for each in ((), (ring,), (thermal,), (ring, thermal))
    ]
    assert len({plan.key for plan in (*evaluated, both)}) == 5
    assert {plan.runs[0].key for plan in evaluated} == {single.key}
    assert all(len(plan.key) == 12 for plan in (*evaluated, both))


def test_points_without_frames_keep_the_keys_of_studies_from_before_there_were_any(
    planner: Planner,
) -> None:
    plan = planner.plan(Point("p", ("seed=1",), evaluations=(Evaluation("thermal", "ring9"),)))
    parts = [[plan.runs[0].key], [{"modality": "thermal", "regions": "ring9"}]]
    assert plan.key == hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:12]
    framed = [
        planner.plan(Point("p", ("seed=1",), evaluations=(Evaluation(frames=frames),)))
        for frames in (None, "aligned", "released")
    ]
    assert len({plan.key for plan in framed}) == 3
    failing = [
        planner.plan(Point("p", ("seed=1",), evaluations=(asked,)))
        for asked in (
            Evaluation(),
            Evaluation(degradation="noise", severity=8),
            Evaluation(degradation="noise", severity=16),
        )
    ]
    assert len({plan.key for plan in failing}) == 3
    assert failing[0].key == framed[0].key


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
        ("masker", "'masker' is no override"),
        ("dataset.root=/nowhere/to/be/found", "/nowhere/to/be/found"),
    ],
)
def test_what_does_not_fit_is_told_in_one_sentence(
    planner: Planner, override: str, said: str
) -> None:
    with pytest.raises(InputError) as error:
        planner.plan(Point("p", (override,)))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_a_data_set_without_lists_is_told(planner: Planner, tmp_path: Path) -> None:
    for name in ("images", "labels"):
        (tmp_path / "empty" / name).mkdir(parents=True)
    with pytest.raises(InputError, match="holds none of the lists"):
        planner.plan(Point("p", (f"dataset.root={tmp_path / 'empty'}",)))


def test_a_survey_writes_nothing_and_knows_what_is_there(
    base: tuple[str, ...], planner: Planner, tmp_path: Path
) -> None:
    runs_dir = tmp_path / "runs"
    points = (Point("a", ("seed=1",)), Point("b", ("seed=2",)), Point("c", ("masker=grid",)))
    wanted = PointList("table/x", "x", "list", points, Runs(runs_dir, NoTracking()), base, None)
    outcomes = survey(wanted, settings())
    assert [outcome.state for outcome in outcomes] == ["waiting", "waiting", "failed"]
    assert "there is no masker 'grid'" in outcomes[2].reason
    assert outcomes[2].keys == ()
    assert not runs_dir.exists()

    run = planner.plan(points[1]).runs[0]
    finish(runs_dir / run.key, dataset=run.dataset)
    before = sorted(runs_dir.rglob("*"))
    outcomes = survey(wanted, settings())
    assert [outcome.state for outcome in outcomes] == ["waiting", "finished", "failed"]
    assert outcomes[1].keys == (run.key,)
    assert outcomes[1].seconds == 2.5
    assert sorted(runs_dir.rglob("*")) == before
