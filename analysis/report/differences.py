"""Paper against release: the differences, and their effect where the store has both sides."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from analysis.report.data import DifferenceEntry
from analysis.report.runs import ReportRun
from analysis.report.tables import Track
from analysis.uncertainty import Comparison, Resampling, compare
from rgbt.checks import InputError
from rgbt.files.yaml_files import read_yaml
from rgbt.metrics import names
from rgbt.runs.run_spec import NOT_IN_KEY

FILE = Path(__file__).with_name("differences.yaml")
METRICS = (names.MIOU, names.VAR)
SEEDS = "seed=0,1,2"
"""Of the command that makes what is missing."""


@dataclass(frozen=True)
class Side:
    """One of the two ways: its override, the keys that it sets, and what it means."""

    setting: str | None
    values: Mapping[str, Any]
    text: str


@dataclass(frozen=True)
class Choice:
    """One entry of `FILE`."""

    topic: str
    source: str
    base: tuple[str, ...]
    paper: Side
    released: Side


@dataclass(frozen=True)
class PairedRuns:
    """Runs that differ only in one choice and in their seeds."""

    paper: tuple[ReportRun, ...]
    released: tuple[ReportRun, ...]


def load_choices(path: Path = FILE) -> tuple[Choice, ...]:
    """The entries of `FILE`, which is part of the package."""
    sides = ("paper", "released")
    return tuple(
        Choice(**{**entry, "base": tuple(entry["base"]), **{s: Side(**entry[s]) for s in sides}})
        for entry in read_yaml(path)
    )


def difference_entries(
    runs: Iterable[ReportRun], resamples: int, track: Track
) -> tuple[DifferenceEntry, ...]:
    """Every difference with its effect.

    Args:
        runs: of the store.
        resamples: of the images, for intervals and p-values.
        track: shows how far it is.
    """
    scored = [run for run in runs if run.test_counts is not None and run.config]
    settings = Resampling(resamples=resamples)
    entries = []
    for choice in track(load_choices(), "paper against release"):
        pairs = find_pairs(choice, scored)
        sides = [
            f"{side.setting}: {side.text}" if side.setting else side.text
            for side in (choice.paper, choice.released)
        ]
        compared = [run.entry.key for pair in pairs[:1] for run in (*pair.paper, *pair.released)]
        entry = DifferenceEntry(
            topic=choice.topic,
            paper=sides[0],
            released=sides[1],
            source=choice.source,
            effect=_effect(choice, pairs, settings),
            runs=tuple(compared),
        )
        entries.append(entry)
    return tuple(entries)


def find_pairs(choice: Choice, runs: Iterable[ReportRun]) -> list[PairedRuns]:
    """Runs that differ only in `choice`, those with the most seeds first."""
    keys = {*choice.paper.values, *choice.released.values}
    groups: dict[str, tuple[list[ReportRun], list[ReportRun]]] = {}
    for run in runs:
        sides = [
            side.setting is not None
            and all(key in run.config and run.config[key] == v for key, v in side.values.items())
            for side in (choice.paper, choice.released)
        ]
        if any(sides):
            group = groups.setdefault(_rest(run, keys), ([], []))
            group[sides.index(True)].append(run)
    pairs = [
        PairedRuns(_by_seed(paper), _by_seed(released))
        for paper, released in groups.values()
        if paper and released
    ]
    return sorted(pairs, key=lambda pair: -min(len(pair.paper), len(pair.released)))


def _rest(run: ReportRun, keys: set[str]) -> str:
    """All other properties of a run: configuration and images."""
    assert run.test_counts is not None, "only runs with counts are compared"
    left_out = (*NOT_IN_KEY, "seed")
    same = {
        # 4 and 4.0 are one value.
        key: float(value) if type(value) is int else value
        for key, value in run.config.items()
        if key not in keys and not any(key == out or key.startswith(f"{out}.") for out in left_out)
    }
    images = [run.test_counts.dataset, run.test_counts.partition, run.test_counts.split]
    return json.dumps([images, same], sort_keys=True, default=str)


def _by_seed(runs: Sequence[ReportRun]) -> tuple[ReportRun, ...]:
    return tuple(sorted(runs, key=lambda run: (run.entry.seed is None, run.entry.seed or 0)))


def _effect(choice: Choice, pairs: Sequence[PairedRuns], settings: Resampling) -> str:
    if choice.released.setting is None:
        return "Cannot be compared: only one side can be run."
    if not pairs:
        key, _, first = str(choice.paper.setting).partition("=")
        both = f"{key}={first},{choice.released.setting.partition('=')[2]}"
        words = shlex.join(["python", "-m", "rgbt.run", "-m", *choice.base, both, SEEDS])
        return f"No two runs differ only in this setting. Runs that would: {words}"
    best, others = pairs[0], len(pairs) - 1
    # Both sides score alike: `metric.absent` is part of what must be equal.
    as_run = Resampling(resamples=settings.resamples, absent=best.paper[0].absent)
    try:
        sides = [[run.counts() for run in side] for side in (best.paper, best.released)]
        compared = compare(sides[0], sides[1], METRICS, as_run)
    except InputError as error:
        return f"Runs of both sides cannot be compared: {error}"
    more = f" {others} more pair{'s' * (others > 1)} of runs differ by it." if others else ""
    return sentence(best, compared) + more


def sentence(pair: PairedRuns, compared: Comparison) -> str:
    """Released minus paper in every score, with intervals and p-values."""
    over = (
        "images and seeds"
        if all(each.difference.both for each in compared.differences)
        else "images"
    )
    shown = []
    for each in compared.differences:
        text = f"{each.metric} {each.value:+.2f}"
        if each.interval is not None:
            low, high = each.interval.low, each.interval.high
            text += f" [{low:+.2f}, {high:+.2f}], p = {each.difference.p:.2g}"
        shown.append(text)
    counts = (len(pair.released), len(pair.paper))
    seeds = " against ".join(f"{count} seed{'s' * (count > 1)}" for count in counts)
    return (
        f"Released minus paper: {'; '.join(shown)} ({pair.paper[0].entry.group}; {seeds}; "
        f"{100 * compared.level:g} % intervals over {over}, {compared.said}; p not corrected for "
        "the number of comparisons)."
    )
