"""Declared comparisons of two groups of runs, with intervals over images and seeds."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from analysis.report.data import ContrastEntry
from analysis.report.results_file import Contrast, load_results_file
from analysis.report.runs import ReportRun
from analysis.report.tables import Track
from analysis.uncertainty import Comparison, Difference, Resampling, compare
from rgbt.checks import InputError
from rgbt.metrics import names
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import parse

Settings = tuple[str, ...]
"""Scale, split, partition and data set: runs that differ in one of them are not compared."""

SCALE_WORD = re.compile(r" ?\bscale=\w+")


def contrast_entries(
    runs: Iterable[ReportRun], resamples: int, track: Track
) -> tuple[ContrastEntry, ...]:
    """Every comparison of `results.yaml`, one entry per metric, scale and data set.

    Args:
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
    for contrast in track(load_results_file().contrasts, "comparisons"):
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
            a, b = (_counts(side, contrast.counts) for side in sides)
            as_run = replace(resampling, absent=sides[0][0].absent)
            found = compare(a, b, list(contrast.expected), as_run)
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


def _counts(runs: Sequence[ReportRun], path: str) -> list[Counts]:
    """Counts of the trainings in the order of their seeds."""
    ordered = sorted(runs, key=lambda run: (run.entry.seed is None, run.entry.seed, run.key))
    return [run.counts(path) for run in ordered]


def _measured(entry: ContrastEntry, each: Difference, found: Comparison) -> ContrastEntry:
    interval = each.interval
    return replace(
        entry,
        values=(each.a.value, each.b.value),
        seeds=(each.a.seeds, each.b.seeds),
        difference=each.value,
        low=None if interval is None else interval.low,
        high=None if interval is None else interval.high,
        covers="images and seeds" if each.both else "images" if interval else "none",
        p=each.p,
        verdict=verdict(each, entry.expected, found.level),
    )


def verdict(found: Difference, expected: str, level: float) -> str:
    """Whether the data shows what was expected: holds, contradicted, or undecided with the reason.

    A difference is shown where its interval over images and seeds leaves 0 out and its p-value is
    below 1 - `level`.

    Args:
        found: method less reference.
        expected: "higher" or "lower".
        level: of the interval.
    """
    if found.both is None:
        return "Undecided: both methods need two seeds or more."
    if found.p_both < 1 - level and 0.0 not in found.both:
        return "Holds." if (found.value > 0) == (expected == "higher") else "Contradicted."
    unit = "" if parse(found.metric).score == names.VAR else " points"
    return (
        f"Undecided: with these seeds and images, a difference below {found.both.half:.2f}{unit} "
        "cannot be shown."
    )
