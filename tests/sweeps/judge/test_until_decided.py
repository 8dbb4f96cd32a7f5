"""Seeds are added to the rows of undecided claims, and to no others."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sweeps.judge.judged_table import JudgedTable
from sweeps.judge.until_decided import START, SeedsUntilDecided
from sweeps.plan.claim import Claim
from sweeps.plan.request import TableRequest, seed_of
from sweeps.plan.table import Row
from sweeps.point import Outcome, Point
from tests.sweeps.judge.accuracies import accuracy
from tests.sweeps.tabled import outcome, table

MEANS = {"ours": 80.0, "base": 60.0, "twin": 60.0, "other": 50.0}
"""Of two rows with one mean, neither is better."""

MAX = 6
DECIDED = 4
"""Seeds after which a clear claim is decided: no interval at any time has fewer."""


def claim(name: str, row: str, against: str) -> Claim:
    about: Any = {"says": "One is better.", "source": "Sec. I", "expected": "higher"}
    return Claim(name=name, rows=(row,), against=(against,), columns=("acc",), **about)


TRUE, FALSE = claim("true", "ours", "base"), claim("false", "base", "ours")
OPEN = claim("open", "twin", "base")


def adding(*claims: Claim, max_seeds: int = MAX) -> SeedsUntilDecided:
    rows = tuple(Row(label=label, experiment="crm", overrides=(f"row={label}",)) for label in MEANS)
    request = TableRequest(
        "own/t", table(rows, claims=claims), "demo", tuple(range(START)), until_decided=True
    )
    return SeedsUntilDecided(JudgedTable(request=request, resamples=200), max_seeds)


def row_of(point: Point) -> str:
    (word,) = (word for word in point.overrides if word.startswith("row="))
    return word.removeprefix("row=")


def finished(points: Sequence[Point]) -> list[Outcome]:
    """Accuracies about the mean of the row; the noise of a seed is the row's own."""
    found = []
    for point in points:
        row, seed = row_of(point), seed_of(point.overrides)
        noise = np.random.default_rng([zlib.crc32(row.encode()), seed]).normal(0.0, 0.5)
        made = outcome(f"{row} {seed}", accuracy(MEANS[row] + noise, seed))
        found.append(replace(made, point=point))
    return found


def seeds(outcomes: Sequence[Outcome]) -> dict[str, int]:
    return dict(Counter(row_of(outcome.point) for outcome in outcomes))


def complete(
    until: SeedsUntilDecided,
    before: Sequence[Outcome] = (),
    finish: Callable[[Sequence[Point]], list[Outcome]] = finished,
) -> list[Outcome]:
    """All outcomes, with every added point run."""
    outcomes = list(before) or finish(until.judged.request.points())
    while further := until(outcomes):
        outcomes += finish(further)
    return outcomes


def test_rows_of_decided_claims_get_no_more_seeds() -> None:
    expected = {"ours": DECIDED, "base": DECIDED, "twin": START, "other": START}
    assert seeds(complete(adding(TRUE, FALSE))) == expected


def test_rows_of_undecided_claims_get_seeds_up_to_maximum() -> None:
    until = adding(TRUE, OPEN)
    outcomes = complete(until)
    assert seeds(outcomes) == {"ours": DECIDED, "base": MAX, "twin": MAX, "other": START}
    _, found = replace(until.judged, runs=until.judged.request.runs(outcomes)).claims
    assert (found.word, found.verdict and found.verdict.seeds) == ("not shown", MAX)


def test_added_points_have_one_seed_that_is_not_declared() -> None:
    until = adding(OPEN)
    further = until(finished(until.judged.request.points()))
    assert [(row_of(point), seed_of(point.overrides)) for point in further] == [
        ("base", START),
        ("twin", START),
    ]
    request = until.judged.request
    declaring = replace(request, table=replace(request.table, confirm=(START, START + 1)))
    until = replace(until, judged=replace(until.judged, request=declaring))
    further = until(finished(declaring.points()))
    assert {seed_of(point.overrides) for point in further} == {START + 2}


def test_at_most_two_seeds_of_a_claim_are_unfinished() -> None:
    until = adding(OPEN)
    outcomes = finished(until.judged.request.points())
    further = until(outcomes)
    first, second = finished(further)
    outcomes += [first, Outcome(second.point, "running")]
    ahead = until(outcomes)
    assert {seed_of(point.overrides) for point in ahead} == {START + 1}, "a slot is not left idle"
    one, other = finished(ahead)
    outcomes += [one, Outcome(other.point, "running")]
    assert until(outcomes) == [], "two seeds of the claim are unfinished"


def test_claim_with_a_failed_row_is_not_extended() -> None:
    def failing(points: Sequence[Point]) -> list[Outcome]:
        twins = [point for point in points if row_of(point) == "twin"]
        others = [point for point in points if point not in twins]
        return [*finished(others), *(Outcome(point, "failed", "no memory") for point in twins)]

    assert seeds(complete(adding(OPEN), finish=failing)) == dict.fromkeys(MEANS, START)

    def later(points: Sequence[Point]) -> list[Outcome]:
        return failing(points) if seed_of(points[0].overrides) == START else finished(points)

    assert seeds(complete(adding(OPEN), finish=later))["twin"] == START + 1
