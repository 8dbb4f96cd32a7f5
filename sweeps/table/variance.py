"""Rows of a table that measure how far scores vary, by source of the random draws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar


@dataclass(frozen=True, kw_only=True)
class Variance:
    """Which rows measure which source; `rgbt reproduce` prints the variance budget of them.

    Attributes:
        column: the score, by the name of its column.
        sources: source -> label of the row whose runs differ in this source alone (``seeds``).
        all: label of the row whose runs differ in all sources.
        against: label of a row of another method; the standard deviation of paired differences is
            that of `all` minus this row, seed by seed. None: it is computed from `all`, as if
            paired runs had nothing in common.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid", "allow_inf_nan": False}

    column: str
    sources: Mapping[str, str]
    all: str
    against: str | None = None

    @property
    def labels(self) -> tuple[str, ...]:
        """The rows that it names."""
        return (*self.sources.values(), self.all, *([self.against] if self.against else []))
