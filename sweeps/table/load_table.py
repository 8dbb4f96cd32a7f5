"""Reads and checks table files: the papers' in ``sweeps/tables``, the user's in ``tables``."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from rgbt.checks import InputError, check_choice, nearest
from rgbt.config.component import build
from rgbt.config.compose import available, conf_dir
from rgbt.files.yaml_files import read_yaml
from rgbt.metrics.named import OF_PAIRS
from sweeps.table.table import Column, Factor, Row, Table

PUBLISHED = Path(__file__).resolve().parents[1] / "tables"
"""The papers' tables, part of the package."""

OWN = Path("tables")
"""Tables of the user, in the current folder."""

KINDS = ("metric", "minus", "mean", "parameters", "needs")
"""Keys of a column that define its values; a column has one of them."""

SHAPES: dict[str, type[Any]] = {"rows": Row, "columns": Column, "factor": Factor}


def table_names(folder: Path = OWN) -> list[str]:
    """Names for `load_table`: the papers' tables, then those in `folder`."""
    return [
        path.relative_to(root).with_suffix("").as_posix()
        for root in (PUBLISHED, folder)
        for path in sorted(root.rglob("*.yaml"))
    ]


def load_table(name: str, folder: Path = OWN) -> Table:
    """Read and check a table.

    Args:
        name: "spatialseg/table3" for a published table, "my/ablation" for one in `folder`, or a
            path that ends in .yaml.
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
        table = pydantic.TypeAdapter(Table).validate_json(text, strict=True)
    except pydantic.ValidationError as error:
        raise InputError(f"{path}, {_sentence(error.errors()[0], plain)}") from None
    _check_table(table, str(path))
    return table


def _find(name: str, folder: Path) -> Path:
    if name.endswith((".yaml", ".yml")):
        path = Path(name).expanduser()
        if not path.is_file():
            raise InputError(f"table={name}: there is no such file.")
        return path
    paths = [path for root in (PUBLISHED, folder) if (path := root / f"{name}.yaml").is_file()]
    if len(paths) > 1:
        raise InputError(f"table={name} is both {paths[0]} and {paths[1]}; give the path of one.")
    if not paths:
        raise InputError(f"there is no table '{name}'; {nearest(name, table_names(folder))}.")
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
        shape = SHAPES[parents[0]] if parents else Table
        known = [entry.name for entry in fields(shape)]
        return f"{where}'{last}' is not a key; {nearest(str(last), known)}."
    if error["type"] == "missing":
        return f"{where}'{last}' has no value; give one."
    reason = error["msg"].replace("Input", "input").replace("valid array", "list")
    got = json.dumps(error["input"], default=str)
    return f"{where}'{last}': {reason}, got {got}."


def _check_table(table: Table, where: str) -> None:
    """Refuse a table whose parts do not fit; `where` is its file."""
    for what, names in (
        ("columns", [column.name for column in table.columns]),
        ("rows", [row.label for row in table.rows]),
    ):
        for index, name in enumerate(names):
            if name in names[:index]:
                raise InputError(
                    f"{where}, {what}: '{name}' is used twice; give each its own name."
                )
    if table.regions != "as trained":
        check_choice(f"{where}, regions", table.regions, available("metric"))
    _check_scales(table.at, where)
    for index, column in enumerate(table.columns):
        _check_column(column, table, table.columns[:index], f"{where}, column '{column.name}'")
    for row in table.rows:
        _check_row(row, table, f"{where}, row '{row.label}'")


def _check_scales(at: Iterable[str], where: str) -> None:
    for scale in at:
        check_choice(f"{where}, at", scale, available("scale"))


def _check_column(column: Column, table: Table, before: Sequence[Column], where: str) -> None:
    given = [key for key in KINDS if getattr(column, key) not in (None, False)]
    if len(given) != 1:
        got = " and ".join(given) or "none"
        known = f"{', '.join(KINDS[:-1])} and {KINDS[-1]}"
        raise InputError(f"{where}: expected one of {known}, got {got}.")
    for name in column.sources:
        check_choice(f"{where}, {given[0]}", name, [each.name for each in table.columns])
    _check_frames(column, where)
    is_of_frames = column.metric is not None and column.frames is None
    if column.head != "as trained" and not is_of_frames:
        raise InputError(
            f"{where}: 'head' is only for scores of single frames; remove head: {column.head}."
        )
    if column.corruption is not None and not is_of_frames:
        raise InputError(
            f"{where}: 'corruption' is only for scores of single frames; remove corruption: "
            f"{column.corruption}."
        )
    if column.corruption is None and column.severity is not None:
        raise InputError(
            f"{where}: 'severity' needs a corruption; add corruption: NAME, or remove it."
        )
    if column.corruption is not None:
        _check_corruption(column.corruption, column.severity, where)
    _check_sources(column, table, before, f"{where}, {given[0]}")


def _check_sources(column: Column, table: Table, before: Sequence[Column], where: str) -> None:
    """Refuse a difference or mean of columns that are computed later or are not scores."""
    if column.mean is not None and len(set(column.mean)) != max(2, len(column.mean)):
        got = ", ".join(column.mean) or "none"
        raise InputError(f"{where}: expected two or more different columns, got {got}.")
    for other in (each for each in table.columns if each.name in column.sources):
        if other.sources and other not in before:
            raise InputError(
                f"{where}: '{other.name}' is computed from other columns itself; move it in front "
                f"of '{column.name}', or name the columns that it is computed from."
            )
        if other.parameters:
            raise InputError(
                f"{where}: '{other.name}' counts parameters and is not a score; remove it."
            )


def _check_corruption(corruption: str, severity: float | None, where: str) -> None:
    name, _, image = corruption.partition(":")
    check_choice(f"{where}, corruption", name, available("corruption"))
    # Below its key, as in a configuration: sentences about it name corruption.severities.
    file = conf_dir() / "corruption" / f"{name}.yaml"
    node = OmegaConf.create({"corruption": OmegaConf.load(file)}).corruption
    if image:
        node.image = image
    try:
        kind: Any = build(node)
        if severity is not None:
            kind.check(severity)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    if severity is None and len(kind.severities) > 1:
        known = ", ".join(f"{each:g}" for each in kind.severities)
        raise InputError(f"{where}: {kind.title} needs a severity ({kind.unit}); one of {known}.")


def _check_frames(column: Column, where: str) -> None:
    """Refuse a consistency metric without frames, and frames of anything else."""
    is_consistency = (column.metric or "").rpartition("/")[2] in OF_PAIRS
    if is_consistency and column.frames is None:
        raise InputError(
            f"{where}: {column.metric} compares two frames; add frames: aligned, released or next."
        )
    if column.frames is not None and not is_consistency:
        raise InputError(
            f"{where}: 'frames' is only for {', '.join(OF_PAIRS)}; remove it, or choose one of "
            "these."
        )
    if column.frames is not None and column.modality != "default":
        raise InputError(
            f"{where}: consistency uses the images that the network is built for; remove "
            f"modality: {column.modality}."
        )


def _check_row(row: Row, table: Table, where: str) -> None:
    names = [column.name for column in table.columns]
    if row.experiment is not None:
        check_choice(f"{where}, experiment", row.experiment, available("experiment"))
    _check_scales(row.at, where)
    for name in row.without:
        check_choice(f"{where}, without", name, names)
    for name in (*row.values, *row.doubtful):
        check_choice(f"{where}, column", name, names)
        if not table.columns[names.index(name)].printed:
            raise InputError(
                f"{where}: column '{name}' is not printed (printed: false); remove its value."
            )
    for column in table.columns:
        for key in re.findall(r"{(\w+)}", column.metric or ""):
            check_choice(f"{where}, '{key}' of metric {column.metric}", key, row.settings)
    if row.x is not None and table.factor is None:
        raise InputError(f"{where}: 'x' has no effect without the table's 'factor'; add a factor.")
    if row.x is not None and table.factor is not None and table.factor.axis == "log" and row.x <= 0:
        raise InputError(f"{where}: 'x' must be > 0 on a log axis, got {row.x:g}.")
