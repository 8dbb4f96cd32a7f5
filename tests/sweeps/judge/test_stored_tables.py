"""How runs were requested for a table, as their tags tell: never by composing their words."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from analysis.results import finished_runs
from rgbt.runs.folder import RunFolder, read_description
from sweeps.judge.judged_table import JudgedTable
from sweeps.judge.stored_tables import judged_tables
from sweeps.plan.planner import Planner
from sweeps.plan.request import REQUESTED
from sweeps.plan.table import Table, load_table
from sweeps.score.reader import RunReader
from tests.sweeps.show.planted import plant

NAME, WORDS = "crm/table3a", ("optimizer.lr=-1", "masker=crm")
SHARES = {"RGB": (50.0,), "CRM": (60.0,)}


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    rows = [row.label for row in load_table(NAME).runnable_rows][:2]
    shares = dict(zip(rows, SHARES.values(), strict=True))
    plant(tmp_path / "runs", NAME, shares, scale="bench")
    plant(tmp_path / "runs", NAME, shares, *WORDS, scale="bench")
    return tmp_path / "runs"


def judge(
    runs: Path, table: Table | None = None, **others: Table
) -> tuple[list[JudgedTable], list[str]]:
    """The tables with runs, and the remarks."""
    reader, remarks = RunReader(finished_runs(runs, runs / "none")), list[str]()
    tables, planner = {NAME: table or load_table(NAME)} | others, Planner((f"runs_dir={runs}",))
    return list(judged_tables(reader, planner, tables, remarks, resamples=100)), remarks


def test_runs_are_apart_by_the_words_that_were_typed(runs: Path) -> None:
    (plain, other), remarks = judge(runs)
    assert (plain.request.extra, other.request.extra) == ((), WORDS)
    assert (plain.request.scale, other.request.scale) == ("bench", "bench")
    assert plain.runs.keys() == other.runs.keys()
    assert len(other.runs) == 2
    keys = {run.results[0].key for table in (plain, other) for run in table.runs.values()}
    assert len(keys) == 4
    assert remarks == []


def test_a_row_that_is_another_one_today_has_no_run(runs: Path) -> None:
    table = load_table(NAME)
    first = table.runnable_rows[0]
    changed = replace(first, overrides=(*first.overrides, "optimizer.lr=0.5"))
    rows = tuple(changed if row is first else row for row in table.rows)
    for judged in judge(runs, replace(table, rows=rows))[0]:
        assert {label for label, _ in judged.runs} == {table.runnable_rows[1].label}


@pytest.mark.parametrize("text", ["paper", "paper x hydra.run.dir=/a", "other x", "paper 'x"])
def test_a_tag_that_no_request_has_is_a_remark(runs: Path, text: str) -> None:
    path = next(path for path in sorted(runs.glob("*/run.json")) if REQUESTED in path.read_text())
    known = read_description(path.parent)
    assert known is not None
    tags = {**known.tags, REQUESTED + NAME: text}
    RunFolder(path.parent).describe(replace(known, tags=tags))
    tables, (remark,) = judge(runs)
    assert sorted(len(table.runs) for table in tables) == [1, 2]
    assert f"Run {path.parent.name} belongs to no table" in remark


def test_what_cannot_be_scored_is_a_remark_if_it_was_requested(runs: Path) -> None:
    wrong = replace(load_table(NAME), at={"bench": ("loss=none_such",)})
    others = [table for table in judge(runs, other=wrong)[0] if table.request.name == "other"]
    assert [table.runs for table in others] == [{}]
    assert judge(runs, other=wrong)[1] == []
    _, (wrong_word, no_key) = judge(runs, wrong)
    assert f"Table '{NAME}' cannot be scored: there is no loss 'none_such'" in wrong_word
    assert "has the key of a row today" in no_key
