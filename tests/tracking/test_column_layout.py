"""Labels shortened and columns folded to a width."""

from __future__ import annotations

import pytest

from rgbt.tracking.column_layout import blocks, is_text, shortened


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
def test_words_are_told_from_numbers_keys_and_paths(cell: str, expected: bool) -> None:
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
