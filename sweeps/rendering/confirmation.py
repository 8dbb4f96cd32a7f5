"""The table of a confirmed search: its best points with further seeds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev

from analysis.uncertainty.verdicts import Verdict
from rgbt.tables import ABSENT, TextTable, number
from sweeps.point import Outcome
from sweeps.rendering.rendered_table import TextCell
from sweeps.verdicts.best_point import ERROR_RATE, Race, Standing
from sweeps.verdicts.judge import CellRunId


@dataclass(frozen=True, kw_only=True)
class Confirmed:
    """The best points of a search after further seeds.

    Attributes:
        found: label of a point -> value of the first objective in the search; best first.
        objectives: their names; the first one is compared.
        maximize: whether a higher value of it is better.
        trials: number of complete trials of the search.
        seeds: that every point may get.
        race: the standings, or why there are none.
        is_over: whether no further run would be made.
    """

    found: Mapping[str, float]
    objectives: tuple[str, ...]
    maximize: bool
    trials: int
    seeds: Sequence[int]
    race: Race | str
    is_over: bool


def confirmation_grid(confirmed: Confirmed, runs: Mapping[CellRunId, Outcome]) -> TextTable:
    """One line per point, the leader first, then by the mean of the first objective.

    Returns:
        columns: point, value of the first objective in the search, number of further seeds, mean ±
        standard deviation (n - 1) of every objective and of the first one on the test split over
        these seeds, difference to the leader with its interval, result, and the number of seeds
        that would decide a difference that is open.
    """
    race = confirmed.race if isinstance(confirmed.race, Race) else None
    scores = {
        label: [
            run.results[0].recorded_scores()
            for (each, _), run in sorted(runs.items())
            if each == label and run.state == "finished" and run.results
        ]
        for label in confirmed.found
    }
    metrics = _metrics(confirmed, [one for each in scores.values() for one in each])
    standings = {each.label: each for each in race.standings} if race else {}
    rows = [
        (
            label,
            number(confirmed.found[label]),
            str(len(scores[label])),
            *(_mean(scores[label], metric) for metric in metrics),
            *_difference(standings.get(label)),
            _result(standings.get(label), race),
            _needed(standings.get(label), race),
        )
        for label in _order(confirmed, scores, race)
    ]
    interval = "interval" if race is None else f"{100 * race.level:.4g} % interval"
    header = (
        *("point", "in the search", "further seeds", *metrics, "difference"),
        *(interval, "result", "would decide"),
    )
    title = f"Confirmation of the best {len(confirmed.found)} of {confirmed.trials} trials"
    return TextTable(title, header, tuple(rows), _notes(confirmed, race, metrics))


def conclusion(confirmed: Confirmed) -> str:
    """Whether the best point is confirmed, in one or two sentences."""
    race = confirmed.race
    if isinstance(race, str):
        return f"Not confirmed: {race}"
    if race.is_decided:
        others = len(race.standings) - 1
        than = "the other point" if others == 1 else f"each of the other {others} points"
        return f"Confirmed: {race.leader} is better than {than}."
    if not confirmed.is_over:
        return "Not confirmed yet: further runs are needed; rerun the command to resume."
    failed = [each for each in race.standings if each.reason and not each.worse_than]
    if failed:
        return (
            f"Not confirmed: of {failed[0].label}, {failed[0].reason} "
            "(hydra.sweeper.retries=1 retries it)."
        )
    if race.obstacle:
        return f"Not confirmed: {race.obstacle[0].lower()}{race.obstacle[1:]}"
    left = ", ".join(number_of(label) for label in race.open)
    reason = race.contenders[0].reason if race.contenders else ""
    return (
        f"Not confirmed: {len(confirmed.seeds)} seeds do not show which of {left} is the best. "
        f"{reason} Choose any of them, or set a larger hydra.sweeper.confirm.max_seeds."
    )


def number_of(label: str) -> str:
    """The trial of a label: "#12" of "#12 sigma_div=4.12"."""
    return label.partition(" ")[0]


def _metrics(confirmed: Confirmed, scores: Sequence[Mapping[str, float]]) -> list[str]:
    """Objectives, and the first one on the test split where all runs have it."""
    first = confirmed.objectives[0].partition("/")[2]
    test = f"test/{first}"
    is_known = bool(scores) and all(test in each for each in scores)
    return list(dict.fromkeys([*confirmed.objectives, *([test] if is_known else [])]))


def _order(
    confirmed: Confirmed,
    scores: Mapping[str, Sequence[Mapping[str, float]]],
    race: Race | None,
) -> list[str]:
    sign = -1.0 if confirmed.maximize else 1.0
    first = confirmed.objectives[0]

    def rank(label: str) -> tuple[bool, float]:
        values = [each[first] for each in scores[label] if first in each]
        mean = sign * fmean(values) if values else math.inf
        return race is None or label != race.leader, mean

    return sorted(confirmed.found, key=rank)


def _mean(scores: Sequence[Mapping[str, float]], metric: str) -> str:
    values = [each[metric] for each in scores if metric in each]
    if not values:
        return ABSENT
    return TextCell(number(fmean(values)), number(stdev(values)) if len(values) > 1 else "").whole


def _difference(standing: Standing | None) -> tuple[str, str]:
    found: Verdict | None = standing.difference if standing else None
    if found is None:
        return ABSENT, ABSENT
    ends = found.interval
    shown = ABSENT if ends is None else f"[{ends.low:+.2f}, {ends.high:+.2f}]"
    return f"{found.estimate:+.2f}", shown


def _result(standing: Standing | None, race: Race | None) -> str:
    if standing is None or race is None:
        return ABSENT
    if standing.worse_than:
        return f"worse than {number_of(standing.worse_than)}"
    if standing.reason:
        return "failed"
    return "best" if race.is_decided else "undecided"


def _needed(standing: Standing | None, race: Race | None) -> str:
    found = standing.difference if standing and not standing.worse_than else None
    if found is None or race is None or math.isnan(found.seeds_needed):
        return ABSENT
    return "never" if math.isinf(found.seeds_needed) else f"{found.seeds_needed:.0f}"


def _notes(confirmed: Confirmed, race: Race | None, metrics: Sequence[str]) -> tuple[str, ...]:
    first = confirmed.objectives[0]
    seeds = f"{confirmed.seeds[0]} to {confirmed.seeds[-1]}"
    notes = [conclusion(confirmed)]
    notes.append(
        f"Means are over further seeds ({seeds} at most), which the search has not used. The "
        "values in the search are too good, because it chose the best of many."
    )
    if race is not None:
        notes.append(
            "difference: to the first point, over paired seeds; its interval covers seeds and "
            "images and is valid after any number of seeds. The best point is called worse in at "
            f"most {100 * ERROR_RATE:g} % of searches."
        )
    if f"test/{first.partition('/')[2]}" in metrics and not first.startswith("test/"):
        notes.append(
            f"The points were chosen by the images of {first}, which favour them; images of the "
            "test split had no part in it."
        )
    return tuple(notes)
