"""Specifications of the charts: their data by hand, and that Vega-Lite takes them."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest
import vl_convert

from analysis.report import charts, views
from analysis.report.data import ReportData, StudyEntry, TrialEntry
from tests.analysis.report import pages


@pytest.fixture(scope="module")
def data() -> ReportData:
    return pages.report()


def rows_in(spec: Any) -> list[dict[str, Any]]:
    """All rows of a specification, in order."""
    if isinstance(spec, list):
        return [row for each in spec for row in rows_in(each)]
    if not isinstance(spec, dict):
        return []
    own = spec.get("values", []) if isinstance(spec.get("values"), list) else []
    return own + [row for key, child in spec.items() if key != "values" for row in rows_in(child)]


def accepted(spec: Any) -> dict[str, Any]:
    """The specification as Vega, which refuses what is no Vega-Lite."""
    compiled: dict[str, Any] = vl_convert.vegalite_to_vega(
        json.dumps({**spec, "config": charts.specification("config")})
    )
    return compiled


def test_table_chart_has_ours_runs_and_published(data: ReportData) -> None:
    entry = replace(data.tables[0], scale="paper", extra="")
    (view,) = views.table_views(replace(data, tables=(entry,)))
    (spec,) = charts.table_charts(view)
    assert accepted(spec)
    assert spec["params"] == [{"name": "column", "value": "mIoU"}]
    column = entry.columns.index("mIoU")
    for index, label in enumerate(entry.rows):
        cell = entry.cells[index][column]
        found = [r for r in rows_in(spec) if (r["row"], r["column"]) == (label, "mIoU")]
        ours = next(row for row in found if row["kind"] == "ours")
        assert (ours["x"], ours["low"], ours["high"]) == (cell.mean, cell.low, cell.high)
        assert ours["panel"] == f"cell={view.id}/{index}/{column}"
        assert [r["x"] for r in found if r["kind"] == "run"] == list(cell.values)
        assert [r["x"] for r in found if r["kind"] == "published"] == [cell.published]


def test_published_values_have_their_own_axis_at_demo_scale(data: ReportData) -> None:
    view = views.table_views(data)[0]
    specs = charts.table_charts(view)
    kinds = [{row["kind"] for row in rows_in(spec)} for spec in specs]
    assert kinds == [{"ours", "run"}, {"published"}]
    assert [spec["title"] for spec in specs] == ["ours (demo scale)", "published, own axis"]
    assert all(map(accepted, specs))


def test_profile_has_mean_and_ends_of_each_region(data: ReportData) -> None:
    runs = [run for run in data.runs if run.group == data.runs[3].group]
    (group,) = views.groups_of(runs)
    rows = charts.profile_rows(group)
    assert [row["region"] for row in rows] == ["1 centre", "2", "3", "4", "5 edge"]
    third = [run.region_ious[2] for run in runs]
    assert rows[2]["y"] == pytest.approx(sum(third) / 3)
    assert (rows[2]["low"], rows[2]["high"]) == (min(third), max(third))
    spec = charts.specification("profile")
    assert accepted({**spec, "data": {"values": rows}})
    (single,) = views.groups_of(runs[:1])
    assert "low" not in charts.profile_rows(single)[0]


def study(
    values: list[tuple[float, ...]], maximize: tuple[bool, ...], front: set[int]
) -> StudyEntry:
    trials = [
        TrialEntry(
            number=number,
            state="complete" if each else "failed",
            params={},
            values=each,
            on_front=number in front,
            runs=(),
        )
        for number, each in enumerate(values)
    ]
    names = ("mIoU", "Var", "TC")[: len(maximize)]
    return StudyEntry(
        name="s",
        kind="search",
        objectives=names,
        maximize=maximize,
        trials=tuple(trials),
        note="",
        command="",
    )


def test_front_is_a_staircase_over_its_points() -> None:
    spec = charts.study_chart(study([(50, 9), (49, 10), (52, 12), ()], (True, False), {0, 2}), "p")
    assert spec is not None
    assert accepted(spec)
    line = spec["layer"][0]
    assert [row["x"] for row in line["data"]["values"]] == [50, 52]
    # From (50, 9) up to the worse variance first, as nothing attains more than 50 with 9.
    assert line["mark"]["interpolate"] == "step-before"
    rows = spec["data"]["values"]
    assert [(row["text"], row["best"], row["panel"]) for row in rows] == [
        ("Trial 0: mIoU 50.00, Var 9.00", True, "trial=p/0"),
        ("Trial 1: mIoU 49.00, Var 10.00", False, "trial=p/1"),
        ("Trial 2: mIoU 52.00, Var 12.00", True, "trial=p/2"),
    ]


def test_three_objectives_have_no_staircase() -> None:
    spec = charts.study_chart(study([(50, 9, 1), (49, 10, 2)], (True, False, True), {0, 1}), "p")
    assert spec is not None
    assert spec["layer"][0]["data"]["values"] == []
    assert spec["encoding"]["x"]["title"] == "mIoU (higher is better); 1 more in the table"


@pytest.mark.parametrize(("maximize", "best"), [(True, [5, 7, 7]), (False, [5, 5, 4])])
def test_history_has_the_best_so_far(maximize: bool, best: list[float]) -> None:
    spec = charts.study_chart(study([(5,), (7,), (), (4,)], (maximize,), {1}), "p")
    assert spec is not None
    assert accepted(spec)
    line = spec["layer"][0]
    assert [(row["x"], row["y"]) for row in line["data"]["values"]] == list(zip([0, 1, 3], best))
    assert [row["y"] for row in spec["data"]["values"]] == [5, 7, 4]


def test_study_without_complete_trials_has_no_chart() -> None:
    assert charts.study_chart(study([(), ()], (True,), set()), "p") is None
