"""Cells of CSV files: no formula from a label, and back as they were."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

import pytest

from rgbt.checks import InputError
from rgbt.tracking.csv_files import csv_text, read_csv

FORMULAS = ["=1+1", "+cmd|' /C calc'!A0", "-2+3", "@SUM(A1)", "\t=1", "\r=1", "'=1", "''-a", "-"]
TEXTS = ["", "plain", "'quoted'", "a=b", "grbm, seed=1", "-1.25", "+3e5", "-inf", "1", 'say "x"']


def test_formulas_become_text_and_numbers_stay() -> None:
    text = csv_text([["=head", "n"], *([each, -1.25] for each in FORMULAS + TEXTS)])
    _, *rows = csv.reader(io.StringIO(text, newline=""))
    assert text.startswith("'=head,n\n")
    for (cell, number), given in zip(rows, FORMULAS + TEXTS, strict=True):
        shown = given.replace("\r", "\n")
        assert cell == (f"'{shown}" if given in FORMULAS else shown)
        assert number == "-1.25"


def test_what_was_written_is_read_back() -> None:
    header, lines = read_csv(csv_text([["=head", "n"], *([each, 1] for each in FORMULAS + TEXTS)]))
    assert header == ["=head", "n"]
    given = [each.replace("\r", "\n") for each in FORMULAS + TEXTS]
    assert [line["=head"] for line in lines] == given


def test_what_is_no_csv_is_refused() -> None:
    with pytest.raises(InputError, match="CSV file of the store is damaged"):
        read_csv('a\n"' + "x" * 200_000 + '"\n')


def test_every_csv_of_this_project_is_written_here() -> None:
    root = Path(__file__).resolve().parents[2]
    for package in ("rgbt", "sweeps", "analysis"):
        for path in (root / package).rglob("*.py"):
            if path.name != "csv_files.py":
                found = re.findall(r"csv\.(?:w|DictW)riter", path.read_text())
                assert not found, path
