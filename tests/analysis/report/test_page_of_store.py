"""The page of a store that was collected, drawn by a real browser: both use the same words."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from analysis.report import page, tables
from analysis.report.collect import ReportRequest, collect
from analysis.report.data import ReportData
from analysis.report.store import MlflowRun
from analysis.report.tables_files import CSV_FILE, HEADER
from rgbt.tracking.mlflow_store import MlflowTracking
from tests.analysis.report.stores import files_of, record_search, write_run
from tests.analysis.report.test_page import browser, dump, visible


def quiet(items: Sequence[Any], what: str) -> Iterator[Any]:
    yield from items


@pytest.fixture
def collected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ReportData:
    """A search of four trials, of which one failed, and the run of its first trial."""
    tracking = MlflowTracking(
        None, artifact_uri=None, experiment="rgbt", runs_dir=str(tmp_path / "runs")
    )
    (tmp_path / "runs").mkdir()
    tracking.sync(write_run(tmp_path / "runs", "aa0", "grbm scale=paper", 0), "FINISHED")
    record_search(tmp_path / "runs", tracking)
    # Reading all published tables takes a second.
    monkeypatch.setattr(tables, "table_names", list)
    asked = ReportRequest(tracking, tmp_path / "runs", 100, "rgbt report")
    return collect(asked, quiet)


def rows_of(dom: str, label: str) -> list[list[str]]:
    """Texts of the cells of the table with this caption, by row."""
    (table,) = (each for each in re.findall("<table.*?</table>", dom, re.S) if f">{label}<" in each)
    (body,) = re.findall("<tbody>(.*?)</tbody>", table, re.S)
    rows = re.findall("<tr.*?</tr>", body, re.S)
    return [[visible(cell) for cell in re.findall("<t[hd].*?</t[hd]>", row, re.S)] for row in rows]


@browser
def test_search_of_a_store_is_drawn(collected: ReportData, tmp_path: Path) -> None:
    dom, console = dump(tmp_path, page.page_text(collected))
    assert console == []
    assert "No trial is complete yet." not in visible(dom)
    assert "4 trials: 3 complete, 1 failed." in visible(dom)
    labels = re.findall(r'class="(trial|trial front)"[^>]*aria-label="([^"]*)"', dom)
    assert sorted(labels) == [
        ("trial", "Trial 1: val/mIoU 49.00, val/Var 10.00"),
        ("trial front", "Trial 0: val/mIoU 50.00, val/Var 9.00"),
        ("trial front", "Trial 2: val/mIoU 52.00, val/Var 12.00"),
    ]
    assert len(re.findall(r'<path class="front-line" d="M[\d.]+ [\d.]+V[\d.]+H[\d.]+"', dom)) == 1
    assert sorted(rows_of(dom, "trials of search/two")) == [
        ["0", "complete", "50.00", "9.00", "★", "0.0"],
        ["1", "complete", "49.00", "10.00", "", "0.25"],
        ["2", "complete", "52.00", "12.00", "★", "0.5"],
        ["3", "failed", "–", "–", "", "0.75"],
    ]


@pytest.mark.parametrize("name", ["spatialseg/table3", "gone/t"])
def test_overrides_of_a_table_stand_beside_its_name(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "table_names", lambda: ["spatialseg/table3"])
    said = {
        "plain": "- A remark.\n",
        "short": "- Every row of ours was run with trainer.max_steps=9 loss.spatial.alpha=1.\n",
    }
    records = [
        MlflowRun(
            run_id=variant,
            name=f"{name} demo",
            status="FINISHED",
            started="",
            seconds=None,
            tags={"rgbt.table": name, "rgbt.scale": "demo", "rgbt.seeds": "0"},
            params={},
            metrics={},
            files=files_of(tmp_path / variant, **{CSV_FILE: csv, "table.md": text}),
        )
        for variant, text in said.items()
        for csv in [",".join(HEADER) + f"\n{name},Ny/4,mIoU,50.0,,1,61.5,,,aa0\n"]
    ]
    remarks: list[str] = []
    made = tables.table_entries(records, {}, 100, quiet, remarks)
    extras = [each.extra for each in made if each.name == name]
    assert extras == ["", "trainer.max_steps=9 loss.spatial.alpha=1"]
