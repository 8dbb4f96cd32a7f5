"""Figures and stored pictures inside a page: exact class colours, and nothing that acts."""

from __future__ import annotations

import base64
import io
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from analysis.figures import plots
from analysis.figures.page import WIDTH, inline, stored_pictures
from rgbt.checks import InputError
from rgbt.tracking.pictures import COLUMNS, colours, write_strip
from rgbt.types import Sample

PALETTE = ((0, 0, 0), (64, 0, 128))
DATASET: Any = SimpleNamespace(classes=("unlabelled", "<i>car"), palette=PALETTE)


@pytest.mark.parametrize(("width", "shown"), [(40, 40), (2 * WIDTH, WIDTH)])
def test_stored_pictures_keep_the_colours_of_classes(
    tmp_path: Path, width: int, shown: int
) -> None:
    label = np.zeros((30, width), np.uint8)
    label[5:15, 4:16] = 1
    label[0] = 255
    rgb = np.repeat(np.linspace(0, 255, 30 * width).reshape(30, width, 1), 3, 2).astype(np.uint8)
    sample = Sample(rgb=rgb, thermal=rgb[..., 0], label=label, name="00001D")
    write_strip(sample, 1 - label.clip(0, 1), DATASET, tmp_path / "best.png")
    name, legend, pictures = stored_pictures(tmp_path / "best.png")
    assert (name, legend) == ("00001D", [("unlabelled", 0, 0, 0), ("<i>car", 64, 0, 128)])
    assert tuple(pictures) == COLUMNS
    found = {}
    for title, address in pictures.items():
        kind, content = address.split(";base64,")
        assert kind == ("data:image/jpeg" if title in COLUMNS[:2] else "data:image/png")
        found[title] = np.asarray(Image.open(io.BytesIO(base64.b64decode(content))).convert("RGB"))
        assert found[title].shape[1] == shown
    if width == shown:
        assert (found["ground truth"] == colours(label, np.array(PALETTE, np.uint8))).all()
        assert np.abs(found["RGB"].astype(int) - rgb).mean() < 3


@pytest.mark.parametrize(
    "texts",
    [
        {},
        {"image": "a", "classes": "[["},
        {"image": "a", "classes": '[["car", 0, 0, 300]]'},
        {"image": "a", "classes": '[["car", "url(x)", 0, 0]]'},
    ],
)
def test_a_picture_without_its_texts_is_refused(tmp_path: Path, texts: dict[str, str]) -> None:
    info = PngInfo()
    for key, text in texts.items():
        info.add_itxt(key, text)
    Image.new("RGB", (40, 10)).save(tmp_path / "best.png", pnginfo=info)
    with pytest.raises(InputError, match="best.png has no pictures of a test image"):
        stored_pictures(tmp_path / "best.png")
    (tmp_path / "best.png").write_text("<svg/>")
    with pytest.raises(InputError, match="cannot be decoded"):
        stored_pictures(tmp_path / "best.png")


@plots.styled
def titled(text: str) -> Figure:
    figure = plots.new_figure(2, 2)
    figure.subplots().set_title(text)
    return figure


def test_a_chart_has_the_colours_of_the_page_and_no_markup_of_names() -> None:
    found = inline(
        plots.content_of(titled("<script>alert(1)</script> $x^{"), "svg"), '"><script>', 7
    )
    assert found.startswith("<svg")
    assert "<script>" not in found
    assert "&lt;script&gt;alert(1)&lt;/script&gt; $x^{" in found
    assert "#000000" not in found
    assert "#ffffff" not in found
    assert {"currentColor", "var(--page)"} <= set(re.findall(r"(?:fill|stroke): ([^;\"]+)", found))
    identifiers = re.findall(r'\bid="([^"]*)"', found)
    assert all(each.startswith("f7-") for each in identifiers)
    used = re.findall(r'(?:href="#|url\(#)([^")]*)', found)
    assert set(used) <= set(identifiers)
