"""Declared comparisons of two groups of runs, with intervals over images and seeds.

They are about groups that no table compares; what papers state about their tables are claims.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from analysis.report.data import ContrastEntry
from analysis.report.results_file import Contrast
from analysis.report.runs import ReportRun
from analysis.report.tables import Track
from analysis.uncertainty import Comparison, Difference, Resampling, compare
from analysis.uncertainty.verdicts import FixedSeeds, decide
from rgbt.checks import InputError
from rgbt.metrics import names
from rgbt.metrics.named import parse

Settings = tuple[str, ...]
"""Scale, split, partition and data set: runs that differ in one of them are not compared."""

SCALE_WORD = re.compile(r" ?\bscale=\w+")


def contrast_entries(
    declared: Sequence[Contrast], runs: Iterable[ReportRun], resamples: int, track: Track
) -> tuple[ContrastEntry, ...]:
    """Every declared comparison, one entry per metric, scale and data set.

    Args:
        declared: as in `results.yaml`.
        runs: of the store.
        resamples: of the images, for intervals and p-values.
        track: shows how far it is.
    """
    groups: dict[str, dict[Settings, list[ReportRun]]] = {}
    for run in runs:
        if run.test_counts is not None:
            entry = run.entry
            settings = (entry.scale, entry.split, entry.partition, entry.dataset)
            group = groups.setdefault(SCALE_WORD.sub("", entry.group), {})
            group.setdefault(settings, []).append(run)
    entries: list[ContrastEntry] = []
    for contrast in track(declared, "comparisons"):
        entries += _entries(contrast, groups, Resampling(resamples=resamples))
    return tuple(entries)


def _entries(
    contrast: Contrast,
    groups: Mapping[str, Mapping[Settings, Sequence[ReportRun]]],
    resampling: Resampling,
) -> Iterator[ContrastEntry]:
    reference, method = (groups.get(name, {}) for name in (contrast.reference, contrast.method))
    blank = [_blank(contrast, metric) for metric in contrast.expected]
    shared = [settings for settings in reference if settings in method]
    if not shared:
        missing = contrast.method if reference else contrast.reference
        yield from (replace(each, verdict=f"Not run: {missing}.") for each in blank)
    for settings in sorted(shared):
        sides = reference[settings], method[settings]
        at_scale = [replace(each, scale=settings[0]) for each in blank]
        try:
            a, b = ([run.counts(contrast.counts) for run in side] for side in _same_seeds(*sides))
            as_run = replace(resampling, absent=sides[0][0].absent)
            found = compare(a, b, list(contrast.expected), as_run, paired=True)
        except InputError as error:
            yield from (replace(each, verdict=f"Not measured: {error}") for each in at_scale)
            continue
        pairs = zip(at_scale, found.differences, strict=True)
        yield from (_measured(entry, each, found) for entry, each in pairs)


def _blank(contrast: Contrast, metric: str) -> ContrastEntry:
    words = [f"a={contrast.reference}", f"b={contrast.method}", f"metrics={metric}"]
    words += contrast.options.split()
    return ContrastEntry(
        question=contrast.question,
        source=contrast.source,
        reference=contrast.reference,
        method=contrast.method,
        metric=metric,
        expected=contrast.expected[metric],
        verdict="",
        command=shlex.join(["rgbt", "compare", *words]),
    )


def _same_seeds(*sides: Sequence[ReportRun]) -> list[list[ReportRun]]:
    """The runs of the seeds that both sides have: these share initial weights and data order.

    Raises:
        InputError: there is no such seed.
    """
    by_seed = [{run.entry.seed: run for run in side} for side in sides]
    common = set.intersection(*map(set, by_seed))
    shared = sorted(seed for seed in common if seed is not None)
    if not shared:
        seeds = (", ".join(map(str, runs)) for runs in by_seed)
        raise InputError(f"the runs have no seed in common: {' and '.join(seeds)}.")
    return [[runs[seed] for seed in shared] for runs in by_seed]


def _measured(entry: ContrastEntry, each: Difference, found: Comparison) -> ContrastEntry:
    interval = each.interval
    return replace(
        entry,
        values=(each.a.value, each.b.value),
        seeds=(each.a.seeds, each.b.seeds),
        difference=each.value,
        low=None if interval is None else interval.low,
        high=None if interval is None else interval.high,
        covers="images and seeds" if each.difference.both else "images" if interval else "none",
        p=each.difference.p,
        verdict=verdict(each, entry.expected, found.level),
    )


def verdict(found: Difference, expected: str, level: float) -> str:
    """Whether the data shows what was expected: holds, contradicted, or undecided with the reason.

    Args:
        found: method less reference, paired by seed.
        expected: "higher" or "lower".
        level: of the interval.
    """
    if found.interval is None:
        return "Undecided: there is nothing to score."
    wanted = (0.0, math.inf) if expected == "higher" else (-math.inf, 0.0)
    decided = decide([found.difference.evidence], wanted, FixedSeeds(level=level), "all")
    if decided.kind != "undecided":
        return f"{decided.kind.capitalize()}."
    if decided.seeds < 2:
        return "Undecided: both methods need two seeds or more."
    unit = "" if parse(found.metric).score == names.VAR else " points"
    return (
        f"Undecided: with these seeds and images, a difference below {decided.smallest:.2f}{unit} "
        f"cannot be shown. {_needed(decided.seeds_needed)}"
    )


def _needed(seeds: float) -> str:
    if math.isinf(seeds):
        return "These images leave it open with any number of seeds."
    return f"About {seeds:.0f} seeds would show the present difference."
