"""Tables on terminals of any width, and in files."""

from __future__ import annotations

import re

import pytest
from rich.console import Console

from rgbt.tracking import terminal
from rgbt.tracking.tables import TextTable
from rgbt.tracking.terminal import fitted, path_lines, print_rich, rich_table

NUMBERS = ("48.75 ± 1.22", "-1.64", "-2.20 to -1.01", "454482993c6b")
GRID = TextTable(
    "A title that is by far longer than the table of two columns below it",
    ("", "grbm sigma_div=1 of three seeds", "difference", "95 % over images", "run"),
    tuple((f"sigma_div={n} max_steps=240 · grbm", *NUMBERS) for n in (1, 2)),
)


def lines(grid: TextTable, width: int) -> list[str]:
    console = Console(width=width)
    with console.capture() as captured:
        console.print(rich_table(grid), soft_wrap=True)
    return captured.get().splitlines()


@pytest.mark.parametrize("width", [40, 60, 80, 100, 120, 200])
def test_no_line_of_a_table_is_longer_than_the_terminal_and_no_number_is_cut(width: int) -> None:
    shown = lines(GRID, width)
    assert shown[0] == GRID.title, "not broken: what it names can be copied"
    assert max(map(len, shown[1:])) <= width
    for number in NUMBERS:
        assert "\n".join(shown).count(number) == 2
    for part in fitted(GRID, width):
        assert len({row[0] for row in part.rows}) == 2, "rows can be told apart"


def test_a_table_that_fits_is_not_changed() -> None:
    assert fitted(GRID, 130) == [GRID]


def test_labels_are_shortened_before_columns_are_folded() -> None:
    (one,) = fitted(GRID, 90)
    assert one.rows[0][1:] == NUMBERS
    assert len(one.rows[0][0]) < len(GRID.rows[0][0])
    first, *others = fitted(GRID, 50)
    assert [part.title for part in (first, *others)] == [GRID.title, *[""] * len(others)]
    cells = [cell for part in (first, *others) for cell in part.rows[0][1:]]
    assert tuple(cells) == NUMBERS


def test_headers_that_differ_still_do() -> None:
    header = ("", "grbm sigma_div=1 max_steps=240", "grbm sigma_div=4 max_steps=240")
    for width in (40, 60, 70):
        heads = [
            name
            for part in fitted(TextTable("", header, (("mIoU", "1.00", "2.00"),)), width)
            for name in part.header[1:]
        ]
        assert len(set(heads)) == 2


def test_a_table_without_rows_is_shown() -> None:
    assert lines(TextTable("t", ("point", "mIoU"), ()), 80)[0] == "t"


def test_a_file_gets_whole_lines_and_a_terminal_whole_paths(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    wide = TextTable("t", ("", *(f"column {n}" for n in range(60))), (("label", *["1.00"] * 60),))
    print_rich(rich_table(wide))
    assert "1.00 " * 2 in re.sub(" +", " ", capsys.readouterr().out)
    monkeypatch.setattr(terminal, "line_width", lambda: 40)
    place = "/a/very/long" * 20
    print_rich(path_lines([("run folder", place), ("MLflow", "x")]))
    assert place in capsys.readouterr().out
