"""Figures and stored pictures as parts of an HTML page, which then loads nothing."""

from __future__ import annotations

import base64
import html
import io
import re
from pathlib import Path
from typing import Annotated

from annotated_types import Interval
from PIL import Image

from rgbt.checks import InputError
from rgbt.data.files import opened
from rgbt.files.plain_files import parse_json
from rgbt.tracking.pictures import COLUMNS

# Widest picture in pixels.
WIDTH = 320
QUALITY = 82

# Points of the widest chart that a telephone shows whole.
NARROW = 300

Byte = Annotated[int, Interval(ge=0, le=255)]
# Name, red, green and blue of a class.
LEGEND = list[tuple[str, Byte, Byte, Byte]]

# White and black are those of the page, which a browser may show dark.
THEME = {"#ffffff": "var(--page)", "#000000": "currentColor"}


def inline(svg: bytes, name: str, number: int) -> str:
    """Return the SVG of `plots.content_of` as an element: it scales, and has a `name` for readers.

    `number` differs for every figure of a page, because identifiers may be there once.
    """
    text = svg.decode()
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>f{number}-", text)
    for colour, of_page in THEME.items():
        text = text.replace(f": {colour}", f": {of_page}")
    head, rest = text.split(">", 1)
    width = float(re.findall(r' width="([\d.]+)pt"', head)[0])
    head = re.sub(r' (width|height|version)="[^"]*"', "", head)
    # Wider than a telephone: letters stay readable, and its container scrolls.
    least = width / 14 if width > NARROW else 0
    style = f"max-width: {width / 10:.1f}rem; min-width: {least:.1f}rem"
    label = html.escape(name)
    return f'{head} class="chart" style="{style}" role="img" aria-label="{label}">{rest}'


def stored_pictures(path: Path) -> tuple[str, LEGEND, dict[str, str]]:
    """Read `rgbt.tracking.pictures.write_strip`: name of the image, classes, pictures by `COLUMNS`.

    Pictures are data addresses, decoded and encoded anew. InputError: no such file, or another one.
    """
    strip, _ = opened(path)
    texts = getattr(strip, "text", {})
    width = strip.width // len(COLUMNS)
    try:
        name, legend = texts["image"], parse_json(texts["classes"].encode(), LEGEND)
        parts = [strip.crop((n * width, 0, (n + 1) * width, strip.height)) for n in range(4)]
        found = {}
        for title, part in zip(COLUMNS, parts, strict=True):
            found[title] = _address(part.convert("RGB"), is_photo=title in COLUMNS[:2])
    except (KeyError, ValueError, OSError) as error:
        raise InputError(f"{path.name} has no pictures of a test image ({error!r}).") from error
    return name, legend, found


def _address(picture: Image.Image, *, is_photo: bool) -> str:
    """A picture of at most `WIDTH` pixels as a data address; class colours stay exact."""
    if picture.width > WIDTH:
        size = WIDTH, max(1, round(picture.height * WIDTH / picture.width))
        how = Image.Resampling.LANCZOS if is_photo else Image.Resampling.NEAREST
        picture = picture.resize(size, how)
    content, kind = io.BytesIO(), "jpeg" if is_photo else "png"
    if is_photo:
        picture.save(content, format=kind, quality=QUALITY)
    else:
        picture.quantize(256).save(content, format=kind, optimize=True)
    return f"data:image/{kind};base64,{base64.b64encode(content.getvalue()).decode()}"
