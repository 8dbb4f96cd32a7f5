"""The variance budget of a table as text: two grids for the terminal and Markdown, and CSV."""

from __future__ import annotations

import math

from analysis.uncertainty import Interval
from rgbt.tables import ABSENT, TextTable, csv_text, number
from sweeps.verdicts.variance import SourceSpread, VarianceBudget

SOURCES = ("source", "sd", "95 % interval", "share of all", "runs")
SMALLEST = ("paired seeds", "smallest difference", "95 % interval", "and other images")
CSV_HEADER = ("kind", "name", "value", "low", "high", "with_images", "count", "reason")


def variance_grids(budget: VarianceBudget) -> tuple[TextTable, ...]:
    """The standard deviations by source, and the smallest differences by number of seeds."""
    column, variance_of_all = budget.column, budget.all.sd**2

    def share(sd: float) -> str:
        known = variance_of_all > 0 and not math.isnan(sd)
        return f"{100 * sd**2 / variance_of_all:.0f} %" if known else ABSENT

    lines = [(*_fields(each), share(each.sd), str(each.count)) for each in budget.sources]
    lines.append(
        ("sum of these", _number(budget.total), ABSENT, share(budget.total), ABSENT),
    )
    lines.append((*_fields(budget.all), share(budget.all.sd), str(budget.all.count)))
    images = budget.images
    blocks = f"{images.count} blocks of images" if images.count else ABSENT
    lines.append((*_fields(images), ABSENT, blocks))
    reasons = [
        f"{each.source}: {each.reason}"
        for each in (*budget.sources, budget.all, budget.images)
        if each.reason
    ]
    by_source = TextTable(
        f"Standard deviation of {column} by source",
        SOURCES,
        tuple(lines),
        (
            "sd: of one run, n - 1, in percent points; interval: chi-square. test images: what "
            "another draw of the test images would change, from resampling; not part of all.",
            *reasons,
        ),
    )
    difference = budget.difference
    if not budget.smallest:
        return (by_source,)
    shown = [
        (str(each.seeds), _number(each.value), _ends(each.interval), _number(each.with_images))
        for each in budget.smallest
    ]
    note = (
        f"From the differences {difference.source}: sd {_number(difference.sd)}, 95 % interval "
        f"{_ends(difference.interval)}, {difference.count} runs each. Smallest difference: half "
        "of the width of the 95 % interval of a claim."
    )
    return by_source, TextTable(
        f"Smallest difference of {column} that paired seeds show", SMALLEST, tuple(shown), (note,)
    )


def variance_csv(budget: VarianceBudget) -> str:
    """Every number of the budget, one per line."""
    total = SourceSpread(source="sum of these", sd=budget.total)
    lines = [*budget.sources, total, budget.all, budget.images]
    rows = [CSV_HEADER, *(_csv_line("sd", each) for each in lines)]
    rows.append(_csv_line("sd of paired differences", budget.difference))
    for each in budget.smallest:
        ends = (each.interval.low, each.interval.high)
        numbers = map(_plain, (each.value, *ends, each.with_images))
        rows.append(("smallest difference", f"{each.seeds} paired seeds", *numbers, "", ""))
    return csv_text(rows)


def _csv_line(kind: str, each: SourceSpread) -> tuple[str, ...]:
    low, high = (each.interval.low, each.interval.high) if each.interval else (math.nan, math.nan)
    numbers = map(_plain, (each.sd, low, high))
    return (kind, each.source, *numbers, "", str(each.count or ""), each.reason)


def _fields(each: SourceSpread) -> tuple[str, str, str]:
    return each.source, _number(each.sd), _ends(each.interval)


def _number(value: float) -> str:
    return ABSENT if math.isnan(value) else number(value)


def _ends(interval: Interval | None) -> str:
    return ABSENT if interval is None else f"[{number(interval.low)}, {number(interval.high)}]"


def _plain(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.6g}"
