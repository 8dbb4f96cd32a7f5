"""Checks that the parts of a table fit each other: columns, rows, forms and claims."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

from omegaconf import OmegaConf

from rgbt.checks import InputError, check_choice
from rgbt.config.component import build
from rgbt.config.compose import available, conf_dir
from rgbt.metrics.details import default, details_of_metric
from rgbt.metrics.named import OF_PAIRS
from sweeps.table.claim import OTHERS, PREVIOUS, Claim
from sweeps.table.table import Column, ReleasedForm, Row, Table

KINDS = ("metric", "minus", "mean", "efficiency")
"""Keys of a column that define its values; a column has one of them."""


def check_table(table: Table, where: str) -> None:
    """Refuse a table whose parts do not fit.

    Args:
        table: as read.
        where: its file, for messages.

    Raises:
        InputError: an unknown name, a name used twice, or keys that exclude each other.
    """
    for what, names in (
        ("columns", [column.name for column in table.columns]),
        ("rows", [row.label for row in table.rows]),
        ("claims", [claim.name for claim in table.claims]),
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
    for claim in table.claims:
        _check_claim(claim, table, f"{where}, claim '{claim.name}'")


def _check_scales(at: Iterable[str], where: str) -> None:
    for scale in at:
        check_choice(f"{where}, at", scale, available("scale"))


def _check_column(column: Column, table: Table, before: Sequence[Column], where: str) -> None:
    given = [key for key in KINDS if getattr(column, key) is not None]
    if len(given) != 1:
        got = " and ".join(given) or "none"
        known = f"{', '.join(KINDS[:-1])} and {KINDS[-1]}"
        raise InputError(f"{where}: expected one of {known}, got {got}.")
    for name in column.sources:
        check_choice(f"{where}, {given[0]}", name, [each.name for each in table.columns])
    _check_frames(column, where)
    is_of_frames = column.metric is not None and column.frames is None
    for key in () if is_of_frames else ("head", "corruption", "batch_norm"):
        if getattr(column, key) not in (None, "as trained"):
            raise InputError(
                f"{where}: '{key}' is only for scores of single frames; remove {key}: "
                f"{getattr(column, key)}."
            )
    if column.batch_norm_splits and column.batch_norm in ("as trained", "batch"):
        raise InputError(
            f"{where}: 'batch_norm_splits' needs batch_norm: adabn or recomputed; add that, or "
            "remove batch_norm_splits."
        )
    if column.corruption is None and column.severity is not None:
        raise InputError(
            f"{where}: 'severity' needs a corruption; add corruption: NAME, or remove it."
        )
    if column.corruption is not None:
        _check_corruption(column.corruption, column.severity, where)
    _check_bin(column, where)
    _check_sources(column, table, before, f"{where}, {given[0]}")


def _check_bin(column: Column, where: str) -> None:
    """Refuse a bin that the evaluations of tables do not count."""
    details = details_of_metric(column.metric or "")
    if details is not None and details.bin:
        known = default(details.kind).bins
        check_choice(f"{where}, metric: {details.kind}", details.bin, known)


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
        if other.efficiency is not None:
            raise InputError(
                f"{where}: '{other.name}' is the efficiency of networks and no score; remove it."
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
    _check_experiment(row, where)
    _check_scales(row.at, where)
    if row.released is not None:
        _check_released(row, row.released, f"{where}, released")
    if row.same_as is not None:
        before = [each.label for each in table.rows[: table.rows.index(row)]]
        check_choice(f"{where}, same_as (an earlier row)", row.same_as, before)
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
    if row.x is not None:
        _check_x(row.x, table, where)
    _check_image(row.settings.get("image_hw", (1, 1)), where)


def _check_experiment(row: Row, where: str) -> None:
    if row.experiment is not None:
        check_choice(f"{where}, experiment", row.experiment, available("experiment"))
    elif row.overrides:
        raise InputError(
            f"{where}: the row has no experiment; add one, or remove 'overrides', which have no "
            "effect without it."
        )


def _check_image(value: Any, where: str) -> None:
    """Refuse a size of images that is not two numbers of pixels."""
    is_size = isinstance(value, tuple | list) and len(value) == len(("height", "width"))
    if not is_size or not all(type(each) is int and each > 0 for each in value):
        raise InputError(
            f"{where}, settings, image_hw: expected [height, width] in pixels, got {value}."
        )


def _check_x(x: float, table: Table, where: str) -> None:
    if table.factor is None:
        raise InputError(f"{where}: 'x' has no effect without the table's 'factor'; add a factor.")
    if table.factor.axis == "log" and x <= 0:
        raise InputError(f"{where}: 'x' must be > 0 on a log axis, got {x:g}.")


def _check_released(row: Row, released: ReleasedForm, where: str) -> None:
    _check_scales(released.at or {}, where)
    if row.experiment is None:
        raise InputError(f"{where}: the row has no experiment; add one, or remove 'released'.")
    if released.experiment is not None:
        check_choice(f"{where}, experiment", released.experiment, available("experiment"))


def _check_claim(claim: Claim, table: Table, where: str) -> None:
    """Refuse a claim about rows or columns that are not there, or without a contrast."""
    labels = [row.label for row in table.rows]
    for label in claim.rows:
        check_choice(f"{where}, rows", label, labels)
    for label in claim.against:
        if label not in (OTHERS, PREVIOUS):
            check_choice(f"{where}, against", label, labels)
        elif len(claim.against) > 1:
            raise InputError(f"{where}, against: '{label}' stands alone; remove the other entries.")
    names = [column.name for column in table.columns]
    for name in (*claim.columns, *([claim.minus_column] if claim.minus_column else [])):
        check_choice(f"{where}, column", name, names)
    if not claim.columns or not any(True for _ in claim.pairs(labels)):
        raise InputError(f"{where}: there is nothing to compare; name rows, against and columns.")
    if claim.expected == "similar" and claim.at_most is None:
        raise InputError(f"{where}: 'similar' needs at_most, the largest difference that it means.")
    if claim.at_most is not None and claim.at_most <= claim.at_least:
        raise InputError(
            f"{where}: at_most must be above at_least ({claim.at_least:g}), got {claim.at_most:g}."
        )
