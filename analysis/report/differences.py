"""Paper against release: what differs, and what it does where the store holds both sides."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from analysis.report.data import DifferenceEntry
from analysis.report.runs import Run
from analysis.report.tables_intervals import Track
from analysis.uncertainty import Comparison, Difference, Resampling, compare
from rgbt.checks import InputError
from rgbt.files.yaml_files import read_yaml
from rgbt.metrics import names
from rgbt.spec.run_spec import NOT_IN_KEY

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

    def told(self) -> str:
        """Setting and sentence."""
        return self.text if self.setting is None else f"{self.setting}: {self.text}"


@dataclass(frozen=True)
class Choice:
    """One entry of `FILE`."""

    topic: str
    source: str
    base: tuple[str, ...]
    paper: Side
    released: Side

    def command(self) -> str:
        """The grid that makes runs of both sides."""
        key, _, first = str(self.paper.setting).partition("=")
        second = str(self.released.setting).partition("=")[2]
        words = ["python", "-m", "rgbt.run", "-m", *self.base, f"{key}={first},{second}", SEEDS]
        return shlex.join(words)


@dataclass(frozen=True)
class Pair:
    """Runs that differ by one choice and their seeds alone."""

    paper: tuple[Run, ...]
    released: tuple[Run, ...]


def load_choices(path: Path = FILE) -> tuple[Choice, ...]:
    """The entries of `FILE`, which is part of the package."""
    return tuple(
        Choice(
            topic=entry["topic"],
            source=entry["source"],
            base=tuple(entry["base"]),
            paper=Side(**entry["paper"]),
            released=Side(**entry["released"]),
        )
        for entry in read_yaml(path)
    )


def difference_entries(
    runs: Iterable[Run], resamples: int, track: Track
) -> tuple[DifferenceEntry, ...]:
    """Every difference with its effect.

    Args:
        runs: of the store.
        resamples: of the images, for intervals and p-values.
        track: shows how far it is.
    """
    scored = [run for run in runs if run.counts is not None and run.config]
    settings = Resampling(resamples=resamples)
    return tuple(
        _entry(choice, find_pairs(choice, scored), settings)
        for choice in track(load_choices(), "paper against release")
    )


def find_pairs(choice: Choice, runs: Iterable[Run]) -> list[Pair]:
    """Runs that differ by `choice` alone, those with the most seeds first."""
    keys = {*choice.paper.values, *choice.released.values}
    groups: dict[str, tuple[list[Run], list[Run]]] = {}
    for run in runs:
        sides = [_is_side(run.config, side) for side in (choice.paper, choice.released)]
        if any(sides):
            group = groups.setdefault(_rest(run, keys), ([], []))
            group[sides.index(True)].append(run)
    pairs = [
        Pair(_by_seed(paper), _by_seed(released))
        for paper, released in groups.values()
        if paper and released
    ]
    return sorted(pairs, key=lambda pair: -min(len(pair.paper), len(pair.released)))


def _is_side(config: Mapping[str, Any], side: Side) -> bool:
    return side.setting is not None and all(
        key in config and config[key] == value for key, value in side.values.items()
    )


def _rest(run: Run, keys: set[str]) -> str:
    """All else that makes the run what it is: configuration and images."""
    assert run.counts is not None, "only runs with counts are compared"
    left_out = (*NOT_IN_KEY, "seed")
    same = {
        key: _number(value)
        for key, value in run.config.items()
        if key not in keys and not any(key == out or key.startswith(f"{out}.") for out in left_out)
    }
    images = [run.counts.dataset, run.counts.partition, run.counts.split]
    return json.dumps([images, same], sort_keys=True, default=str)


def _number(value: Any) -> Any:
    """4 and 4.0 are one value."""
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _by_seed(runs: Sequence[Run]) -> tuple[Run, ...]:
    return tuple(sorted(runs, key=lambda run: (run.entry.seed is None, run.entry.seed or 0)))


def _entry(choice: Choice, pairs: Sequence[Pair], settings: Resampling) -> DifferenceEntry:
    runs = [run.entry.key for pair in pairs[:1] for run in (*pair.paper, *pair.released)]
    return DifferenceEntry(
        topic=choice.topic,
        paper=choice.paper.told(),
        released=choice.released.told(),
        source=choice.source,
        effect=_effect(choice, pairs, settings),
        runs=tuple(runs),
    )


def _effect(choice: Choice, pairs: Sequence[Pair], settings: Resampling) -> str:
    if choice.released.setting is None:
        return "Cannot be compared: one side alone can be run."
    if not pairs:
        return f"No two runs differ by this alone; these would: {choice.command()}"
    best, others = pairs[0], len(pairs) - 1
    # Both sides score alike: `metric.absent` is part of what must be equal.
    asked = Resampling(resamples=settings.resamples, absent=best.paper[0].absent)
    try:
        compared = compare(_counts(best.paper), _counts(best.released), METRICS, asked)
    except InputError as error:
        return f"Runs of both sides cannot be compared: {error}"
    more = f" {others} more pair{'s' * (others > 1)} of runs differ by it." if others else ""
    return sentence(best, compared) + more


def _counts(runs: Sequence[Run]) -> list[Any]:
    return [run.counts for run in runs]


def sentence(pair: Pair, compared: Comparison) -> str:
    """Released less paper in every score, with intervals and p-values."""
    counts = (len(pair.released), len(pair.paper))
    over = "images and seeds" if all(each.both for each in compared.differences) else "images"
    shown = "; ".join(_shown(each) for each in compared.differences)
    seeds = " against ".join(f"{count} seed{'s' * (count > 1)}" for count in counts)
    return (
        f"Released less paper: {shown} ({pair.paper[0].entry.group}; {seeds}; "
        f"{100 * compared.level:g} % intervals over {over}, {compared.said}; p not corrected for "
        "the number of comparisons)."
    )


def _shown(each: Difference) -> str:
    value = f"{each.metric} {each.value:+.2f}"
    if each.interval is None:
        return value
    return f"{value} [{each.interval.low:+.2f}, {each.interval.high:+.2f}], p = {each.p:.2g}"
