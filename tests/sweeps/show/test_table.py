"""Tables as text: values, footnotes, marks and remarks by hand."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import replace
from typing import Any

import pytest

from rgbt.tables import TextTable
from sweeps.plan.table import Column, Row
from sweeps.score.cells import ScoredTable, TableCell, score, size_marks
from sweeps.show.table import (
    COUNTED,
    NOT_PRINTED,
    SMALL,
    latex,
    render_table,
    tidy_csv,
)
from tests.sweeps.tabled import Made, failed, outcome, right, table

MARKS = {("b", "acc"): 1, ("a_1", "acc"): 2}
ROWS = {"a_1": ((40, 50, 60), 48.0), "b": ((60, 70, 80), 47.5), "theirs": ((), 50.0)}
COLUMNS = tuple(Column(name=f"name_{n}", metric="pixel_accuracy") for n in range(4))


def wide(**others: Any) -> ScoredTable:
    rows = (Row(label="a", experiment="crm", values={"name_0": 48.0, "name_1": 49.25}),)
    runs = {("a", seed): outcome(str(seed), right(share)) for seed, share in enumerate((40, 60))}
    return score("own/wide", table(rows, COLUMNS, **others), runs, scale="paper")


def grid(scored: ScoredTable, **others: Any) -> TextTable:
    return render_table(scored, "terminal", **others)


def test_lines_are_ours_published_and_difference() -> None:
    shown = grid(Made(ROWS).scored(MARKS))
    assert shown.title == "own, TABLE I: Rows"
    assert shown.header == ("", "", "seeds", "acc")
    assert shown.rows == (
        ("a_1", "ours", "3", "_50.00 ± 10.00"),
        *(("", "published", "", "48.0"), ("", "difference", "", "+2.00")),
        ("b", "ours", "3", "*70.00 ± 10.00"),
        *(("", "published", "", "47.5"), ("", "difference", "", "+22.50")),
        ("theirs", "published", "", "50.0"),
    )
    assert "**70.00 ± 10.00**" in render_table(Made(ROWS).scored(MARKS), "markdown").to_markdown()


def test_paper_scale_is_not_called_small() -> None:
    shown = grid(wide())
    assert shown.rows[1] == ("", "published", "", "48.00", "49.25", "-", "-")
    assert SMALL.format(scale="paper") not in shown.notes


@pytest.mark.parametrize(("scale", "is_small"), [("demo", True), ("bench", True), ("paper", False)])
def test_a_footnote_of_demo_scale_is_shown_where_its_networks_are(
    scale: str, is_small: bool
) -> None:
    rows = (Row(label="a", experiment="crm"),)
    made = table(rows, COLUMNS[:1], remarks=("all", {"demo": "small"}))
    notes = grid(score("t", made, {("a", 0): failed("broke.")}, scale=scale)).notes
    assert "[1] all" in notes
    assert ("[2] small" in notes) == is_small


def test_footnotes_are_numbered_and_shared() -> None:
    columns = (*COLUMNS[:3], Column(name="TC", metric="TC", frames="aligned", printed=False))
    rows = (
        Row(label="a", experiment="crm", remarks=("of a",)),
        Row(label="b", experiment="crm"),
        Row(label="c", values={"name_0": 3.0}, doubtful=("name_0",), remarks=("doubtful",)),
        Row(label="d", values={"name_1": 3.0}, doubtful=("name_1",)),
    )
    made = table(rows, columns, remarks=("of the table",))
    shown = grid(score("t", made, {("a", 0): failed("broke.")}, scale="demo"))
    doubt = "The printed value does not agree with the others of its row."
    notes = ("of the table", NOT_PRINTED, "of a", "seed 0: broke.", "doubtful", doubt)
    assert shown.notes[:6] == tuple(f"[{n}] {note}" for n, note in enumerate(notes, start=1))
    assert shown.title.endswith("[1]")
    assert shown.rows[0] == ("a[3]", "ours", "0", *["failed[4]"] * 4)
    assert shown.rows[2] == ("c", "published", "", "3[5]", "-", "-", "-")


def test_rows_of_the_same_runs_and_commits_are_noted() -> None:
    rows = (Row(label="a", experiment="crm"), Row(label="b", experiment="crm"))
    made = outcome("k0", right(4), "aaa"), outcome("k1", right(4), "bbb")
    runs = {(label, seed): run for label in "ab" for seed, run in enumerate(made)}
    shown = grid(score("t", table(rows), runs, scale="demo"), extra=["x=1"], remarks=["more"])
    assert shown.notes[0] == "[1] At scale=demo the same runs as row 'a'."
    assert shown.rows[1][:2] == ("b[1]", "ours")
    for remark in (
        "Our runs come from several git commits: aaa (1), bbb (1).",
        *("Every row of ours was run with x=1.", "more"),
    ):
        assert remark in shown.notes


def test_sizes_have_no_seeds() -> None:
    size = Column(name="size", efficiency="parameters", best="lowest")
    rows = tuple(
        Row(label=label, experiment="crm", values={"size": printed})
        for label, printed in (("a", 54.4), ("b", 44.6))
    )
    counted = {(r.label, "size"): TableCell(m, math.nan, 0) for r, m in zip(rows, (54.361, 44.56))}
    made = table(rows, (size,))
    scored = score("own/t", made, {}, scale="demo", sizes=counted)
    shown = grid(replace(scored, marks=size_marks(made, counted)))
    assert shown.rows == (
        *(
            ("a", "ours", "", "_54.36"),
            ("", "published", "", "54.4"),
            ("", "difference", "", "-0.04"),
        ),
        *(
            ("b", "ours", "", "*44.56"),
            ("", "published", "", "44.6"),
            ("", "difference", "", "-0.04"),
        ),
    )
    assert COUNTED in shown.notes
    assert not any("scale=demo" in note for note in shown.notes)
    first, _ = csv.DictReader(io.StringIO(tidy_csv(scored)))
    assert (first["mean"], first["sd"], first["n"], first["runs"]) == ("54.361", "", "0", "")


def test_latex_escapes_and_omits_differences() -> None:
    text = latex(grid(Made(ROWS).scored(MARKS)))
    assert r"\begin{tabular}{lrrr}" in text
    assert r"a\_1 & ours & 3 & \_50.00 ± 10.00 \\" in text
    assert "difference" not in text
    assert r"50\% of A\_b \{c\}" in latex(grid(wide(caption=r"50% of A_b {c}")))


def test_different_lists_of_rows_are_said() -> None:
    scored = Made(ROWS).scored()
    same = grid(replace(scored, lists={"a_1": "trained on train", "b": "trained on train"}))
    assert "Lists of our rows: trained on train." in same.notes
    notes = grid(replace(scored, lists={"a_1": "trained on train", "b": "trained on all"})).notes
    said = "Our rows have different lists: trained on train (a_1); trained on all (b)."
    assert said in notes
