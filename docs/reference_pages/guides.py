"""`docs/guides.yaml`: the hand-written page of every experiment, command and group."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple

import yaml

DOCS = Path(__file__).resolve().parents[1]
Kind = Literal["groups", "commands", "experiments"]


class Guide(NamedTuple):
    """What one entry says.

    Attributes:
        page: path of the page from docs/.
        about: one sentence; "" where the code says what it is.
    """

    page: str
    about: str = ""


@cache
def guides(kind: Kind) -> dict[str, Guide]:
    """Entries of one kind, by name."""
    entries = yaml.safe_load((DOCS / "guides.yaml").read_text())[kind]
    return {name: Guide(each["page"], each.get("about", "")) for name, each in entries.items()}


def link(kind: Kind, name: str, depth: int) -> str:
    """A link to the page of an entry, from a page `depth` folders below docs/; "" without one."""
    guide = guides(kind).get(name)
    if guide is None:
        return ""
    return f"[{title(guide.page)}]({'../' * depth}{guide.page})"


@cache
def title(page: str) -> str:
    """The first heading of a page."""
    lines = (DOCS / page).read_text().splitlines()
    return next(line.removeprefix("# ") for line in lines if line.startswith("# "))
