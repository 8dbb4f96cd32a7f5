"""Effects of a design as text: grids for the terminal, Markdown, tidy CSV."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rgbt.tables import ABSENT, TextTable, csv_text
from sweeps.table.design import TRAINED, Design
from sweeps.verdicts.effects import MEAN, DesignEffects, EffectLine

HEADER = (
    "method",
    "effect",
    "difference",
    "95 % interval",
    "shown",
    "of seeds",
    "of images",
    "seeds",
)
CSV_HEADER = (
    *("part", "outcome", "method", "against", "effect", "value", "low", "high", "p", "p_holm"),
    *("shown", "error_seeds", "error_images", "seeds", "cells"),
)
ASKS = {
    TRAINED: "trained and tested in each cell",
    "tested": "trained without any factor, tested in each cell",
}
NOTES = (
    "difference: mean at the high level less mean at the low level; of an interaction half of the "
    "difference of two effects. of seeds, of images: standard errors.",
    "shown: differs from 0 at the 5 % level, corrected for the number of main effects, or of "
    "interactions, of the method (Holm). The intervals are not corrected.",
)


def effects_grids(effects: DesignEffects, design: Design) -> list[TextTable]:
    """One grid for each part and outcome; the factors and what is missing below the last."""
    grids = []
    places = list(dict.fromkeys((line.part, line.outcome) for line in effects.lines))
    for part, outcome in places:
        rows = [
            _row(line) for line in effects.lines if (line.part, line.outcome) == (part, outcome)
        ]
        is_last = (part, outcome) == places[-1]
        notes = (*levels(design), *NOTES, *effects.missing) if is_last else ()
        title = f"Effects on {outcome}, {ASKS[part]}"
        grids.append(TextTable(title, HEADER, tuple(rows), notes))
    if not places and effects.missing:
        grids.append(TextTable("Effects", HEADER, (), effects.missing))
    return grids


def levels(design: Design) -> list[str]:
    """A sentence for each factor."""
    return [
        f"{factor.letter}, {factor.name}: - {factor.low_means}; + {factor.high_means}."
        for factor in design.factors
    ]


def who(line: EffectLine) -> str:
    """The method, or the difference of two: "grbm - crm"."""
    return f"{line.method} - {line.against}" if line.against else line.method


def word(line: EffectLine) -> str:
    """Whether the effect is shown; the mean of all cells is not tested."""
    estimate = line.estimate
    if line.effect == MEAN and not line.against:
        return ABSENT
    if estimate.both is None:
        return "2 seeds needed" if estimate.seeds < 2 else "too few images"
    if not line.is_shown:
        return "no"
    return "higher" if estimate.value > 0 else "lower"


def effects_csv(lines: Sequence[EffectLine]) -> str:
    """One line for each effect, with the columns of `CSV_HEADER`; empty where there is no value."""
    rows: list[tuple[object, ...]] = [CSV_HEADER]
    for line in lines:
        found = line.estimate
        around = found.both
        low, high = (math.nan, math.nan) if around is None else (around.low, around.high)
        p = math.nan if around is None else found.p
        numbers = (found.value, low, high, p, line.corrected)
        rows.append(
            (
                *(line.part, line.outcome, line.method, line.against, line.effect),
                *(_plain(each) for each in numbers),
                word(line),
                *(_plain(each) for each in _errors(line)),
                *(found.seeds, line.cells),
            )
        )
    return csv_text(rows)


def _row(line: EffectLine) -> tuple[str, ...]:
    found = line.estimate
    interval = found.both
    around = ABSENT if interval is None else f"[{interval.low:+.2f}, {interval.high:+.2f}]"
    errors = (ABSENT if math.isnan(each) else f"{each:.2f}" for each in _errors(line))
    return (
        who(line),
        line.effect,
        f"{found.value:+.2f}",
        around,
        word(line),
        *errors,
        str(found.seeds),
    )


def _errors(line: EffectLine) -> tuple[float, float]:
    """Standard errors over seeds and over images; NaN where there is none."""
    evidence = line.estimate.evidence
    return math.nan if evidence.trainings is None else evidence.trainings.error, evidence.error


def _plain(value: float) -> str:
    return "" if math.isnan(value) else repr(round(value, 6))
