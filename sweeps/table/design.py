"""A factorial design in a table file: factors of two levels, methods, and outcomes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import chain, combinations, product
from math import prod
from typing import Any, ClassVar, Literal

Level = Literal["low", "high"]
Levels = Mapping[str, Level]
"""Letter of each factor -> its level."""

SIGNS: dict[Level, int] = {"low": -1, "high": 1}

STRICT: dict[str, Any] = {"extra": "forbid", "allow_inf_nan": False}


@dataclass(frozen=True, kw_only=True)
class DesignFactor:
    """A factor that is switched alone.

    Attributes:
        letter: one capital letter, e.g. "N".
        name: one or two words, e.g. "noise".
        low: overrides of the low level.
        high: overrides of the high level.
        low_means: what the low level is, for readers.
        high_means: what the high level is.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    letter: str
    name: str
    low: tuple[str, ...] = ()
    high: tuple[str, ...] = ()
    low_means: str
    high_means: str


@dataclass(frozen=True, kw_only=True)
class Combined:
    """Overrides of the cells in which several factors have given levels.

    Attributes:
        levels: level of two factors or more.
        overrides: they win over those of the factors.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    levels: Levels
    overrides: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class DesignMethod:
    """A method that is trained.

    Attributes:
        name: first word of its rows.
        experiment: a file of ``conf/experiment``.
        overrides: at every scale.
        against: name of an earlier method that its effects are compared with; None: of none.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    name: str
    experiment: str
    overrides: tuple[str, ...] = ()
    against: str | None = None


@dataclass(frozen=True, kw_only=True)
class Part:
    """One of the two experiments that a design can be.

    Attributes:
        overrides: of every cell of this part, after those of the design.
        generators: letter of a factor -> letters of others whose product is its level, as
            {S: OCN}; each halves the number of cells. Empty: all combinations.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    overrides: tuple[str, ...] = ()
    generators: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Design:
    """A two-level factorial design.

    Attributes:
        factors: two or more, in order.
        combined: settings that depend on several factors.
        overrides: of every run and cell, e.g. the data set.
        methods: in order.
        outcomes: names of columns whose effects are estimated.
        trained: each method is trained and tested in each cell; None: not offered.
        tested: each method is trained once, without any factor, and tested in each cell; None: not
            offered.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    factors: tuple[DesignFactor, ...]
    combined: tuple[Combined, ...] = ()
    overrides: tuple[str, ...] = ()
    methods: tuple[DesignMethod, ...]
    outcomes: tuple[str, ...]
    trained: Part | None = None
    tested: Part | None = None

    @property
    def letters(self) -> tuple[str, ...]:
        """Letters of the factors."""
        return tuple(factor.letter for factor in self.factors)

    def cells(self, part: Part) -> tuple[Levels, ...]:
        """Levels of every cell of a part; the first factor changes most slowly.

        Examples:
            Two factors and a third with ``generators: {C: AB}`` have the cells A- B- C+, A- B+ C-,
            A+ B- C-, A+ B+ C+.
        """
        free = [letter for letter in self.letters if letter not in part.generators]
        words: tuple[Level, ...] = ("low", "high")
        cells = []
        for chosen in product(words, repeat=len(free)):
            levels: dict[str, Level] = dict(zip(free, chosen, strict=True))
            for letter, others in part.generators.items():
                levels[letter] = "high" if sign_of(levels, others) > 0 else "low"
            cells.append({letter: levels[letter] for letter in self.letters})
        return tuple(cells)

    def cell_overrides(self, cell: Levels) -> tuple[str, ...]:
        """Overrides that make the world of a cell, without those of the whole design."""
        words = [
            word
            for factor in self.factors
            for word in (factor.high if cell[factor.letter] == "high" else factor.low)
        ]
        words += [
            word
            for each in self.combined
            if all(cell[letter] == level for letter, level in each.levels.items())
            for word in each.overrides
        ]
        return tuple(words)

    def effects(self, part: Part) -> dict[str, dict[Effect, int]]:
        """Shown name -> main effects and interactions of two factors with that contrast, and signs.

        In a fraction several effects have the same contrast over the cells ("aliases"): their sum
        is what is estimated. An alias with the sign -1 is subtracted.
        """
        cells = self.cells(part)
        names = {factor.letter: factor.name for factor in self.factors}
        groups: dict[tuple[int, ...], dict[Effect, int]] = {}
        orders = (combinations(self.letters, order) for order in (1, 2))
        for effect in map("".join, chain(*orders)):
            signs = tuple(sign_of(cell, effect) for cell in cells)
            opposite = tuple(-sign for sign in signs)
            if opposite in groups:
                groups[opposite][effect] = -1
            else:
                groups.setdefault(signs, {})[effect] = 1
        return {_shown(group, names): group for group in groups.values()}


Effect = str
"""Letters of the factors: "N" a main effect, "ON" an interaction."""


def sign_of(cell: Levels, effect: Effect) -> int:
    """The sign of a cell in the contrast of an effect: the product of the signs of its factors."""
    return prod(SIGNS[cell[letter]] for letter in effect)


def cell_name(cell: Levels) -> str:
    """The cell as it is shown.

    Examples:
        >>> cell_name({"O": "low", "N": "high"})
        'O-N+'
    """
    return "".join(f"{letter}{'+' if level == 'high' else '-'}" for letter, level in cell.items())


def _shown(group: Mapping[Effect, int], names: Mapping[str, str]) -> str:
    """The effects of a contrast: "noise", "occupancy x noise + complexity x size"."""
    text = ""
    for effect, sign in group.items():
        joint = " + " if sign > 0 else " - "
        text += (joint if text else "") + " x ".join(names[letter] for letter in effect)
    return text
