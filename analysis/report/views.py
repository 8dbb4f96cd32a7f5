"""What the template shows beside the data: texts of numbers, rows of tables, groups of runs."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import pandas as pd

from analysis.report.data import CellEntry, ReportData, RunEntry, TableEntry

DASH = "–"
KINDS = {
    "ours": "ours",
    "interval": "95 % interval",
    "published": "published",
    "difference": "difference",
}
"""Lines of a cell, and how they are called."""

COVERS = {
    "images": "over images",
    "seeds": "over seeds",
    "images and seeds": "over images and seeds",
}
STATUS = {
    "FINISHED": "✓ finished",
    "RUNNING": "… running",
    "FAILED": "✗ failed",
    "KILLED": "✗ killed",
}
RANKS = ("", "shown to be the best", "shown to be the second best")
FORMS = {"paper": "", "released": "released form", "both": "both forms"}
ENDS = {"ring": ("centre", "edge"), "vertical": ("left", "right"), "horizontal": ("top", "bottom")}
"""Kinds of partitions: what their first and last regions are called."""

PARTITION = re.compile(r"(ring|vertical|horizontal)(\d+)(?:_released_3_4)?")
MAP_WIDTH, MAP_HEIGHT = 240, 180


def is_number(value: float | None) -> bool:
    """Whether there is a value that is finite."""
    return value is not None and math.isfinite(value)


def fixed(value: float | None, decimals: int = 2) -> str:
    """A number with a real minus sign; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return DASH
    return f"{value:.{decimals}f}".replace("-", "−")


def signed(value: float | None) -> str:
    """With its sign and an arrow, so that colour is never the only mark."""
    if value is None or not math.isfinite(value):
        return DASH
    text = f"{abs(value):.2f}"
    if float(text) == 0:
        return f"= {text}"
    return f"▲ +{text}" if value > 0 else f"▼ −{text}"


def with_sign(value: float | None) -> str:
    """A difference as ``+0.35``; a dash where there is none."""
    text = fixed(value)
    return f"+{text}" if is_number(value) and float(f"{value:.2f}") > 0 else text


def interval_text(low: float | None, high: float | None) -> str:
    """``[−1.20, 0.35]``; a dash where there is none."""
    return f"[{fixed(low)}, {fixed(high)}]" if is_number(low) and is_number(high) else DASH


def plural(count: int, word: str) -> str:
    """``1 run``, ``2 runs``."""
    return f"{count} {word}{'' if count == 1 else 's'}"


def moment(iso: str) -> str:
    """``2026-11-21T11:42:01+00:00`` as ``2026-11-21 11:42``."""
    return iso[:16].replace("T", " ") or DASH


def duration(seconds: float | None) -> str:
    """Seconds, minutes, or hours and minutes."""
    if seconds is None or not math.isfinite(seconds):
        return DASH
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def commit_text(commit: str) -> str:
    """Ten letters of a commit, with the mark for uncommitted changes."""
    return commit.replace("+", "")[:10] + "+" * commit.endswith("+") or DASH


def letters(index: int) -> str:
    """0 as a, 25 as z, 26 as aa."""
    last = chr(97 + index % 26)
    return last if index < 26 else letters(index // 26 - 1) + last


def unique_names(names: Iterable[str]) -> list[str]:
    """A distinct anchor (the text after #) for each of these: letters, digits and hyphens."""
    taken: list[str] = []
    for name in names:
        slug = wanted = re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-").lower()
        number = 2
        while slug in taken:
            slug, number = f"{wanted}-{number}", number + 1
        taken.append(slug)
    return taken


@dataclass(frozen=True)
class TableView:
    """A table with its place on the page."""

    entry: TableEntry
    id: str

    def places(self) -> Iterator[tuple[tuple[int, int], CellEntry]]:
        """Row and column of each cell, row by row."""
        for r, row in enumerate(self.entry.cells):
            for c, cell in enumerate(row):
                yield (r, c), cell

    @cached_property
    def cells(self) -> list[CellEntry]:
        """All cells, row by row."""
        return [cell for _, cell in self.places()]

    @cached_property
    def is_run(self) -> bool:
        """Whether it has a run or a value of ours."""
        return any(cell.runs or is_number(cell.mean) for cell in self.cells)

    @cached_property
    def keys(self) -> list[str]:
        """Keys of all runs behind it."""
        return list(dict.fromkeys(key for cell in self.cells for key in cell.runs))

    @cached_property
    def main(self) -> int:
        """The column it is about: mIoU, else the first with mIoU in its name, else the first."""
        names = self.entry.columns
        return next((names.index(n) for n in ("mIoU", *names) if n in names and "mIoU" in n), 0)

    @cached_property
    def decimals(self) -> int:
        """Digits after the point, as many as the paper prints."""
        printed = (f"{cell.published:.12g}" for cell in self.cells if is_number(cell.published))
        return max((len(text.partition(".")[2]) for text in printed), default=0)

    @cached_property
    def reasons(self) -> list[str]:
        """Footnotes: each sentence once, in order of appearance."""
        return list(dict.fromkeys(cell.reason for cell in self.cells if cell.reason))

    def kinds(self, row: Sequence[CellEntry]) -> list[str]:
        """`KINDS` that some cell of a row has."""
        there = {
            "ours": any(cell.runs or cell.reason or is_number(cell.mean) for cell in row),
            "interval": any(is_number(cell.low) for cell in row),
            "published": any(is_number(cell.published) for cell in row),
            "difference": any(is_number(cell.difference) for cell in row),
        }
        return [kind for kind in KINDS if there[kind]]

    def way(self, column: int, difference: float) -> str:
        """What a difference means: "better", "worse", or "neutral" where orders alone count."""
        best = self.entry.best[column]
        if not difference or best == "none" or not self.entry.at_paper_scale:
            return "neutral"
        return "better" if (difference > 0) == (best == "highest") else "worse"

    @property
    def facts(self) -> str:
        """Where the printed values are from, and what ours and the intervals are over."""
        text = f"Published: {self.entry.data}. Unit: {self.entry.unit}."
        if seeds := seed_span(self.cells):
            word = "seed" if seeds == "1" else "seeds"
            over = seeds.replace(DASH, " to ")
            text += f" Ours: mean ± standard deviation over {over} {word}."
        covers = dict.fromkeys(COVERS[each.covers] for each in self.cells if each.covers in COVERS)
        return text + (f" Interval: 95 %, {'; '.join(covers)}." if covers else "")

    @property
    def rows_run(self) -> int:
        """Number of rows with a value of ours."""
        return sum(any(is_number(cell.mean) for cell in row) for row in self.entry.cells)

    @property
    def best_rows(self) -> list[str]:
        """Rows that are shown to be better than all others of ours in the main column."""
        rows = zip(self.entry.rows, self.entry.cells, strict=True)
        return [label for label, row in rows if row[self.main].rank == 1]

    @property
    def form(self) -> str:
        """What the rows of ours are run as, in words; "" for the paper's form."""
        return FORMS[self.entry.form]


def table_views(data: ReportData) -> list[TableView]:
    """The tables with their places."""
    places = unique_names(
        f"table {each.name} {each.scale} {FORMS[each.form]} {each.extra}" for each in data.tables
    )
    return [TableView(entry, place) for entry, place in zip(data.tables, places, strict=True)]


def seed_span(cells: Iterable[CellEntry]) -> str:
    """Number of seeds, as in ``3`` or ``2–3``; "" of none."""
    there = [cell.seeds for cell in cells if cell.seeds]
    return DASH.join(map(str, sorted({min(there), max(there)}))) if there else ""


@dataclass(frozen=True)
class Group:
    """Runs that share method, scale, split, partition and data set, with what they have in common.

    Attributes:
        id: address of its panel.
        runs: newest first.
        means: of the scores, by name.
        sds: standard deviations (n - 1); NaN for a single run.
        regions: a row per region with the columns mean, std, min, max.
    """

    id: str
    name: str
    runs: tuple[RunEntry, ...]
    means: Mapping[str, float]
    sds: Mapping[str, float]
    regions: list[dict[str, float]]

    @cached_property
    def kind(self) -> str:
        """Kind of partition: "ring", "vertical", "horizontal"; "" of others."""
        found = PARTITION.fullmatch(self.runs[0].partition)
        return found.group(1) if found else ""

    @property
    def seeds(self) -> str:
        """Seeds in order."""
        seeds = sorted(run.seed for run in self.runs if run.seed is not None)
        return ", ".join(map(str, seeds)) or DASH

    @property
    def seconds(self) -> float:
        """Mean duration; NaN where none is known."""
        return float(pd.Series([run.seconds for run in self.runs], dtype=float).mean())

    @property
    def status(self) -> str:
        """The state; with counts where the runs are not alike."""
        states = Counter(STATUS.get(run.status, run.status) for run in self.runs)
        counted = [f"{name} ({count})".replace(" ", "\u00a0") for name, count in states.items()]
        return next(iter(states)) if len(states) == 1 else ", ".join(counted)

    @property
    def text(self) -> str:
        """What the filter of the runs looks through."""
        words = [self.name, self.status, self.runs[0].scale]
        for run in self.runs:
            words += [run.name, run.key, run.experiment, run.group, *run.table_rows, *run.studies]
        return " ".join(dict.fromkeys(words)).lower()

    def place(self, region: int) -> str:
        """``1 centre``, ``2``, ...: the number of a region (from 0), and its place at the ends."""
        ends = {0: 0, len(self.regions) - 1: 1}
        place = ENDS[self.kind][ends[region]] if self.kind and region in ends else ""
        return f"{region + 1} {place}".strip()

    def boxes(self) -> list[tuple[float, float, float, float]]:
        """x, y, width, height of each region in a map of `MAP_WIDTH` x `MAP_HEIGHT`.

        Rings are nested: ring r (from 0) of R ends where (r + 1) / R of the area is enclosed.
        """
        count, (width, height) = len(self.regions), (MAP_WIDTH, MAP_HEIGHT)
        if self.kind == "vertical":
            return [(width * r / count, 0, width / count, height) for r in range(count)]
        if self.kind == "horizontal":
            return [(0, height * r / count, width, height / count) for r in range(count)]
        sides = [math.sqrt((r + 1) / count) for r in range(count)]
        return [(width * (1 - s) / 2, height * (1 - s) / 2, width * s, height * s) for s in sides]


def groups_of(runs: Iterable[RunEntry], *, single: bool = False) -> list[Group]:
    """The runs by group in the order of their first ones; `single`: each run is a group."""
    found: dict[tuple[Any, ...], list[RunEntry]] = {}
    for run in runs:
        name = run.name if single else run.group or run.experiment or run.name
        same = (run.scale, run.split, run.partition, run.dataset, run.unscored)
        found.setdefault((name, run.key if single else same), []).append(run)
    groups = []
    for (name, _), members in found.items():
        scores = pd.DataFrame([dict(run.scores) for run in members], dtype=float)
        ious = [run.region_ious for run in members if run.region_ious]
        regions = pd.DataFrame(ious, dtype=float)
        columns = {"mean": regions.mean(), "std": regions.std()}
        ends = pd.DataFrame({**columns, "min": regions.min(), "max": regions.max()})
        group = Group(
            id=f"{'run' if single else 'group'}={members[0].key}",
            name=name,
            runs=tuple(members),
            means=scores.mean().to_dict(),
            sds=scores.std().to_dict(),
            regions=ends.to_dict("records"),
        )
        groups.append(group)
    return groups


class Heat:
    """Colours of a heat map over a range: viridis, with even steps in lightness."""

    def __init__(self, values: Iterable[float]) -> None:
        from matplotlib import colormaps

        there = [value for value in values if is_number(value)] or [0.0, 1.0]
        self.low, self.high, self._map = min(there), max(there), colormaps["viridis"]

    def colours(self, value: float) -> tuple[str, str]:
        """Background, and the ink that can be read on it."""
        from matplotlib.colors import to_hex

        if not is_number(value):
            return "transparent", "inherit"
        place = (value - self.low) / (self.high - self.low) if self.high > self.low else 0.5
        return to_hex(self._map(place)), "#111" if place > 0.6 else "#fff"
