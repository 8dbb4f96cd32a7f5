"""How far runs rank like the printed values: Spearman's correlation by table, signs of contrasts.

It says how far results at a small scale, or on other images, foretell those of a paper.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.uncertainty.blocks import Values
from analysis.uncertainty.verdicts import Verdict
from rgbt.randomness import numpy_generator
from sweeps.judge.judged_claim import JudgedClaim
from sweeps.judge.judged_table import JudgedTable
from sweeps.judge.seeds import Scores, negated
from sweeps.plan.table import Column
from sweeps.score.cells import published

if TYPE_CHECKING:
    import pandas as pd

RANKS = ["table", "column", "images", "scale", "rows", "rho", "low", "high"]
CONTRASTS = [
    "paper",
    "table",
    "claim",
    "contrast",
    "decides",
    "images",
    "scale",
    "printed",
    "explored",
    "explored_low",
]
CONTRASTS += ["explored_high", "explored_seeds", "confirmed", "confirmed_low", "confirmed_high"]
CONTRASTS += ["confirmed_seeds"]

PAIRS = ["first", "second", "alike", "contrasts", "tables", "low", "high"]
PAIRS += ["rho", "rho_low", "rho_high"]
PRINT = "print"

SIGNS = ["images", "scale", "alike", "contrasts", "low", "high", "decided_alike", "decided"]

# Rows below which a rank correlation says nothing.
FEWEST_ROWS = 3
DRAWS = 4_000
RHO_DRAWS = 1_000


def ranks_of(tables: Sequence[JudgedTable]) -> pd.DataFrame:
    """Compare our ranking of the rows of tables with the printed one.

    Returns:
        a row for each table and column of a main score, with the columns `RANKS`: rho is Spearman's
        correlation of our means with the printed values over rows of different runs; low and high
        are the ends of a 95 % interval, with our means drawn anew by their spread over seeds (NaN
        where a row has one seed).
    """
    import pandas as pd

    found = []
    for judged in tables:
        for column in judged.request.table.headlines():
            ranked = _ranked(judged, column)
            if ranked is not None:
                found.append(ranked)
    return pd.DataFrame(found, columns=RANKS)


def _ranked(judged: JudgedTable, column: Column) -> dict[str, Any] | None:
    seen: set[tuple[str, ...]] = set()
    ours, errors, freedoms, printed, kinds = [], [], [], [], set()
    for row in judged.request.table.rows:
        cell, value = judged.values.cells.get((row.label, column.name)), published(row, column)
        if cell is None or value is None or math.isnan(cell.mean) or cell.keys in seen:
            continue
        seen.add(cell.keys)
        for (label, _), outcome in judged.runs.items():
            if label == row.label:
                kinds |= {judged.reader.origin(run)[:2] for run in outcome.results}
        ours.append(cell.mean)
        printed.append(value)
        errors.append(cell.sd / math.sqrt(cell.seeds) if cell.seeds > 1 else math.nan)
        freedoms.append(max(1, cell.seeds - 1))
    if len(ours) < FEWEST_ROWS or len(kinds) != 1 or len(set(printed)) < 2:
        return None
    ((images, scale),) = kinds
    low = high = math.nan
    if not np.isnan(errors).any():
        rng = numpy_generator(0, "ranks")
        noise = rng.standard_t(freedoms, (DRAWS, len(ours)))
        drawn = rank_correlations(np.array(ours) + noise * np.array(errors), np.array(printed))
        low, high = np.quantile(drawn, [0.025, 0.975])
    (rho,) = rank_correlations(np.array([ours]), np.array(printed))
    numbers = (len(ours), rho, low, high)
    values = (judged.request.name, column.name, images, scale, *numbers)
    return dict(zip(RANKS, values, strict=True))


def rank_correlations(scores: Values, printed: Values) -> Values:
    """Return Spearman's correlation of each row of `scores` (D, R) with `printed` (R,): (D,)."""
    from scipy.stats import rankdata

    ranks = rankdata(scores, axis=1)
    ranks -= ranks.mean(1, keepdims=True)
    other = rankdata(printed)
    other -= other.mean()
    lengths = np.sqrt((ranks**2).sum(1) * (other**2).sum())
    with np.errstate(invalid="ignore"):
        return np.asarray(ranks @ other / lengths)


def contrasts_frame(tables: Sequence[JudgedTable]) -> pd.DataFrame:
    """Return the contrasts of all claims about differences.

    Returns:
        a row for each contrast of different runs, with the columns `CONTRASTS`: printed is NaN
        where no paper prints both values; decides says whether its numbers are those of the
        verdict of the claim; NaN and 0 where it was not explored, or not confirmed.
    """
    import pandas as pd

    rows: dict[Scores, dict[str, Any]] = {}
    claims = [claim for judged in tables for claim in judged.claims if not claim.is_level]
    for is_printed in (True, False):  # of two names of one contrast the printed one is kept
        for claim in claims:
            _add_contrasts(claim, rows, is_printed=is_printed)
    frame = pd.DataFrame(list(rows.values()), columns=CONTRASTS)
    return frame.astype({"printed": float, "decides": bool})


def _add_contrasts(
    claim: JudgedClaim, rows: dict[Scores, dict[str, Any]], *, is_printed: bool
) -> None:
    """Add the contrasts of a claim, by their scores; one that is known may decide this claim."""
    for single in claim.contrasts:
        if (single.printed is not None) != is_printed:
            continue
        opposite = negated(single.scores)
        place = opposite if opposite in rows else single.scores
        row = rows.setdefault(place, {**_contrast(claim, single), "decides": False})
        row["decides"] |= single.label == claim.label and not claim.same_as


def _contrast(claim: JudgedClaim, single: JudgedClaim) -> dict[str, Any]:
    row: dict[str, Any] = {
        "paper": claim.table.rpartition("/")[0] or "studies",
        "table": claim.table,
        "claim": claim.claim.name,
        "contrast": single.label,
        "images": claim.images,
        "scale": claim.scale,
        "printed": single.printed,
    }
    for kind, verdict in (("explored", single.exploration), ("confirmed", single.confirmation)):
        names = [kind, f"{kind}_low", f"{kind}_high", f"{kind}_seeds"]
        row |= dict(zip(names, _numbers(verdict), strict=True))
    return row


def _numbers(verdict: Verdict | None) -> tuple[float, float, float, int]:
    if verdict is None:
        return math.nan, math.nan, math.nan, 0
    ends = (math.nan, math.nan)
    if verdict.interval is not None:
        ends = (verdict.interval.low, verdict.interval.high)
    return verdict.estimate, *ends, verdict.seeds


def signs_of(contrasts: pd.DataFrame) -> pd.DataFrame:
    """Count signs as printed among contrasts (`contrasts_frame`), by kind of images and scale.

    Contrasts without printed values do not count, and one alone is no share.

    Returns:
        the columns `SIGNS`, real images before synthetic scenes, the most contrasts first: alike of
        so many contrasts have the printed sign; low and high are the ends of the 95 % interval of
        the share, with tables drawn anew, because the contrasts of a table share rows (NaN for one
        table); decided: those whose interval excludes 0, and decided_alike of them with the
        printed sign.
    """
    import pandas as pd

    found = []
    for (images, scale), group in contrasts.groupby(["images", "scale"], sort=True):
        ours = ours_of(group)
        low, high = ends_of(group)
        known = ours.notna() & group["printed"].notna() & (group["printed"] != 0)
        alike = known & (ours * group["printed"] > 0)
        decided = known & ((low > 0) | (high < 0))
        if known.sum() < 2:
            continue
        by_table = alike[known].groupby(group["table"][known])
        ends = _share_interval(by_table.sum().to_numpy(), by_table.size().to_numpy())
        of_decided = ((alike & decided).sum(), decided.sum())
        found.append((images, scale, alike.sum(), known.sum(), *ends, *of_decided))
    found.sort(key=lambda row: (row[0].split()[0], -row[3]))
    return pd.DataFrame(found, columns=SIGNS)


def kinds_of(contrasts: pd.DataFrame) -> pd.Series:
    """Return on what each contrast was measured, such as "synthetic scenes, scale=bench"."""
    return contrasts["images"] + ", scale=" + contrasts["scale"]


def ends_of(contrasts: pd.DataFrame) -> tuple[pd.Series, pd.Series]:
    """Return the ends of the interval of `ours_of`; NaN without one."""
    is_confirmed = contrasts["confirmed"].notna()
    low = contrasts["confirmed_low"].where(is_confirmed, contrasts["explored_low"])
    return low, contrasts["confirmed_high"].where(is_confirmed, contrasts["explored_high"])


def pairs_of(contrasts: pd.DataFrame) -> pd.DataFrame:
    """Compare print and every kind of runs with each other, over the contrasts that both have.

    Returns:
        the columns `PAIRS`, a row for each pair of `PRINT` and `kinds_of`: alike of so many
        contrasts of so many tables have the same sign; rho is Spearman's correlation of the
        differences; low, high, rho_low and rho_high are ends of 95 % intervals, with whole tables
        drawn anew (NaN for one table).
    """
    import pandas as pd

    frame = contrasts.assign(ours=ours_of(contrasts), kind=kinds_of(contrasts))
    place = ["table", "claim", "contrast"]
    wide = frame.pivot_table(index=place, columns="kind", values="ours", aggfunc="first")
    wide.insert(0, PRINT, frame.groupby(place)["printed"].first())
    found = []
    for first, second in combinations(wide.columns, 2):
        both = wide[[first, second]].dropna()
        both = both[(both != 0).all(axis=1)]
        if len(both) < FEWEST_ROWS:
            continue
        tables = both.index.get_level_values("table")
        parts = [part.to_numpy() for _, part in both.groupby(tables)]
        alike = [int((part[:, 0] * part[:, 1] > 0).sum()) for part in parts]
        ends = _share_interval(np.array(alike), np.array([len(part) for part in parts]))
        every = (sum(alike), len(both), len(parts), *ends, *_rho_interval(parts))
        found.append((first, second, *every))
    return pd.DataFrame(found, columns=PAIRS)


def _rho_interval(parts: Sequence[Values]) -> tuple[float, float, float]:
    """Spearman's correlation of the columns of parts (n, 2), and its ends with parts redrawn."""
    (rho,) = _rho(parts)
    if len(parts) < 2:
        return rho, math.nan, math.nan
    places = numpy_generator(0, "pairs").integers(0, len(parts), (RHO_DRAWS, len(parts)))
    drawn = [_rho([parts[place] for place in row])[0] for row in places]
    low, high = np.nanquantile(drawn, [0.025, 0.975])
    return rho, float(low), float(high)


def _rho(parts: Sequence[Values]) -> Values:
    both = np.concatenate(parts)
    return rank_correlations(both[None, :, 0], both[:, 1])


def ours_of(contrasts: pd.DataFrame) -> pd.Series:
    """Return our differences: confirmed, or explored."""
    return contrasts["confirmed"].fillna(contrasts["explored"])


def _share_interval(alike: Values, every: Values) -> tuple[float, float]:
    """The 95 % interval of a share whose tables, with `alike` of `every` contrasts, are redrawn."""
    if len(every) < 2:
        return math.nan, math.nan
    places = numpy_generator(0, "signs").integers(0, len(every), (DRAWS, len(every)))
    shares = alike[places].sum(1) / every[places].sum(1)
    low, high = np.quantile(shares, [0.025, 0.975])
    return float(low), float(high)
