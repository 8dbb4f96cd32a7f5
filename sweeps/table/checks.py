"""What the types of a table file do not say: names that must exist, and names that must differ."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from omegaconf import OmegaConf

from rgbt.checks import InputError, check_choice
from rgbt.config.component import build
from rgbt.config.compose import conf_dir
from rgbt.metrics.named import OF_PAIRS

if TYPE_CHECKING:
    from sweeps.table.table import Column, Factor, Row, Table


def check_table(table: Table, place: str) -> None:
    """Refuse a table whose parts do not fit.

    Args:
        table: with the right types.
        place: its file, for messages.

    Raises:
        InputError: an experiment, scale or regions that the configuration does not know; a column
            that no column has; a label or name that stands twice; an `x` without an axis.
    """
    names = [column.name for column in table.columns]
    _check_distinct(names, f"{place}, columns")
    _check_distinct([row.label for row in table.rows], f"{place}, rows")
    if table.regions != "as trained":
        check_choice(f"{place}, regions", table.regions, _files("metric"))
    _check_scales(table.at, place)
    for index, column in enumerate(table.columns):
        before = table.columns[:index]
        _check_column(column, table, before, f"{place}, column '{column.name}'")
    for row in table.rows:
        _check_row(row, table, f"{place}, row '{row.label}'")


def _check_distinct(names: list[str], place: str) -> None:
    for index, name in enumerate(names):
        if name in names[:index]:
            raise InputError(f"{place}: '{name}' stands twice; give each its own name.")


def _check_scales(at: Iterable[str], place: str) -> None:
    for scale in at:
        check_choice(f"{place}, at", scale, _files("scale"))


def _files(group: str) -> list[str]:
    return [file.stem for file in (conf_dir() / group).glob("*.yaml")]


KINDS = ("metric", "minus", "mean", "parameters", "needs")
"""Keys of a column of which one says where its values come from."""


def _check_column(column: Column, table: Table, before: Sequence[Column], place: str) -> None:
    given = [key for key in KINDS if getattr(column, key) not in (None, False)]
    if len(given) != 1:
        got = " and ".join(given) or "none"
        known = f"{', '.join(KINDS[:-1])} and {KINDS[-1]}"
        raise InputError(f"{place}: expected one of {known}, got {got}.")
    for other in column.sources:
        check_choice(f"{place}, {given[0]}", other, [each.name for each in table.columns])
    _check_frames(column, place)
    _check_head(column, place)
    _check_degradation(column, place)
    _check_sources(column, table, before, f"{place}, {given[0]}")


def _check_sources(column: Column, table: Table, before: Sequence[Column], place: str) -> None:
    """Refuse a difference or mean of what is not known when it is computed, or is no score."""
    if column.mean is not None and len(set(column.mean)) != max(2, len(column.mean)):
        got = ", ".join(column.mean) or "none"
        raise InputError(f"{place}: expected two or more different columns, got {got}.")
    for other in (each for each in table.columns if each.name in column.sources):
        if other.sources and other not in before:
            raise InputError(
                f"{place}: '{other.name}' is computed from other columns itself; move it in front "
                f"of '{column.name}', or name the columns that it is computed from."
            )
        if other.parameters:
            raise InputError(
                f"{place}: '{other.name}' counts parameters and is no score; leave it."
            )


def _check_head(column: Column, place: str) -> None:
    """Refuse a head for what is not predicted, or not by a head that can be chosen."""
    if column.head != "as trained" and (column.metric is None or column.frames is not None):
        raise InputError(
            f"{place}: 'head' is for scores of single frames alone; remove head: {column.head}."
        )


def _check_degradation(column: Column, place: str) -> None:
    """Refuse a degradation of what is not predicted, an unknown one, or a severity it has not."""
    if column.degradation is None:
        if column.severity is not None:
            raise InputError(
                f"{place}: 'severity' is of a degradation; add degradation: NAME, or remove it."
            )
        return
    if column.metric is None or column.frames is not None:
        raise InputError(
            f"{place}: 'degradation' is for scores of single frames alone; remove degradation: "
            f"{column.degradation}."
        )
    check_choice(f"{place}, degradation", column.degradation, _files("degradation"))
    # Below its key, as in a configuration: sentences about it name degradation.severities.
    file = conf_dir() / "degradation" / f"{column.degradation}.yaml"
    kind = build(OmegaConf.create({"degradation": OmegaConf.load(file)}).degradation)
    if column.severity is None and len(kind.severities) > 1:
        known = ", ".join(f"{each:g}" for each in kind.severities)
        raise InputError(f"{place}: {kind.title} needs a severity ({kind.unit}); one of {known}.")
    if column.severity is not None:
        try:
            kind.check(column.severity)
        except InputError as error:
            raise InputError(f"{place}: {error}") from None


def _check_frames(column: Column, place: str) -> None:
    """Refuse a consistency metric without frames, and frames of anything else."""
    is_consistency = (column.metric or "").rpartition("/")[2] in OF_PAIRS
    if is_consistency and column.frames is None:
        raise InputError(
            f"{place}: {column.metric} compares two frames; add frames: aligned, released or next."
        )
    if column.frames is not None and not is_consistency:
        raise InputError(
            f"{place}: 'frames' is for {', '.join(OF_PAIRS)} alone; remove it, or choose one of "
            "these."
        )
    if column.frames is not None and column.modality != "default":
        raise InputError(
            f"{place}: consistency is counted from what the network is made for; remove "
            f"modality: {column.modality}."
        )


def _check_row(row: Row, table: Table, place: str) -> None:
    names = [column.name for column in table.columns]
    if row.experiment is not None:
        check_choice(f"{place}, experiment", row.experiment, _files("experiment"))
    _check_scales(row.at, place)
    for name in row.without:
        check_choice(f"{place}, without", name, names)
    for name in (*row.values, *row.doubtful):
        check_choice(f"{place}, column", name, names)
        if not table.columns[names.index(name)].printed:
            raise InputError(
                f"{place}: column '{name}' is not printed (printed: false); remove its value."
            )
    for column in table.columns:
        for key in re.findall(r"{(\w+)}", column.metric or ""):
            check_choice(f"{place}, '{key}' of metric {column.metric}", key, row.settings)
    if row.x is not None:
        _check_x(row.x, table.factor, place)


def _check_x(x: float, factor: Factor | None, place: str) -> None:
    if factor is None:
        raise InputError(f"{place}: 'x' has no effect without 'factor' of the table; add one.")
    if factor.axis == "log" and x <= 0:
        raise InputError(f"{place}: 'x' must be > 0 on a log axis, got {x:g}.")
