"""Results of a study as data, tables and figures: values by hand."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

import optuna
import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution
from optuna.trial import TrialState, create_trial

from sweeps import attributes
from sweeps.report import study as tables
from sweeps.report.study import StudyData, importances

ALPHA = FloatDistribution(0, 1)
SIZES = CategoricalDistribution(("${px:64}", "${px:8}"))


def new_study(*directions: str, metrics: Sequence[str] = ()) -> optuna.Study:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler = optuna.samplers.RandomSampler(seed=0)
    study = optuna.create_study(study_name="s", directions=list(directions), sampler=sampler)
    study.set_user_attr(attributes.METRICS, list(metrics))
    return study


def add(
    study: optuna.Study,
    values: Sequence[float] | None = None,
    *,
    state: str = "COMPLETE",
    params: Mapping[str, Any] = {},  # noqa: B006 - nobody changes it
    reported: Mapping[int, float] = {},  # noqa: B006
    **attrs: Any,
) -> None:
    """A text among `params` is one of the choices `SIZES`, a number lies in 0..1."""
    trial = create_trial(
        state=TrialState[state],
        values=values,
        params=dict(params),
        distributions={k: SIZES if isinstance(v, str) else ALPHA for k, v in params.items()},
        intermediate_values=dict(reported),
        user_attrs={f"rgbt.{name}": value for name, value in attrs.items()},
    )
    study.add_trial(trial)


def test_trials_grid_sorts_by_objective_direction() -> None:
    study = new_study("minimize", metrics=["val/Var"])
    results = {"val/Var": 8.0, "test/Var": 9.5, "val/mIoU": 50.0, "test/mIoU": 48.25}
    first = {"masker.alpha": 0.123456, "optimizer.lr": 0.5, "head.lr": 1.0}
    add(study, [8.0], params=first, results=results, seconds=61.6, runs=["a1"])
    for value in (*range(12, 22), 4.0):
        add(study, [float(value)], params={"masker.alpha": 0.25})
    grid = tables.trials_grid(StudyData.read(study))
    assert grid.title == "Best trials: lowest val/Var"
    assert grid.header == (
        *("trial", "alpha", "optimizer.lr", "head.lr", "val/Var", "test/Var", "val/mIoU"),
        *("test/mIoU", "seconds", "runs"),
    )
    assert [row[0] for row in grid.rows] == ["11", "0", *map(str, range(1, 9))]
    scores = ("8.00", "9.50", "50.00", "48.25", "62", "a1")
    assert grid.rows[1] == ("0", "0.1235", "0.5", "1", *scores)
    assert grid.rows[0][2:] == ("-", "-", "4.00", "-", "-", "-", "-", "-")


@pytest.mark.parametrize(("notes", "shown"), [({"pixels": 0.5}, "32"), ({}, "64px")])
def test_trials_grid_shows_pixels(notes: dict[str, float], shown: str) -> None:
    study = new_study("maximize")
    add(study, [8.0], params={"masker.patch_size": "${px:64}"}, **notes)
    add(study, [math.inf], **notes)
    assert [row[:2] for row in tables.trials_grid(StudyData.read(study)).rows] == [("0", shown)]


def test_pareto_front_of_five_points() -> None:
    # mIoU up, Var down. (50, 9) is beaten by (55, 8); (54, 10) by (55, 8): three remain.
    study = new_study("maximize", "minimize", metrics=["val/mIoU", "val/Var"])
    add(study, state="FAIL")  # so that numbers are not places in a list
    for values in ((50.0, 9.0), (55.0, 8.0), (60.0, 12.0), (54.0, 10.0), (40.0, 2.0)):
        add(study, values, params={"x": 0.5})
    data = StudyData.read(study)
    assert [trial.number for trial in data.front] == [3, 2, 5]
    values = [("60.00", "12.00"), ("55.00", "8.00"), ("40.00", "2.00")]
    assert [row[2:4] for row in tables.trials_grid(data).rows] == values


def test_tables_of_list_keep_point_order_and_last_trials() -> None:
    study = new_study("maximize", metrics=["val/mIoU"])
    study.set_user_attr(attributes.KIND, "list")
    add(study, [51.0], label="Ny/4 seed=1", key="k1", runs=["k1"])
    add(study, state="FAIL", label="Ny/2 seed=1", key="k2", reason="exit code 1")
    add(study, [52.0], label="Ny/2 seed=1", key="k2", runs=["k2"])
    add(study, state="RUNNING", label="Ny seed=1", key="k3")
    add(study, state="FAIL", params={"a.x": 0.5}, reason="by\nsignal | 9", runs=["r1", "r2"])
    data = StudyData.read(study)
    grid = tables.trials_grid(data)
    assert grid.header[:4] == ("trial", "point", "state", "val/mIoU")
    assert [row[:4] for row in grid.rows[:3]] == [
        ("0", "Ny/4 seed=1", "complete", "51.00"),
        ("2", "Ny/2 seed=1", "complete", "52.00"),
        ("3", "Ny seed=1", "running", "-"),
    ]
    failed = tables.failed_grid(data)
    assert failed.title == "Failed trials (1 more were retried)"
    assert failed.rows[0] == ("by signal | 9", "4", "x=0.5", "r1 r2", "-")
    assert "by signal \\| 9 | 4" in failed.to_markdown()
    assert len(tables.tables(data, importances(data))) == 3


def test_trials_csv_has_all_trials_with_full_numbers() -> None:
    study = new_study("maximize", metrics=["val/mIoU"])
    add(study, [100 / 3], params={"a.x": 0.1}, results={"test/mIoU": 31.0}, seconds=2.5, runs=["r"])
    reported = {10: 1.0, 20: 2.0}
    add(study, state="PRUNED", params={"a.x": 0.2}, reported=reported, reason="at 20, low")
    first, second = csv.DictReader(io.StringIO(tables.trials_csv(StudyData.read(study))))
    assert float(first["val/mIoU"]) == 100 / 3
    assert list(first.values())[5:] == ["31.0", "2.5", "", "r", ""]
    assert list(second.values())[3:] == ["0.2", "", "", "", "20", "", "at 20, low"]
    assert (second["state"], second["label"]) == ("pruned", "x=0.2")


def test_importances_name_the_deciding_parameter() -> None:
    """`big` decides the first objective, `small` the second; `same` never changes."""
    study = new_study("maximize", "minimize", metrics=["up", "down"])
    for index in range(40):
        big, small = index / 40, (index * 7 % 40) / 40
        params = {"small": small, "big": big, "same": 0.5}
        add(study, [10 * big + 0.01 * small, 5 * small + 0.001 * big], params=params)
    found = importances(StudyData.read(study))
    assert list(found.shares) == ["big", "small"]
    assert found.shares["big"][0] > 0.8
    assert found.shares["small"][1] > 0.8
    for index in (0, 1):
        assert sum(shares[index] for shares in found.shares.values()) == pytest.approx(1.0)
    assert "same: one value only" in found.remark
    assert tables.tables(StudyData.read(study), found)[-1].rows[0][0] == "big"


def test_importances_missing_have_a_reason() -> None:
    few, fixed = (new_study("maximize") for _ in range(2))
    for index in range(12):
        add(fixed, [float(index)], params={"x": 0.5})
        add(few, [float(index)] if index < 9 else [math.inf], params={"x": index / 20})
    found = [importances(StudyData.read(study)) for study in (few, fixed)]
    assert [each.shares for each in found] == [{}, {}]
    assert found[0].remark == "they need 10 complete trials, and there are 9."
    assert found[1].remark.startswith("no parameter took two")


def test_odd_records_of_a_trial_are_shown() -> None:
    """What somebody wrote into the storage by hand."""
    study = new_study("maximize", metrics=["val/mIoU"])
    size = {"masker.patch_size": "${px:64}"}
    add(study, [8.0], params=size, pixels="text", seconds=2.0**63, results={"test/mIoU": None})
    assert tables.trials_grid(StudyData.read(study)).rows[0][1] == "64px"
