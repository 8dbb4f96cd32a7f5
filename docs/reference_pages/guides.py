"""`docs/guides.yaml`: the hand-written page of every experiment, command and group."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, Literal

import yaml

DOCS = Path(__file__).resolve().parents[1]
Kind = Literal["groups", "commands", "experiments"]


@cache
def guides() -> dict[str, dict[str, Any]]:
    """Content of the file: the page of each name, by kind."""
    return dict(yaml.safe_load((DOCS / "guides.yaml").read_text()))


def about(group: str) -> str:
    """What a group sets, in one sentence; "" without an entry."""
    return str(guides()["about"].get(group, ""))


def link(kind: Kind, name: str, depth: int) -> str:
    """A link to the page of an entry, from a page `depth` folders below docs/; "" without one."""
    page = guides()[kind].get(name)
    return f"[{title(page)}]({'../' * depth}{page})" if page else ""


@cache
def title(page: str) -> str:
    """The first heading of a page."""
    lines = (DOCS / page).read_text().splitlines()
    return next(line.removeprefix("# ") for line in lines if line.startswith("# "))
