from __future__ import annotations

import csv
import io
import math
from dataclasses import replace
from typing import Any

from rich.console import Console

from rgbt.terminal import WIDTH
from sweeps.rendering.file_formats import latex, markdown, tidy_csv
from sweeps.rendering.rendered_table import COUNTED, NOT_PRINTED, SMALL, render_table
from sweeps.rendering.terminal import terminal
from sweeps.table.cells import ScoredTable, TableCell, score, size_marks
from sweeps.table.table import Column, Row
from tests.sweeps.tabled import Made, failed, outcome, right, table

MARKS = {("b", "acc"): 1, ("a_1", "acc"): 2}
ROWS = {"a_1": ((40, 50, 60), 48.0), "b": ((60, 70, 80), 47.5), "theirs": ((), 50.0)}
WIDE = tuple(Column(name=f"name_{n}", metric="pixel_accuracy") for n in range(13))
STACKED = WIDE[:4]


def wide(columns: tuple[Column, ...], **others: Any) -> ScoredTable:
    rows = (Row(label="a", experiment="crm", values={"name_0": 48.0, "name_1": 49.25}),)
    runs = {("a", seed): outcome(str(seed), right(share)) for seed, share in enumerate((40, 60))}
    return score("own/wide", table(rows, columns, **others), runs, scale="paper")


def lines(scored: ScoredTable, width: int = WIDTH, *, plain: bool = True) -> list[str]:
    console = Console(width=width)
    with console.capture() as captured:
        console.print(terminal(render_table(scored), plain=plain), soft_wrap=True)
    return [line.rstrip() for line in captured.get().splitlines()]


def words(scored: ScoredTable) -> list[list[str]]:
    return [line.split() for line in lines(scored)]


def test_terminal_few_columns_are_on_one_line() -> None:
    shown = words(Made(ROWS).scored(MARKS))
    assert shown[0] == ["own,", "TABLE", "I:", "Rows"]
    assert shown[1] == ["seeds", "acc", "published", "difference"]
    assert shown[3] == ["a_1", "3", "_50.00", "±", "10.00", "48.0", "+2.00"]
    assert shown[4] == ["b", "3", "*70.00", "±", "10.00", "47.5", "+22.50"]
    assert shown[5] == ["theirs", "-", "50.0", "-"]


def test_terminal_many_columns_use_separate_lines() -> None:
    shown = words(wide(STACKED))
    assert shown[3] == ["a", "ours", "2", *["50.00", "±", "14.14"] * 4]
    assert shown[4] == ["published", "48.00", "49.25", "-", "-"]
    assert shown[5] == ["difference", "+2.00", "+0.75", "-", "-"]
    assert SMALL.format(scale="paper") not in lines(wide(STACKED))  # scale=paper


def test_render_table_numbers_and_shares_footnotes() -> None:
    columns = (*STACKED[:3], Column(name="TC", metric="TC", frames="aligned", printed=False))
    rows = (
        Row(label="a", experiment="crm", remarks=("of a",)),
        Row(label="b", experiment="crm"),
        Row(label="c", values={"name_0": 3.0}, doubtful=("name_0",), remarks=("doubtful",)),
        Row(label="d", values={"name_1": 3.0}, doubtful=("name_1",)),
    )
    made = table(rows, columns, remarks=("of the table",))
    sheet = render_table(score("t", made, {("a", 0): failed("broke.")}, scale="demo"))
    assert sheet.notes == (
        *("of the table", NOT_PRINTED, "of a", "seed 0: broke.", "doubtful"),
        "The printed value does not agree with the others of its row.",
    )
    console = Console(width=WIDTH)
    with console.capture() as captured:
        console.print(terminal(sheet, plain=True))
    shown = [line.split() for line in captured.get().splitlines()]
    assert shown[0][-1].endswith("[1]")
    assert shown[3] == ["a[3]", "ours", "0", *["failed[4]"] * 4]
    assert shown[4][0] == "b"
    assert shown[5] == ["c", "published", "3[5]", "-", "-", "-"]


def test_render_table_notes_shared_runs_and_commits() -> None:
    rows = (Row(label="a", experiment="crm"), Row(label="b", experiment="crm"))
    made = outcome("k0", right(4), "aaa"), outcome("k1", right(4), "bbb")
    runs = {(label, seed): run for label in "ab" for seed, run in enumerate(made)}
    sheet = render_table(score("t", table(rows), runs, scale="demo"), ["x=1"])
    assert sheet.notes == ("At scale=demo the same runs as row 'a'.",)
    assert sheet.lines[1].label.notes == (1,)
    assert "Our runs come from several git commits: aaa (1), bbb (1)." in sheet.remarks
    assert "Every row of ours was run with x=1." in sheet.remarks


def test_render_table_of_sizes_has_no_seeds() -> None:
    size = Column(name="size", efficiency="parameters", best="lowest")
    rows = tuple(
        Row(label=label, experiment="crm", values={"size": printed})
        for label, printed in (("a", 54.4), ("b", 44.6))
    )
    counted = {(r.label, "size"): TableCell(m, math.nan, 0) for r, m in zip(rows, (54.361, 44.56))}
    made = table(rows, (size,))
    scored = score("own/t", made, {}, scale="demo", sizes=counted)
    scored = replace(scored, marks=size_marks(made, counted))
    shown = words(scored)
    assert shown[3] == ["a", "_54.36", "54.4", "-0.04"]
    assert shown[4] == ["b", "*44.56", "44.6", "-0.04"]
    assert COUNTED.format(scale="paper") in lines(scored)
    assert not any("scale=demo" in line for line in lines(scored))
    assert r"a &  & \underline{54.36} & 54.4 & -0.04 \\" in latex(render_table(scored))
    assert "| b |  | **44.56** | 44.6 | -0.04 |" in markdown(render_table(scored))
    first, _ = csv.DictReader(io.StringIO(tidy_csv(scored)))
    assert (first["mean"], first["sd"], first["n"], first["runs"]) == ("54.361", "", "0", "")


def test_latex_escapes_and_omits_differences() -> None:
    text = latex(render_table(Made(ROWS).scored(MARKS)))
    assert r"\begin{tabular}{lrrrr}" in text
    assert r"a\_1 & 3 & \underline{50.00 $\pm$ 10.00} & 48.0 & +2.00 \\" in text
    assert r"\textbf{70.00 $\pm$ 10.00}" in text
    stacked = latex(render_table(wide(STACKED, caption=r"50% of A_b \ {c}")))
    assert r"50\% of A\_b \textbackslash{} \{c\}" in stacked
    assert "difference" not in stacked
    for each in (text, stacked):
        body = [line for line in each.splitlines() if line.endswith(r"\\")]
        assert len({line.count(" & ") for line in body}) == 1
