"""Temporal, Fig. 5: temporal consistency (TC) and consistent accuracy (CA) by class."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.figures.style import COLOURS, MARKERS, PAGE, new_figure, readable, styled
from rgbt.checks import InputError, check_range

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HEADER = ("class", "variant", "tc", "ca")


@dataclass(frozen=True)
class ClassConsistency:
    """TC and CA of variants by class.

    Attributes:
        classes: C names.
        variants: V names, e.g. "(G) Ours-dice".
        tc: (V, C) percent, temporal consistency.
        ca: (V, C) percent, consistent accuracy; never above `tc`, whose numerator holds its own
            and whose denominator its own holds (Temporal, Fig. 4).
    """

    classes: tuple[str, ...]
    variants: tuple[str, ...]
    tc: NDArray[np.float64]
    ca: NDArray[np.float64]

    def means(self) -> dict[str, tuple[float, float]]:
        """Variant -> mean TC and CA over classes: the cells of the paper's Table I."""
        rows = zip(self.variants, self.tc.mean(1), self.ca.mean(1), strict=True)
        return {name: (float(tc), float(ca)) for name, tc, ca in rows}


def class_consistency(
    scores: Mapping[tuple[str, str], tuple[float, float]],
) -> ClassConsistency:
    """The series of Fig. 5, classes and variants in the order in which they first occur.

    Args:
        scores: (class, variant) -> (TC, CA) in percent.

    Raises:
        InputError: a class without a variant that others have, or CA above TC.
    """
    classes = tuple(dict.fromkeys(name for name, _ in scores))
    variants = tuple(dict.fromkeys(variant for _, variant in scores))
    both = np.empty((2, len(variants), len(classes)))
    for row, variant in enumerate(variants):
        for column, name in enumerate(classes):
            if (name, variant) not in scores:
                raise InputError(
                    f"scores: there is no TC and CA of class '{name}' for '{variant}'; give every "
                    "class for every variant."
                )
            both[:, row, column] = scores[name, variant]
    if (both[1] > both[0]).any():
        row, column = np.argwhere(both[1] > both[0])[0]
        raise InputError(
            f"scores: CA of '{classes[column]}' for '{variants[row]}' is {both[1, row, column]:g}, "
            f"above its TC {both[0, row, column]:g}, which cannot be; are the columns exchanged?"
        )
    return ClassConsistency(classes, variants, both[0], both[1])


def read_scores(path: Path) -> dict[tuple[str, str], tuple[float, float]]:
    """Scores from a CSV file with the columns class, variant, tc, ca (percent).

    Example:
        class,variant,tc,ca
        car,(G) Ours-dice,61.2,55.0

    Raises:
        InputError: no such file, not UTF-8, other columns, a value that is no percentage, a line
            twice, or a line with more values than columns.
    """
    if not path.is_file():
        raise InputError(f"scores={path}: there is no such file; expected CSV {','.join(HEADER)}.")
    found: dict[tuple[str, str], tuple[float, float]] = {}
    for line in _lines(path):
        key = (line["class"], line["variant"])
        if key in found:
            raise InputError(f"scores={path}: class '{key[0]}' of '{key[1]}' stands there twice.")
        found[key] = (_percent(path, line, "tc"), _percent(path, line, "ca"))
    if not found:
        raise InputError(f"scores={path}: there is no line below the columns.")
    return found


def _lines(path: Path) -> list[dict[str, str]]:
    """The lines below the header, each with exactly its columns."""
    try:
        text = path.read_text(encoding="utf-8-sig")
        rows = [row for row in csv.reader(io.StringIO(text), strict=True) if row]
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            f"scores={path} is no CSV file in UTF-8 ({error}); save it as one, with the columns "
            f"{','.join(HEADER)}."
        ) from error
    header, lines = (rows[0], rows[1:]) if rows else ([], [])
    if tuple(header) != HEADER:
        raise InputError(
            f"scores={path}: expected the columns {','.join(HEADER)}, got "
            f"{','.join(header) or 'none'}."
        )
    for line in lines:
        if len(line) != len(HEADER):
            raise InputError(
                f"scores={path}: '{','.join(line)}' has {len(line)} values for the {len(HEADER)} "
                f"columns {','.join(HEADER)}; put quotes around a name with a comma."
            )
    return [dict(zip(HEADER, line, strict=True)) for line in lines]


def _percent(path: Path, line: Mapping[str, str], column: str) -> float:
    where = f"scores={path}: {column} of '{line['class']}' for '{line['variant']}'"
    try:
        value = float(line[column])
    except ValueError as error:
        raise InputError(f"{where} must be a number, got '{line[column]}'.") from error
    check_range(where, value, 0, 100)
    return value


@styled
def draw(data: ClassConsistency) -> Figure:
    """TC as full and CA as open marker, joined by a line; variants side by side in each class."""
    figure = new_figure(PAGE, 2.6)
    axes = figure.subplots()
    places = np.arange(len(data.classes))
    step = min(0.2, 0.7 / len(data.variants))
    for index, variant in enumerate(data.variants):
        x = places + (index - (len(data.variants) - 1) / 2) * step
        colour = COLOURS[index % len(COLOURS)]
        mark = {"marker": MARKERS[index % len(MARKERS)], "linestyle": "none", "color": colour}
        axes.vlines(x, data.ca[index], data.tc[index], color=colour, linewidth=0.8)
        axes.plot(x, data.tc[index], label=f"{variant}, TC", **mark)  # type: ignore[arg-type]
        open_mark = mark | {"markerfacecolor": "white"}
        axes.plot(x, data.ca[index], label=f"{variant}, CA", **open_mark)  # type: ignore[arg-type]
    axes.set_xticks(places, [readable(name) for name in data.classes])
    axes.grid(visible=False, axis="x")
    axes.set_ylim(bottom=0)
    axes.set_ylabel("percent")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(data.variants))
    return figure
