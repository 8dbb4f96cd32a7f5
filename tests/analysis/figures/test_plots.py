"""Sizes, letters, colours and files of figures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from analysis.figures import plots
from tests.analysis.figures.drawn import letters, strips, texts


@plots.styled
def simple():
    figure = plots.new_figure(plots.COLUMN, 2.0)
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], label="a line")
    axes.set_xlabel("across")
    axes.legend()
    return figure


def test_svg_keeps_text_as_text(tmp_path: Path) -> None:
    assert {"across", "a line"} <= set(texts(simple(), tmp_path))
    assert min(letters(simple(), tmp_path)) >= plots.SMALL


def test_png_has_300_dots_per_inch(tmp_path: Path) -> None:
    plots.save(simple(), tmp_path / "new folder" / "f.png")
    assert cv2.imread(str(tmp_path / "new folder" / "f.png")).shape[:2] == (600, 1020)


@pytest.mark.parametrize("suffix", ["svg", "pdf"])
def test_same_figure_gives_the_same_file(tmp_path: Path, suffix: str) -> None:
    for name in ("a", "b"):
        plots.save(simple(), tmp_path / f"{name}.{suffix}")
    files = [(tmp_path / f"{name}.{suffix}").read_bytes() for name in ("a", "b")]
    assert files[0] == files[1]
    assert len(list(tmp_path.iterdir())) == 2  # nothing temporary is left


def test_series_differ_in_colour_marker_or_line() -> None:
    styles = [tuple(plots.series_style(index).values()) for index in range(32)]
    assert len(set(styles)) == 32


@pytest.mark.parametrize("regions", [strips(9, "ring"), strips(5), strips(5, "horizontal")])
def test_values_of_regions_are_separate_and_inside(regions) -> None:
    region_map = regions.map((480, 640))
    places = [place for place in plots.staircase(region_map, 60) if place]
    assert [int(region_map[place]) for place in places] == list(range(regions.regions))
    apart = np.abs(np.subtract.outer(places, places)[:, [0, 1], :, [0, 1]]).max(0)
    assert apart[~np.eye(len(places), dtype=bool)].min() >= 20


def test_bars_of_series_stand_side_by_side() -> None:
    rows = [(name, x, 5.0, 4.0, 7.0) for name in ("a", "b") for x in (1, 2)]
    frame = pd.DataFrame(rows, columns=["series", "x", "value", "low", "high"])
    axes = plots.new_figure(3, 2).subplots()
    plots.line_plot(axes, frame, {"b": {"label": "other"}}, bars=True, spread=0.4)
    first, second = (container.lines[0] for container in axes.containers)
    assert first.get_xdata().tolist() == [0.8, 1.8]
    assert second.get_xdata().tolist() == [1.2, 2.2]
    assert axes.get_legend_handles_labels()[1] == ["a", "other"]
    bars = axes.collections[0].get_segments()
    assert [bar[:, 1].tolist() for bar in bars] == [[4, 7]] * 2
