"""A factorial design in a table file: factors of two levels, methods, outcomes, and their rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import combinations, product
from math import prod
from typing import Annotated, Any, Literal

from annotated_types import MinLen
from pydantic import StringConstraints, model_validator

from rgbt.checks import check_choice
from rgbt.config.compose import available
from sweeps.plan.claim import Strict, check_different

Level = Literal["low", "high"]
Levels = Mapping[str, Level]  # letter of a factor -> its level

Effect = str  # letters of the factors: "N" a main effect, "ON" an interaction

TRAINED, TESTED = "trained", "tested"  # groups of rows: rows=trained


@dataclass(frozen=True, kw_only=True)
class DesignFactor(Strict):
    """A factor that is switched alone: overrides of both levels, and what they mean."""

    letter: Annotated[str, StringConstraints(pattern="^[A-Z]$")]
    name: str
    low: tuple[str, ...] = ()
    high: tuple[str, ...] = ()
    low_means: str
    high_means: str


@dataclass(frozen=True, kw_only=True)
class Combined(Strict):
    """Overrides of the cells in which two factors or more have given levels; they win."""

    levels: Annotated[Levels, MinLen(2)]
    overrides: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class DesignMethod(Strict):
    """A method that is trained; its effects are compared with those of the method `against`."""

    name: str
    experiment: str
    overrides: tuple[str, ...] = ()
    against: str | None = None


@dataclass(frozen=True, kw_only=True)
class Part(Strict):
    """One of the two experiments that a design can be.

    In `generators`, {S: OCN} makes the level of a factor the product of those of others, which
    halves the number of cells.
    """

    overrides: tuple[str, ...] = ()
    generators: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Design(Strict):
    """A two-level factorial design.

    Attributes:
        overrides: of every run and cell, e.g. the data set.
        outcomes: names of columns whose effects are estimated.
        trained: each method is trained and tested in each cell.
        tested: each method is trained once, without any factor, and tested in each cell.
    """

    factors: Annotated[tuple[DesignFactor, ...], MinLen(2)]
    combined: tuple[Combined, ...] = ()
    overrides: tuple[str, ...] = ()
    methods: Annotated[tuple[DesignMethod, ...], MinLen(1)]
    outcomes: Annotated[tuple[str, ...], MinLen(1)]
    trained: Part | None = None
    tested: Part | None = None

    @property
    def letters(self) -> tuple[str, ...]:
        """Letters of the factors."""
        return tuple(factor.letter for factor in self.factors)

    @property
    def parts(self) -> dict[str, Part]:
        """The experiments that it is, by the name of the group of their rows."""
        parts = {TESTED: self.tested, TRAINED: self.trained}
        return {name: part for name, part in parts.items() if part is not None}

    def places(self, name: str, method: str) -> list[tuple[str, str]]:
        """Return the label of the row, and the world its network is tested in, of every cell."""
        cells = [cell_name(cell) for cell in self.cells(name)]
        if name == TESTED:
            return [(f"{method} natural", cell) for cell in cells]
        return [(f"{method} {cell}", "") for cell in cells]

    def cells(self, name: str) -> tuple[Levels, ...]:
        """Return the levels of every cell of a part; the first factor changes most slowly."""
        part = self.parts[name]
        free = self._free_letters(part)
        words: tuple[Level, ...] = ("low", "high")
        cells = []
        for chosen in product(words, repeat=len(free)):
            levels: dict[str, Level] = dict(zip(free, chosen, strict=True))
            for letter, others in part.generators.items():
                levels[letter] = "high" if sign_of(levels, others) > 0 else "low"
            cells.append({letter: levels[letter] for letter in self.letters})
        return tuple(cells)

    def cell_overrides(self, cell: Levels) -> tuple[str, ...]:
        """Return the overrides that make the world of a cell, without those of the design."""
        words: list[str] = []
        for factor in self.factors:
            words += factor.high if cell[factor.letter] == "high" else factor.low
        for combined in self.combined:  # they win
            if combined.levels.items() <= cell.items():
                words += combined.overrides
        return tuple(words)

    def effects(self, part: str) -> dict[str, dict[Effect, int]]:
        """Group main effects and interactions of two factors that have the same contrast.

        In a fraction several effects have the same contrast over the cells ("aliases"): their sum
        is what is estimated.

        Returns:
            name as it is shown -> effects and their signs; an alias with -1 is subtracted.
        """
        cells = self.cells(part)
        effects = [*self.letters, *map("".join, combinations(self.letters, 2))]
        groups: dict[tuple[int, ...], dict[Effect, int]] = {}
        for effect in effects:
            signs = tuple(sign_of(cell, effect) for cell in cells)
            opposite = tuple(-sign for sign in signs)
            if opposite in groups:
                groups[opposite][effect] = -1
            else:
                groups.setdefault(signs, {})[effect] = 1
        names = {factor.letter: factor.name for factor in self.factors}
        found = {}
        for group in groups.values():  # "noise", "occupancy x noise + complexity x size"
            shown = ""
            for effect, sign in group.items():
                shown += " + " if sign > 0 else " - "
                shown += " x ".join(names[letter] for letter in effect)
            found[shown[3:]] = group
        return found

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield the attributes of its rows: of methods in trained cells, then of methods alone."""
        for name, method in product((TRAINED, TESTED), self.methods):
            part = self.parts.get(name)
            if part is None:
                continue
            worlds: dict[str, tuple[str, ...]] = {}
            for cell in self.cells(name):
                worlds[cell_name(cell)] = (*part.overrides, *self.cell_overrides(cell))
            own = worlds if name == TRAINED else {"natural": ()}
            for label, words in own.items():
                yield {
                    "label": f"{method.name} {label}",
                    "group": name,
                    "experiment": method.experiment,
                    "settings": {"method": method.name},
                    "overrides": (*self.overrides, *words, *method.overrides),
                    "tested_in": worlds if name == TESTED else {},
                }

    def _free_letters(self, part: Part) -> list[str]:
        return [letter for letter in self.letters if letter not in part.generators]

    @model_validator(mode="after")
    def _check_names(self) -> Design:
        check_different(self.letters)
        check_different([factor.name for factor in self.factors])
        check_different([method.name for method in self.methods])
        for combined in self.combined:
            for letter in combined.levels:
                check_choice("combined.levels", letter, self.letters)
        earlier: list[str] = []
        for method in self.methods:
            check_choice("methods.experiment", method.experiment, available("experiment"))
            if method.against is not None:
                check_choice("methods.against (an earlier method)", method.against, earlier)
            earlier.append(method.name)
        return self

    @model_validator(mode="after")
    def _check_parts(self) -> Design:
        if not self.parts:
            raise ValueError("expected trained, tested or both, got none.")
        for name, part in self.parts.items():
            free = self._free_letters(part)
            for letter, others in part.generators.items():
                check_choice("generators", letter, self.letters)
                for other in others:
                    check_choice("generators (factors without a generator)", other, free)
            cells = self.cells(name)
            for main, *aliases in map(list, self.effects(name).values()):
                is_constant = len({sign_of(cell, main) for cell in cells}) == 1
                if (len(main) == 1 and aliases) or is_constant:
                    raise ValueError(
                        f"generators: {main} cannot be told apart from "
                        f"{', '.join(aliases) or 'the mean'}; use products of three factors."
                    )
            worlds = set()
            for cell in cells:
                words = [word.partition("=") for word in self.cell_overrides(cell)]
                last = {key: value for key, _, value in words}  # the last value wins
                worlds.add(frozenset(last.items()))
            if len(worlds) < len(cells):
                raise ValueError("two cells have equal overrides; a factor changes nothing.")
        return self


def sign_of(cell: Levels, effect: Effect) -> int:
    """Multiply the signs of the levels of an effect's factors: its sign in a cell."""
    return prod(1 if cell[letter] == "high" else -1 for letter in effect)


def cell_name(cell: Levels) -> str:
    """Return a cell as it is shown: "O-N+"."""
    return "".join(f"{letter}{'+' if level == 'high' else '-'}" for letter, level in cell.items())
