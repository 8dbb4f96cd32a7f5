"""Rows of a declared design: the table file declares factors and methods, this makes its rows."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from itertools import combinations

from rgbt.checks import InputError, check_choice
from rgbt.config.compose import available
from sweeps.table.design import Combined, Design, DesignFactor, Levels, Part, cell_name, sign_of
from sweeps.table.table import Row, Table

TRAINED, TESTED = "trained", "tested"
"""Groups of rows: ``rows=trained`` chooses all rows of the group."""


def with_design_rows(table: Table, where: str) -> Table:
    """The table with the rows of its design behind its own; the same where it has none.

    Args:
        table: as read.
        where: its file, for messages.

    Raises:
        InputError: a design whose parts do not fit each other, or a table without any row.
    """
    design = table.design
    if design is None:
        return table
    check_design(design, table, f"{where}, design")
    return replace(table, rows=(*table.rows, *_trained_rows(design), *_tested_rows(design)))


def _trained_rows(design: Design) -> Iterable[Row]:
    """One row for each method and cell."""
    part = design.trained
    if part is None:
        return
    for method in design.methods:
        for cell in design.cells(part):
            yield Row(
                label=trained_label(method.name, cell),
                group=TRAINED,
                settings={"method": method.name, **cell},
                experiment=method.experiment,
                overrides=(
                    *design.overrides,
                    *part.overrides,
                    *design.cell_overrides(cell),
                    *method.overrides,
                ),
            )


def _tested_rows(design: Design) -> Iterable[Row]:
    """One row for each method, whose network is tested in every cell."""
    part = design.tested
    if part is None:
        return
    worlds = {
        cell_name(cell): (*part.overrides, *design.cell_overrides(cell))
        for cell in design.cells(part)
    }
    for method in design.methods:
        yield Row(
            label=tested_label(method.name),
            group=TESTED,
            settings={"method": method.name},
            experiment=method.experiment,
            overrides=(*design.overrides, *method.overrides),
            tested_in=worlds,
        )


def trained_label(method: str, cell: Levels) -> str:
    """Label of the row of a method that is trained in a cell."""
    return f"{method} {cell_name(cell)}"


def tested_label(method: str) -> str:
    """Label of the row of a method that is trained without any factor."""
    return f"{method} natural"


def check_design(design: Design, table: Table, where: str) -> None:
    """Refuse a design whose parts do not fit.

    Raises:
        InputError: in one sentence.
    """
    if len(design.factors) < 2:
        raise InputError(f"{where}, factors: expected two or more, got {len(design.factors)}.")
    for what, names in (
        ("factors, letter", design.letters),
        ("factors, name", [factor.name for factor in design.factors]),
        ("methods", [method.name for method in design.methods]),
    ):
        _check_distinct(names, f"{where}, {what}")
    for factor in design.factors:
        _check_factor(factor, f"{where}, factor '{factor.name}'")
    for place, each in enumerate(design.combined, start=1):
        _check_combined(each, design, f"{where}, combined {place}")
    _check_methods(design, where)
    columns = [column.name for column in table.columns]
    if not design.outcomes:
        raise InputError(f"{where}, outcomes: expected the name of one column or more, got none.")
    for name in design.outcomes:
        check_choice(f"{where}, outcomes", name, columns)
    parts = {TRAINED: design.trained, TESTED: design.tested}
    if not any(parts.values()):
        raise InputError(f"{where}: expected trained, tested or both; got none.")
    for name, part in parts.items():
        if part is not None:
            _check_part(part, design, f"{where}, {name}")
    _check_switched(design, where)


def _check_distinct(names: Sequence[str], where: str) -> None:
    for index, name in enumerate(names):
        if name in names[:index]:
            raise InputError(f"{where}: '{name}' is used twice; give each its own.")


def _check_factor(factor: DesignFactor, where: str) -> None:
    if not (len(factor.letter) == 1 and factor.letter.isascii() and factor.letter.isupper()):
        raise InputError(f"{where}, letter: expected one capital letter, got '{factor.letter}'.")


def _check_combined(each: Combined, design: Design, where: str) -> None:
    for letter in each.levels:
        check_choice(f"{where}, levels", letter, design.letters)
    if len(each.levels) < 2:
        raise InputError(
            f"{where}, levels: expected the levels of two factors or more, got "
            f"{', '.join(each.levels) or 'none'}; write the overrides of one factor as its low and "
            "high."
        )


def _check_methods(design: Design, where: str) -> None:
    if not design.methods:
        raise InputError(f"{where}, methods: expected one or more, got none.")
    before: list[str] = []
    for method in design.methods:
        at = f"{where}, method '{method.name}'"
        check_choice(f"{at}, experiment", method.experiment, available("experiment"))
        if method.against is not None:
            check_choice(f"{at}, against (an earlier method)", method.against, before)
        before.append(method.name)


def _check_part(part: Part, design: Design, where: str) -> None:
    """Refuse generators that are no product of other factors, or that mix main effects."""
    free = [letter for letter in design.letters if letter not in part.generators]
    for letter, others in part.generators.items():
        check_choice(f"{where}, generators", letter, design.letters)
        for other in others:
            check_choice(
                f"{where}, generators, {letter} (factors without a generator)", other, free
            )
        _check_distinct(others, f"{where}, generators, {letter}")
    cells = design.cells(part)
    for effects in design.effects(part).values():
        mains = [effect for effect in effects if len(effect) == 1]
        if mains and len(effects) > 1 or _is_constant(next(iter(effects)), cells):
            raise InputError(
                f"{where}, generators: the main effect of {mains[0] if mains else '?'} cannot be "
                f"told apart from {', '.join(list(effects)[1:]) or 'the mean'}; use products of "
                "three factors or more (resolution IV)."
            )


def _is_constant(effect: str, cells: Collection[Levels]) -> bool:
    return len({sign_of(cell, effect) for cell in cells}) == 1


def _check_switched(design: Design, where: str) -> None:
    """Refuse a factor whose level changes nothing, and cells that are the same world."""
    for part in (design.trained, design.tested):
        if part is None:
            continue
        worlds = {
            cell_name(cell): _last(design.cell_overrides(cell)) for cell in design.cells(part)
        }
        for (first, a), (second, b) in combinations(worlds.items(), 2):
            if a == b:
                raise InputError(
                    f"{where}: the cells {first} and {second} have equal overrides; give the "
                    "factors in which they differ overrides, or an entry of combined."
                )


def _last(words: Sequence[str]) -> dict[str, str]:
    """The value of each key: the last override wins."""
    return {key: value for key, _, value in (word.partition("=") for word in words)}
