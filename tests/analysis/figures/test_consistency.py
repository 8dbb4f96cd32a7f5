"""Temporal, Fig. 5."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from analysis.figures.consistency import class_consistency, draw, read_scores
from rgbt.checks import InputError
from tests.analysis.figures.drawn import texts

LINES = (
    "class,variant,tc,ca",
    "car,(G),60,50",
    "car,(H),70,55",
    "car_stop,(G),20,10",
    "car_stop,(H),40,12",
)


def written(folder: Path, *lines: str) -> Path:
    path = folder / "scores.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_series_and_their_means(tmp_path: Path) -> None:
    data = class_consistency(read_scores(written(tmp_path, *LINES)))
    assert data.classes == ("car", "car_stop")
    assert data.variants == ("(G)", "(H)")
    np.testing.assert_array_equal(data.tc, [[60, 20], [70, 40]])
    np.testing.assert_array_equal(data.ca, [[50, 10], [55, 12]])
    assert data.means() == {"(G)": (40, 30), "(H)": (55, 33.5)}


def test_draws_every_series_and_class(tmp_path: Path) -> None:
    found = texts(draw(class_consistency(read_scores(written(tmp_path, *LINES)))), tmp_path)
    assert {"(G), TC", "(G), CA", "(H), TC", "(H), CA", "car", "car stop"} <= set(found)


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        (("class,variant,tc", "car,(G),1"), "expected the columns class,variant,tc,ca"),
        ((), "expected the columns"),
        (LINES[:1], "no line below"),
        ((*LINES, "car,(G),1,1"), "stands there twice"),
        (
            (*LINES[:2], "bike,(G),much,1"),
            "tc of 'bike' for '\\(G\\)' must be a number, got 'much'",
        ),
        ((*LINES[:2], "bike,(G),120,1"), r"must lie in \[0, 100\], got 120"),
        ((*LINES[:2], "bike,(G),nan,1"), r"must lie in \[0, 100\], got nan"),
        (LINES[:4], "no TC and CA of class 'car_stop' for '\\(H\\)'"),
        ((LINES[0], "car,(G),50,60"), "above its TC 50"),
        ((LINES[0], "car,(G),60,50,40"), r"'car,\(G\),60,50,40' has 5 values for the 4 columns"),
        ((LINES[0], "car,(G),60"), r"has 3 values for the 4 columns"),
        ((LINES[0], 'car,"(G),60,50'), r"is no CSV file in UTF-8"),
    ],
)
def test_bad_files_are_told_in_one_sentence(
    tmp_path: Path, lines: tuple[str, ...], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        class_consistency(read_scores(written(tmp_path, *lines)))


def test_files_that_are_not_text_in_utf_8(tmp_path: Path) -> None:
    path = tmp_path / "scores.csv"
    path.write_bytes("class,variant,tc,ca\nFahrrad,größer,60,50\n".encode("latin-1"))
    with pytest.raises(InputError, match=r"scores\.csv is no CSV file in UTF-8"):
        read_scores(path)


def test_names_with_commas_stand_in_quotes(tmp_path: Path) -> None:
    path = written(tmp_path, LINES[0], 'car,"ours, dice",60,50', "", 'bike,"ours, dice",30,20')
    assert class_consistency(read_scores(path)).variants == ("ours, dice",)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no such file"):
        read_scores(tmp_path / "none.csv")
