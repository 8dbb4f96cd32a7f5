"""Sizes, letters, colours and files of figures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from analysis.figures.style import (
    COLOURS,
    COLUMN,
    SMALL,
    new_figure,
    save,
    series_style,
    styled,
)
from tests.analysis.figures.drawn import letters, texts


@styled
def simple():
    figure = new_figure(COLUMN, 2.0)
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], label="a line")
    axes.set_xlabel("across")
    axes.legend()
    return figure


def test_svg_keeps_text_as_text(tmp_path: Path) -> None:
    assert {"across", "a line"} <= set(texts(simple(), tmp_path))
    assert min(letters(simple(), tmp_path)) >= SMALL


def test_pdf_embeds_letters_that_can_be_searched(tmp_path: Path) -> None:
    save(simple(), tmp_path / "f.pdf")
    content = (tmp_path / "f.pdf").read_bytes()
    assert content.startswith(b"%PDF")
    assert b"/Type0" in content or b"/TrueType" in content
    assert b"/Type3" not in content


def test_png_has_300_dots_per_inch(tmp_path: Path) -> None:
    save(simple(), tmp_path / "new folder" / "f.png")
    assert cv2.imread(str(tmp_path / "new folder" / "f.png")).shape[:2] == (600, 1020)


@pytest.mark.parametrize("suffix", ["svg", "pdf", "png"])
def test_same_figure_gives_the_same_file(tmp_path: Path, suffix: str) -> None:
    for name in ("a", "b"):
        save(simple(), tmp_path / f"{name}.{suffix}")
    files = [(tmp_path / f"{name}.{suffix}").read_bytes() for name in ("a", "b")]
    assert files[0] == files[1]
    assert len(list(tmp_path.iterdir())) == 2  # nothing temporary is left


def test_series_differ_in_colour_marker_or_line() -> None:
    styles = [tuple(series_style(index).values()) for index in range(32)]
    assert len(set(styles)) == 32


def test_series_differ_in_brightness_or_hue_for_dichromats() -> None:
    """Simulated red blindness (Viénot et al., 1999): no two of the first six coincide."""
    to_lms = np.array(
        [[17.8824, 43.5161, 4.11935], [3.45565, 27.1554, 3.86714], [0.0299566, 0.184309, 1.46709]]
    )
    blind = np.array([[0, 2.02344, -2.52581], [0, 1, 0], [0, 0, 1]])
    rgb = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in COLOURS[:6]]) / 255
    seen = (np.linalg.inv(to_lms) @ blind @ to_lms @ (rgb**2.2).T).T.clip(0) ** (1 / 2.2)
    gaps = [np.linalg.norm(seen[i] - seen[j]) for i in range(6) for j in range(i)]
    assert min(gaps) > 0.12
