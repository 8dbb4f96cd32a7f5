"""Reads and checks table files.

The papers' are in ``sweeps/tables``, our studies in ``sweeps/studies``, the user's in ``tables``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any

from rgbt.checks import InputError, nearest
from rgbt.files.yaml_files import read_yaml
from sweeps.table.check_table import check_table
from sweeps.table.claim import Claim
from sweeps.table.design import Combined, Design, DesignFactor, DesignMethod, Part
from sweeps.table.design_rows import with_design_rows
from sweeps.table.table import Column, Factor, Row, Table

PUBLISHED = Path(__file__).resolve().parents[1] / "tables"
"""The papers' tables, part of the package."""

STUDIES = Path(__file__).resolve().parents[1] / "studies"
"""Our own studies, part of the package; no paper has printed them."""

OWN = Path("tables")
"""Tables of the user, in the current folder."""

SHAPES: dict[str, type[Any]] = {
    "rows": Row,
    "columns": Column,
    "factor": Factor,
    "claims": Claim,
    "design": Design,
    "design/factors": DesignFactor,
    "design/combined": Combined,
    "design/methods": DesignMethod,
    "design/trained": Part,
    "design/tested": Part,
}
"""What the parts of a file are read as."""


def table_names(folder: Path = OWN) -> list[str]:
    """Names for `load_table`: the papers' tables, then those in `folder`."""
    return [
        path.relative_to(root).with_suffix("").as_posix()
        for root in (PUBLISHED, folder)
        for path in sorted(root.rglob("*.yaml"))
    ]


def study_names() -> list[str]:
    """Names for `load_table` of our own studies."""
    return [path.stem for path in sorted(STUDIES.glob("*.yaml"))]


def load_table(name: str, folder: Path = OWN) -> Table:
    """Read and check a table.

    Args:
        name: "spatialseg/table3" for a published table, "spatial_bias" for a study of ours,
            "my/ablation" for one in `folder`, or a path that ends in .yaml.
        folder: of the user's tables.

    Raises:
        InputError: no such table, two of that name, an unreadable file, an unknown key or column,
            a wrong type; the sentence names file, row and key.
    """
    import pydantic

    path = _find(name, folder)
    plain = read_yaml(path)
    try:  # Read as JSON: a list may be a tuple, but a number is no text and text no number.
        text = json.dumps(plain, default=str)
        table = _adapter().validate_json(text, strict=True)
    except pydantic.ValidationError as error:
        raise InputError(f"{path}, {_sentence(error.errors()[0], plain)}") from None
    if "rows" not in plain and table.design is None:
        raise InputError(f"{path}, 'rows' has no value; give one.")
    table = with_design_rows(table, str(path))
    check_table(table, str(path))
    return table


@cache
def _adapter() -> Any:
    """What reads a table; made once, because that takes longer than to read a table."""
    import pydantic

    return pydantic.TypeAdapter(Table)


def _find(name: str, folder: Path) -> Path:
    if name.endswith((".yaml", ".yml")):
        path = Path(name).expanduser()
        if not path.is_file():
            raise InputError(f"table={name}: there is no such file.")
        return path
    paths = [
        path for root in (PUBLISHED, STUDIES, folder) if (path := root / f"{name}.yaml").is_file()
    ]
    if len(paths) > 1:
        raise InputError(f"table={name} is both {paths[0]} and {paths[1]}; give the path of one.")
    if not paths:
        known = [*table_names(folder), *study_names()]
        raise InputError(f"there is no table '{name}'; {nearest(name, known)}.")
    return paths[0]


def _sentence(error: Mapping[str, Any], plain: Any) -> str:
    """Pydantic's error with the row and the key, and the nearest known key."""
    *parents, last = error["loc"] or ("the whole file",)
    if isinstance(last, int):
        last = f"{parents.pop()}[{last}]"
    # The position in the file: ("rows", 3, "values") is ``row 'Ny/4', values:``.
    words = [str(parent) for parent in parents]
    if len(parents) > 1 and isinstance(index := parents[1], int):
        entry = plain[parents[0]][index]
        title = entry.get("label", entry.get("name")) if isinstance(entry, dict) else None
        words[:2] = [f"{words[0].removesuffix('s')} {index + 1 if title is None else repr(title)}"]
    where = f"{', '.join(words)}: " if words else ""
    if error["type"] == "unexpected_keyword_argument":
        named = "/".join(part for part in parents if isinstance(part, str))
        shape = SHAPES.get(named, SHAPES[parents[0]]) if parents else Table
        known = [entry.name for entry in fields(shape)]
        return f"{where}'{last}' is not a key; {nearest(str(last), known)}."
    if error["type"] == "missing":
        return f"{where}'{last}' has no value; give one."
    reason = error["msg"].replace("Input", "input").replace("valid array", "list")
    got = json.dumps(error["input"], default=str)
    return f"{where}'{last}': {reason}, got {got}."
