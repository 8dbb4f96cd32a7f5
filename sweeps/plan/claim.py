"""What a paper says about its table, as a contrast of rows with an expected direction."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, TypeVar

from pydantic import model_validator

Expected = Literal["higher", "lower", "similar"]
Combine = Literal["all", "most", "any", "mean"]

OTHERS = "others"  # word in `Claim.against`: every other row that has a score or a printed value
PREVIOUS = "previous"  # word in `Claim.against`: the row before in `Claim.rows`

Unique = TypeVar("Unique", bound=Sequence[object])
Range = tuple[float, float]
# Ranges of a difference whose size does not matter.
HIGHER: Range = (0.0, math.inf)
LOWER: Range = (-math.inf, 0.0)


class Strict:
    """A part of a table file: unknown keys, NaN and infinity are refused."""

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid", "allow_inf_nan": False}


def check_different(names: Unique) -> Unique:
    """Return names or numbers of which none is used twice; ValueError otherwise."""
    for index, name in enumerate(names):
        if name in names[:index]:
            raise ValueError(f"'{name}' is used twice.")
    return names


@dataclass(frozen=True, kw_only=True)
class Claim(Strict):
    """One statement of a paper about its own table.

    It is a set of contrasts: each row of `rows` minus each row of `against`, in each column. A
    contrast without `against` is the score itself, or with `minus_column` the difference of two
    scores of one row. With both it is the difference of two differences.

    Attributes:
        says: the statement in our words, one sentence; `source` is its place in the paper.
        rows: labels of the rows that the statement is about; with against: previous, in order.
        against: labels of the rows that they are compared with; "others" or "previous" alone.
        minus_column: a column that is subtracted from each of `columns`.
        at_least: smallest size of the difference that the statement means; below 0 for "not worse
            by more than".
        at_most: largest size, e.g. of a "small improvement".
        effect: letters of the factors of the table's design; the claim is then about that effect
            on the outcomes `columns`, by the methods `rows`.
        part: of an effect, "trained" or "tested"; default: tested, if the design has that.
        exploratory: made after a result was seen: the seeds of `Table.confirm` do not judge it.
        combine: "all": each contrast is as expected; "most": more than half of them; "any": one of
            them; "mean": their mean is.
        remarks: one sentence each, e.g. why the direction is a reading of ours.
    """

    name: str
    says: str
    source: str
    rows: tuple[str, ...]
    against: tuple[str, ...] = ()
    columns: tuple[str, ...]
    minus_column: str | None = None
    expected: Expected
    at_least: float = 0.0
    at_most: float | None = None
    effect: str = ""
    part: str = ""
    combine: Combine = "all"
    exploratory: bool = False
    remarks: tuple[str, ...] = ()

    @property
    def direction(self) -> Range:
        """Open range of a contrast in the direction that is claimed.

        The margin of "alike", or of "not worse by more than", belongs to the direction. Other
        bounds are of the size, see `range`.
        """
        if self.expected == "similar" or self.at_least < 0:
            return self.range
        return HIGHER if self.expected == "higher" else LOWER

    @property
    def range(self) -> Range:
        """Open range of a contrast that is as claimed, its size too."""
        most = math.inf if self.at_most is None else self.at_most
        if self.expected == "similar":
            return -most, most
        return (self.at_least, most) if self.expected == "higher" else (-most, -self.at_least)

    def pairs(self, labels: Sequence[str]) -> Iterator[tuple[str, str | None]]:
        """Yield rows of a column with the rows that are subtracted from them, or None.

        `labels` are the rows that `OTHERS` means.
        """
        if self.against == (PREVIOUS,):
            yield from zip(self.rows[1:], self.rows[:-1], strict=True)
            return
        against = tuple(labels) if self.against == (OTHERS,) else self.against
        for row in self.rows:
            if not against:
                yield row, None
            for other in against:
                if other != row:
                    yield row, other

    @model_validator(mode="after")
    def _check(self) -> Claim:
        if self.expected == "similar" and self.at_most is None:
            raise ValueError("similar needs at_most, the largest difference that it means.")
        if self.at_most is not None and self.at_most <= self.at_least:
            raise ValueError(f"at_most must be above at_least ({self.at_least:g}).")
        if self.effect and (self.against or self.minus_column or self.combine == "mean"):
            raise ValueError("an effect has no against, minus_column or mean.")
        return self
