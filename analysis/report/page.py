"""The page: one file with its data, style and script inside, which loads nothing."""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from analysis.report.data import ReportData
from rgbt.checks import InputError
from rgbt.files.atomic import write_atomic

STATIC = Path(__file__).with_name("static")
STYLES = ("style.css", "tables.css", "drawings.css")

EARLY = "early.js"
"""Runs before the page is painted."""

SCRIPTS = (
    "base.js",
    "sorting.js",
    "axes.js",
    "panel.js",
    "cells.js",
    "tables.js",
    "table_chart.js",
    "runs.js",
    "regions.js",
    "markdown.js",
    "studies.js",
    "summary.js",
    "start.js",
)
"""Joined in this order: `base.js` reads the data, `start.js` draws the page."""

SECTIONS = (
    ("summary", "Summary"),
    ("tables", "Tables"),
    ("runs", "Runs"),
    ("regions", "Regions"),
    ("searches", "Searches"),
    ("masks", "Masks"),
    ("differences", "Paper against release"),
)
"""Name behind # and heading, as `RENDER` of `start.js` draws them."""


def write_page(data: ReportData, out: Path) -> Path:
    """Write the page.

    Args:
        data: what it shows.
        out: folder, made where it is missing; a page that is there is replaced.

    Returns:
        ``out/index.html``.

    Raises:
        InputError: the folder cannot be made or written.
        ValueError: a picture that is not inside the data.
    """
    page = out / "index.html"
    text = page_text(data)
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_atomic(page, text.encode())
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"out={out}: {reason}; give a folder that can be written.") from error
    return page


def page_text(data: ReportData) -> str:
    """The page as HTML.

    Its policy lets the browser run these two scripts by their hashes and load nothing: text from
    the store that would get into the markup after all could neither run nor call home.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    _check_pictures(data)
    folder = FileSystemLoader(STATIC)
    # Autoescape: the title is text of the store; what is `safe` in the template is ours or JSON.
    environment = Environment(
        loader=folder, autoescape=True, undefined=StrictUndefined, keep_trailing_newline=True
    )
    early, script = _joined("scripts", [EARLY]), _joined("scripts", SCRIPTS)
    return environment.get_template("page.html.j2").render(
        title=data.title,
        sections=SECTIONS,
        policy=_policy(early, script),
        style=_joined("", STYLES),
        early=early,
        script=script,
        payload=embedded(packed(data.to_json())),
    )


def packed(plain: Mapping[str, Any]) -> dict[str, Any]:
    """`ReportData.to_json` with the configurations of the runs stored by what differs.

    Args:
        plain: is not changed.

    Returns:
        the same with ``common_config`` (each key's most frequent value), and in each run ``config``
        (values that differ from it) and ``config_lacks`` (its keys that the run has not).
    """
    configs = [run["config"] for run in plain["runs"]]
    common = _most_frequent(configs)
    runs = [
        {
            **run,
            "config": {k: v for k, v in run["config"].items() if common[k] != v},
            "config_lacks": [key for key in common if key not in run["config"]],
        }
        for run in plain["runs"]
    ]
    return {**plain, "runs": runs, "common_config": common}


def embedded(plain: Any) -> str:
    """JSON that may stand inside a script element.

    Only ASCII, so that neither U+2028 nor half of a surrogate pair is in the file; no ``<``, so
    that no text can end the element. A number that is not finite becomes null, as JSON has none.
    """
    text = json.dumps(_finite(plain), allow_nan=False, separators=(",", ":"))
    for letter in "<>&":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return text


def _most_frequent(configs: Iterable[Mapping[str, str]]) -> dict[str, str]:
    """Key -> its most frequent value; of equally frequent ones the first."""
    counts: dict[str, Counter[str]] = {}
    for config in configs:
        for key, value in config.items():
            counts.setdefault(key, Counter())[value] += 1
    return {key: values.most_common(1)[0][0] for key, values in counts.items()}


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(child) for key, child in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(child) for child in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _joined(folder: str, names: Iterable[str]) -> str:
    return "".join((STATIC / folder / name).read_text() for name in names)


def _policy(*scripts: str) -> str:
    """Content security policy that allows these scripts, our style, and pictures in the data."""
    digests = (hashlib.sha256(script.encode()).digest() for script in scripts)
    hashes = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    return (
        f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )


def _check_pictures(data: ReportData) -> None:
    for picture in data.masks:
        if not picture.address.startswith("data:image/"):
            raise ValueError(f"picture {picture.title}: {picture.address[:40]} is not in the data.")
