"""Tables of the statistics: grids of text for terminal and Markdown, and one tidy table of values.

A grid has a column per region, or, with many regions, a row per region.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from analysis.statistics import derive
from analysis.statistics.data import MODALITIES, SpatialStatistics
from analysis.statistics.judging import FAILS, HOLDS, OPEN, Claim, Finding, Range
from rgbt.tables import ABSENT, TextTable, csv_text, number

COLUMNS = 12
"""More regions than this become rows."""

Row = tuple[str, NDArray[np.float64]]

SHORT = {HOLDS: "yes", FAILS: "no", OPEN: "open"}

CSV_COLUMNS = (
    *("dataset", "split", "partition", "images", "part", "quantity", "modality"),
    *("class", "estimator", "average", "region", "value"),
)


def occupancy_grids(stats: SpatialStatistics) -> tuple[TextTable, ...]:
    """Sample occupancy by part, by class, and by class relative to its largest region.

    The first one is left out for a data set without a background class.
    """
    parts = stats.subsets() if stats.background else ()
    rows = [(part, 100 * derive.region_occupancy(stats, part)) for part in parts]
    names = [stats.classes[index] for index in stats.objects]
    by_class = derive.class_region_occupancy(stats)
    relative = derive.normalised(by_class)
    titles = ("by class, % of the pixels", "by class, % of its largest region (Fig. 3)")
    whole = (region_grid("sample occupancy rate, % (Eq. 2)", rows),) if rows else ()
    return (
        *whole,
        *(
            region_grid(title, list(zip(names, 100 * values[list(stats.objects)], strict=True)))
            for title, values in zip(titles, (by_class, relative), strict=True)
        ),
    )


def image_grids(stats: SpatialStatistics, estimator: str, average: str) -> tuple[TextTable, ...]:
    """Laplacian variance, noise and signal to noise of both modalities by part."""
    title = f"Laplacian variance ({stats.kernel} neighbours, Eq. 3)"
    return (
        _modality_grid(title, stats, partial(derive.region_laplacian, stats)),
        noise_grid(stats, estimator),
        snr_grid(stats, estimator, average),
    )


def noise_grid(stats: SpatialStatistics, estimator: str) -> TextTable:
    """Noise of both modalities by part; below one grey level rounding is a good part of it."""
    title = f"noise, grey levels ({estimator}; rounding alone is 0.29)"
    return _modality_grid(title, stats, partial(derive.region_noise, stats, estimator=estimator))


def snr_grid(stats: SpatialStatistics, estimator: str, average: str) -> TextTable:
    """Signal to noise of both modalities by part."""
    of_region = partial(derive.region_snr, stats, estimator=estimator, average=average)
    return _modality_grid(f"signal to noise (Eq. 4; {estimator}, {average})", stats, of_region)


def _modality_grid(
    title: str, stats: SpatialStatistics, measure: Callable[[str, str], NDArray[np.float64]]
) -> TextTable:
    """A row per modality and part, of what `measure` gives for them."""
    wanted = [(modality, part) for modality in MODALITIES for part in stats.subsets()]
    return region_grid(title, [(f"{m}, {part}", measure(m, part)) for m, part in wanted])


def entropy_grid(stats: SpatialStatistics) -> TextTable:
    """Label entropy by part, with and without background where there is one."""
    rows = [
        (f"{part}, {word}" if word else part, derive.label_entropy(stats, part, background))
        for part in stats.subsets()
        for word, background in derive.entropies(stats)
    ]
    return region_grid("label entropy, bits (Eq. 5)", rows)


def region_grid(title: str, rows: Sequence[Row]) -> TextTable:
    """Values by region, and their mean over regions."""
    regions = len(rows[0][1])
    header = ("", *(f"R{index + 1}" for index in range(regions)), "mean")
    lines = [(name, *map(number, (*values, float(values.mean())))) for name, values in rows]
    if regions <= COLUMNS:
        return TextTable(title, header, tuple(lines))
    turned = list(zip(header, *lines, strict=True))
    return TextTable(title, turned[0], tuple(turned[1:]))


def claims_grid(claims: Sequence[Claim], level: float) -> TextTable:
    """A line per claim with its verdict, below it a line per number that decides it."""
    rows: list[tuple[str, ...]] = []
    for claim in claims:
        how = f", {claim.estimator}, {claim.average}" if claim.estimator else ""
        rows.append((f"{claim.statement}{how} ({claim.source})", "", "", "", claim.verdict, ""))
        for each in claim.findings:
            value, low, high = each.interval
            ends = ABSENT if math.isnan(low) else f"[{digits(low)}, {digits(high)}]"
            cells = (digits(value), ends, range_text(each.wanted), SHORT[each.verdict], each.note)
            rows.append((f"   {each.what}", *cells))
    header = ("claim", "value", f"{100 * level:g} % interval", "claimed", "holds", "")
    return TextTable("claims of SpatialSeg, Sec. III", header, tuple(rows))


def estimator_grid(claims: Sequence[Claim]) -> TextTable:
    """How the numbers about noise depend on its estimator and on the average."""
    columns: dict[tuple[str, str], dict[tuple[str, str], Finding]] = {}
    for claim in claims:
        if claim.estimator:
            column = columns.setdefault((claim.estimator, claim.average), {})
            column |= {(claim.statement, each.what): each for each in claim.findings}
    ways = list(columns)
    rows = []
    for statement, what in columns[ways[0]]:
        found = [columns[way][statement, what] for way in ways]
        cells = [f"{digits(each.interval.value)} {SHORT[each.verdict]}" for each in found]
        rows.append((what, range_text(found[0].wanted), *cells))
    header = ("signal to noise", "claimed", *(f"{name}, {average}" for name, average in ways))
    return TextTable(
        "how it depends on the estimator of the noise and the average", header, tuple(rows)
    )


def markdown(
    stats: SpatialStatistics, claims: Sequence[Claim], ways: Sequence[tuple[str, str]], level: float
) -> str:
    """Everything as Markdown.

    Args:
        stats: measurements.
        claims: of every estimator and average.
        ways: (estimator, average) of every table of signal to noise.
        level: of the intervals.
    """
    first, *others = ways
    grids = [*occupancy_grids(stats), *image_grids(stats, *first)]
    grids += [noise_grid(stats, name) for name in stats.noise if name != first[0]]
    grids += [snr_grid(stats, *way) for way in others]
    grids += [entropy_grid(stats), claims_grid(claims, level), estimator_grid(claims)]
    remark = () if stats.background else (derive.no_background(stats), "")
    lines = [f"# {heading(stats)}", "", *remark, *(grid.to_markdown() for grid in grids)]
    return "\n".join(lines)


def heading(stats: SpatialStatistics) -> str:
    """What was measured, in a line."""
    hw = stats.region_map.shape
    nights = "" if stats.night is None else f" ({int(stats.night.sum())} at night)"
    ignored = float(stats.ignored.sum() / max(1, stats.ignored.sum() + stats.labels.sum()))
    return (
        f"{stats.dataset}, split {stats.split}: {len(stats.names)} images{nights} of "
        f"{hw[0]}x{hw[1]}, {stats.partition}, {100 * ignored:.2f} % of the pixels ignored"
    )


def to_csv(stats: SpatialStatistics) -> str:
    """One value per line, with everything it depends on in its own column (`CSV_COLUMNS`)."""
    rows: list[tuple[object, ...]] = [CSV_COLUMNS]
    for part in stats.subsets():
        images = int(stats.chosen(part).sum())
        start = (stats.dataset, stats.split, stats.partition, images, part)
        for keys, values in _quantities(stats, part):
            for region, value in enumerate(values.tolist(), start=1):
                cell = "" if math.isnan(value) else f"{value:.8g}"
                rows.append((*start, *keys, region, cell))
    return csv_text(rows)


def _quantities(
    stats: SpatialStatistics, part: str
) -> Iterator[tuple[tuple[str, ...], NDArray[np.float64]]]:
    """((quantity, modality, class, estimator, average), values by region)."""
    if stats.background:
        yield ("occupancy", "", "", "", ""), derive.region_occupancy(stats, part)
    by_class = derive.class_region_occupancy(stats, part)
    relative = derive.normalised(by_class)
    for index, name in enumerate(stats.classes):
        yield ("class_occupancy", "", name, "", ""), by_class[index]
        yield ("class_occupancy_normalised", "", name, "", ""), relative[index]
    for word, background in derive.entropies(stats):
        values = derive.label_entropy(stats, part, background)
        yield ("_".join(["entropy", *word.split()]), "", "", "", ""), values
    for modality in MODALITIES:
        yield ("laplacian", modality, "", "", ""), derive.region_laplacian(stats, modality, part)
        for estimator in stats.noise:
            noise = derive.region_noise(stats, modality, part, estimator)
            yield ("noise", modality, "", estimator, ""), noise
            for average in derive.AVERAGES:
                ratio = derive.region_snr(stats, modality, part, estimator, average)
                yield ("snr", modality, "", estimator, average), ratio


def range_text(wanted: Range) -> str:
    """Where a claim puts a number, e.g. "> 1"."""
    low, high = wanted
    if math.isinf(high):
        return f"> {low:g}"
    return f"< {high:g}" if low <= 0 else f"{low:.3g} to {high:.3g}"


def digits(value: float) -> str:
    """Three significant digits, or two decimals of what is larger than 10."""
    if math.isnan(value):
        return ABSENT
    return f"{value:.3f}" if abs(value) < 10 else f"{value:.2f}"
