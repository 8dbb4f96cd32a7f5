"""What SpatialSeg, Sec. III, says about a data set (``statements.yaml``), judged on another one.

Centre and edge are the inner and the outer third of the regions (regions 1 to 3 and 7 to 9 of
nine): the paper says "central regions" and gives no number. Statements that need the predictions of
a network are claims of its tables.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.statistics.collect import ALL, MODALITIES
from analysis.statistics.measure import ESTIMATORS
from analysis.statistics.resampled import AVERAGES, ResampledSplit, Values, entropies, normalised
from analysis.uncertainty.verdicts import Rule, decide
from rgbt.files.yaml_files import read_yaml
from rgbt.metrics.names import DAY, NIGHT

STATEMENTS: list[dict[str, Any]] = read_yaml(Path(__file__).with_name("statements.yaml"))

# The class that the paper excepts from "most classes are concentrated in the centre", and the one
# that it names as more evenly distributed.
EXCEPT, EVEN = "bump", "curve"

# Open range as stated -> of the number that is judged, which of a quotient is the logarithm.
RANGES = {
    "> 0": (0.0, math.inf),
    "< 0": (-math.inf, 0.0),
    "> 1": (0.0, math.inf),
    "< 1": (-math.inf, 0.0),
    "about 10": (math.log(10) / 2, math.log(10) * 3 / 2),
}


COLUMNS = [
    *("key", "place", "statement", "estimator", "average", "verdict", "contrast"),
    *("value", "low", "high", "wanted", "finding", "blocks"),
]
# Kinds of contrasts that need rings, two of them or more.
NEEDS_CENTRE = (
    *("falls", "central", "central_except", "even", "centre_edge"),
    *("centre_edge_by_part", "centre_less_edge"),
)


class StatedNumber(NamedTuple):
    """One number of a statement, (1 + B,) with its resamples.

    Attributes:
        part: of the images that it comes from.
        present: (N,) the images that say anything about it; None: all.
        limit: largest value that it can have.
    """

    what: str
    values: Values
    part: str = ALL
    present: NDArray[np.bool_] | None = None
    limit: float = math.inf


def judged(sample: ResampledSplit) -> pd.DataFrame:
    """Decide every statement that the data can speak to by `analysis.uncertainty.verdicts`.

    Levels are those of single statements. Statements about noise appear once per estimator and
    average, those about sample occupancy only where a class is background.

    Returns:
        a row per contrast: key, place, statement, estimator, average, verdict (of the statement:
        "holds", "contradicted", "undecided"), contrast, value, low, high (NaN: too few blocks),
        wanted, finding (verdict of this contrast alone), blocks.
    """
    rows = []
    for stated in STATEMENTS:
        ways = product(ESTIMATORS, AVERAGES) if stated["quantity"] == "snr" else [("", "")]
        for way in ways:
            about = stated["key"], stated["place"], stated["says"], *way
            of_way = sample.by(way) if way[0] else sample
            rows += [(*about, *row) for row in _decided(of_way, stated)]
    return pd.DataFrame(rows, columns=COLUMNS)


def _decided(sample: ResampledSplit, stated: dict[str, Any]) -> Iterator[tuple[object, ...]]:
    """Yield the numbers of a statement, with its verdict and their own intervals and verdicts."""
    assert sample.settings is not None, "a verdict needs resamples"
    wanted, rule = RANGES[stated["wanted"]], Rule(level=sample.settings.level)
    found = [*_stated_numbers(sample, stated)]
    evidences = [sample.evidence(number.values, number.part, number.present) for number in found]
    if not found:
        return
    whole = decide(evidences, wanted, rule, stated.get("combine", "all")).kind
    for stated_number, evidence in zip(found, evidences, strict=True):
        alone = decide([evidence], wanted, rule, "all")
        half = alone.smallest  # NaN without an interval
        numbers = alone.estimate + np.array([0.0, -half, half])
        numbers = np.clip(numbers, -stated_number.limit, stated_number.limit)
        if stated["wanted"] not in ("> 0", "< 0"):
            numbers = np.exp(numbers)
        of_number = stated["wanted"], alone.kind, evidence.blocks
        yield whole, stated_number.what, *numbers.tolist(), *of_number


def thirds(values: Values) -> tuple[Values, Values]:
    """Average the inner and the outer third of the last axis, at least one region each."""
    third = max(1, values.shape[-1] // 3)
    return np.asarray(values[..., :third].mean(-1)), np.asarray(values[..., -third:].mean(-1))


def _stated_numbers(sample: ResampledSplit, stated: dict[str, Any]) -> Iterator[StatedNumber]:
    """Yield the numbers of a statement; none where the regions or the images lack them."""
    stats, kind, quantity = sample.stats, stated["contrast"], stated["quantity"]
    has_centre = stats.partition.startswith("ring") and stats.num_regions > 1
    is_known = stats.background or quantity != "occupancy"
    if not is_known or (kind in NEEDS_CENTRE and not has_centre):
        return
    if quantity == "occupancy":
        yield from _of_occupancy(sample, kind)
    elif quantity == "classes":
        yield from _of_classes(sample, kind)
    elif quantity == "entropy":
        for word, background in entropies(stats):
            centre, edge = thirds(sample.entropy(background=background))
            yield StatedNumber(f"{word}: centre - edge, bits", centre - edge)
    else:
        yield from _of_images(getattr(sample, quantity), stats.subsets(), stated)


def _of_occupancy(sample: ResampledSplit, kind: str) -> Iterator[StatedNumber]:
    occupancy, middle = 100 * sample.occupancy(), sample.stats.num_regions // 2
    if kind == "falls":
        centre, edge = thirds(occupancy)
        yield StatedNumber("centre - edge, points", centre - edge)
        for region, step in enumerate(-np.diff(occupancy).T, 1):
            yield StatedNumber(f"region {region} - region {region + 1}, points", step)
    elif sample.stats.partition.startswith("horizontal") and sample.stats.num_regions > 2:
        ends = (occupancy[:, 0] + occupancy[:, -1]) / 2
        yield StatedNumber("middle - mean of the ends, points", occupancy[:, middle] - ends)


def _of_images(
    by_region: Callable[[str], Values], parts: Sequence[str], stated: dict[str, Any]
) -> Iterator[StatedNumber]:
    """Yield quotients of (1 + B, 2, R) values: of regions, modalities, or day and night."""
    kind, which = stated["contrast"], stated.get("modalities", MODALITIES)
    if kind in ("rgb_thermal", "thermal_rgb"):
        means, above = by_region(ALL).mean(-1), MODALITIES.index(kind.partition("_")[0])
        yield StatedNumber(kind.replace("_", " / "), _log(means[:, above], means[:, 1 - above]))
    elif kind == "day_night" and len(parts) > 1:
        day, night = (by_region(part).mean(-1) for part in (DAY, NIGHT))
        for name in which:
            index = MODALITIES.index(name)
            yield StatedNumber(f"{name}: day / night", _log(day[:, index], night[:, index]))
    elif kind != "day_night":
        apart = parts[1:] if kind == "centre_edge_by_part" else ()
        for name, part in product(which, apart or (ALL,)):
            centre, edge = thirds(by_region(part)[:, MODALITIES.index(name)])
            yield StatedNumber(f"{name}, {part}: centre / edge", _log(centre, edge), part)


def _of_classes(sample: ResampledSplit, kind: str) -> Iterator[StatedNumber]:
    """Yield where each class lies (1 central, 0 even, -1 outside), or how even one class is.

    Evenness: mean over regions of the occupancy as Fig. 3 normalises it, 1 where all are equal.
    """
    stats, occupancy = sample.stats, sample.classes()
    present = np.asarray(stats.labels.any(1))
    occurs = {stats.classes[k]: k for k in stats.objects if present[:, k].any()}
    if kind == "even" and EVEN in occurs and len(occurs) > 1:
        own, others = occurs[EVEN], [k for name, k in occurs.items() if name != EVEN]
        evenness = normalised(occupancy).mean(-1)
        above = evenness[:, own] - evenness[:, others].mean(-1)
        what = f"evenness of {EVEN} - mean evenness of the others"
        yield StatedNumber(what, above, present=present[:, own])
    for name, k in occurs.items() if kind != "even" else ():
        if (name == EXCEPT) == (kind == "central_except"):
            centre, edge = thirds(occupancy[:, k])
            with np.errstate(invalid="ignore"):
                share = (centre - edge) / (centre + edge)
            what = f"{name}: (centre - edge) / (centre + edge)"
            yield StatedNumber(what, share, present=present[:, k], limit=1.0)


def _log(above: Values, below: Values) -> Values:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.log(above / below))
