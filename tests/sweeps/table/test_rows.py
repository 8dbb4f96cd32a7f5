"""Rows of a request: which are run, and what must not be mixed up."""

from __future__ import annotations

import pytest

from rgbt.checks import InputError
from sweeps.table.claim import Claim
from sweeps.table.load_table import load_table
from sweeps.table.request import TableRequest
from sweeps.table.row_names import find_label
from sweeps.table.rows import check_rows, select_rows
from sweeps.table.table import Row, Table
from sweeps.worker.planner import Planner
from tests.sweeps.tabled import table

LABELS = ("(A)", "(B)", "CMX (MiT-B2)", "CMX (MiT-B4)", "Multi-head", "Multi-head*")


@pytest.mark.parametrize(
    ("word", "label"),
    [
        *(("(A)", "(A)"), ("A", "(A)"), ("b", "(B)"), ("CMX-MiT-B2", "CMX (MiT-B2)")),
        *(("multi-head", "Multi-head"), ("Multi-head*", "Multi-head*")),
    ],
)
def test_label_as_a_user_writes_it(word: str, label: str) -> None:
    assert find_label(word, LABELS, "rows=") == label


def test_labels_that_are_not_clear_are_refused() -> None:
    with pytest.raises(InputError, match="'CMX \\(MiT-B2\\)', 'CMX \\(MiT-B4\\)'"):
        find_label("CMX", LABELS, "rows=")
    with pytest.raises(InputError, match=r"^rows=Multihed: .* did you mean 'Multi-head'\?"):
        find_label("Multihed", LABELS, "rows=")


def of(*rows: Row, claims: tuple[Claim, ...] = ()) -> Table:
    return table(rows, claims=claims)


def claim(name: str, rows: tuple[str, ...], against: tuple[str, ...]) -> Claim:
    about = {"says": "", "source": "", "columns": ("acc",), "expected": "higher"}
    return Claim(name=name, rows=rows, against=against, **about)  # type: ignore[arg-type]


def test_selected_rows_keep_their_claims() -> None:
    made = of(
        Row(label="a", experiment="crm"),
        Row(label="b", experiment="crm", same_as="a"),
        Row(label="c", experiment="grbm"),
        claims=(
            claim("b_a", ("b",), ("a",)),
            claim("c_a", ("c",), ("a",)),
            claim("best", ("c",), ("others",)),
        ),
    )
    chosen = select_rows(made, "c,A")
    assert [row.label for row in chosen.rows] == ["a", "c"]
    assert [each.name for each in chosen.claims] == ["c_a"]
    alone = select_rows(made, "b")
    assert alone.rows[0].same_as is None
    assert select_rows(made, "a,b,c").claims == made.claims


def test_twins_of_a_row_that_is_left_out_stay_declared() -> None:
    rows = (
        Row(label="a", experiment="crm"),
        Row(label="b", experiment="crm", same_as="a"),
        Row(label="c", experiment="crm", same_as="a"),
        Row(label="d, with comma", experiment="grbm"),
    )
    chosen = select_rows(of(*rows), "b,c,d, with comma")
    assert [(row.label, row.same_as) for row in chosen.rows] == [
        *(("b", None), ("c", "b"), ("d, with comma", None)),
    ]


def request_for(name: str, *extra: str, rows: str = "", scale: str = "demo") -> TableRequest:
    made = load_table(name)
    chosen = select_rows(made, rows) if rows else made
    return TableRequest(name, chosen, scale, (0,), extra)


@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("spatialseg/table3", "masker=grbm_released"),
        ("spatialseg/table3", "masker.sigma_div=4"),
        ("temporal/table1", "loss.alpha=1"),
        ("temporal/table1", "scheme=temporal_released"),
    ],
)
def test_override_of_what_rows_are_about_is_refused(name: str, word: str) -> None:
    with pytest.raises(
        InputError, match=f"^'{word}' would replace what the rows .* rows="
    ) as error:
        check_rows(request_for(name, word), Planner())
    assert name in str(error.value)


def test_overrides_of_how_long_and_on_what_are_allowed() -> None:
    words = ("recipe.batch_size=1", "dataset.root=/data", "optimizer.weight_decay=0.1")
    check_rows(
        request_for("spatialseg/table3", *words, "model.queries=8", rows="Ny,Ny/2"), Planner()
    )


def test_override_of_chosen_rows_is_allowed() -> None:
    check_rows(request_for("spatialseg/table3", "masker=grbm_released", rows="Ny/4"), Planner())
    with pytest.raises(InputError, match="'Ny' and 'Ny/4'"):
        check_rows(
            request_for("spatialseg/table3", "masker.sigma_div=4", rows="Ny,Ny/4"), Planner()
        )


def test_rows_that_are_one_run_are_refused_unless_the_table_says_so() -> None:
    first = Row(label="a", experiment="baseline")
    same = Row(label="b", experiment="baseline", same_as="a")
    third = Row(label="c", experiment="baseline", same_as="a")
    equal = of(first, Row(label="b", experiment="baseline"))
    with pytest.raises(InputError, match=r"'a' and 'b' of own/t would be the same run .* same_as"):
        check_rows(TableRequest("own/t", equal, "demo", (0,)), Planner())
    check_rows(TableRequest("own/t", of(first, same, third), "demo", (0,)), Planner())
