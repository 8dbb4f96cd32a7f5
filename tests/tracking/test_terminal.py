"""Tables on terminals of any width, and in files."""

from __future__ import annotations

import re

import pytest
from rich.console import Console

from rgbt.tracking import terminal
from rgbt.tracking.tables import TextTable
from rgbt.tracking.terminal import (
    blocks,
    fitted,
    is_text,
    path_lines,
    print_rich,
    rich_table,
    shortened,
)

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
        assert len({row[0] for row in part.rows}) == 2, "the labels of rows differ"


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


def test_labels_are_cut_in_the_middle_and_short_ones_left() -> None:
    assert shortened(["sigma_div=1 seed=0 · grbm", "grbm"], [13, 13]) == ("sigma_…· grbm", "grbm")


def test_labels_that_differ_still_do() -> None:
    early = shortened(["abcdefgh1jklmnopqrst", "abcdefgh2jklmnopqrst"], [13, 13])
    assert early == ("abcdefgh1…rst", "abcdefgh2…rst")
    both = [f"{end}bcdefghi{n}jklmnopqr{end}" for n in "12" for end in "xy"]
    found = shortened(both, [10] * 4)
    assert len(set(found)) == 4
    assert max(map(len, found)) == 10
    assert shortened(["the same long label"] * 2, [10, 10]) == ("the …label",) * 2


@pytest.mark.parametrize(
    ("cell", "expected"),
    [
        ("masker.sigma_div must be positive", True),
        ("grbm sigma_div=1", True),
        ("48.75 ± 1.22", False),
        ("-3.30 to +0.11", False),
        ("454482993c6b", False),
        ("fade02993c6b abcde2993c6b", False),
        ("see runs/.logs/abc.log for the rest", False),
        ("finished", False),
        ("8, 16, 32 gray values (standard deviation)", False),
        ("95 % over images", False),
    ],
)
def test_words_are_distinguished_from_numbers_keys_and_paths(cell: str, expected: bool) -> None:
    assert is_text(cell) is expected


def test_columns_are_folded_with_their_labels() -> None:
    widths = [10, 5, 5, 5, 5]
    assert blocks(widths, 100, gap=2, first=1) == [[0, 1, 2, 3, 4]]
    assert blocks(widths, 24, gap=2, first=1) == [[0, 1, 2], [0, 3, 4]]
    assert blocks(widths, 23, gap=2, first=1) == [[0, 1], [0, 2], [0, 3], [0, 4]]
    assert blocks(widths, 1, gap=2, first=1) == [[0, 1], [0, 2], [0, 3], [0, 4]]
    assert blocks([10], 3, gap=2, first=1) == [[0]]


def test_groups_of_columns_stay_together_where_they_fit() -> None:
    widths = [10, 5, 5, 5, 5]
    assert blocks(widths, 31, gap=2, first=1, starts=[1, 3]) == [[0, 1, 2], [0, 3, 4]]
    assert blocks(widths, 20, gap=2, first=1, starts=[1, 3]) == [[0, 1], [0, 2], [0, 3], [0, 4]]
