"""Compare the statistics of two data sets, such as synthetic and real pairs.

Two tables: the level of each quantity with the ratio of both, and the premises of SpatialSeg
(`claims`) with the verdict on each data set.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.claims import claims
from analysis.statistics.data import ALL, MODALITIES, SpatialStatistics
from analysis.statistics.derive import entropies, entropy_of, occupancy_of
from analysis.statistics.judging import Finding
from analysis.statistics.resampling import ConsecutiveBlocks, ValueInterval, snr_samples
from analysis.statistics.tables import SHORT, digits, range_text
from rgbt.checks import InputError
from rgbt.tables import ABSENT, TextTable

Floats = NDArray[np.float64]


class Resampling(NamedTuple):
    """Arguments of `claims`: confidence, images per block, number of resamples, seed."""

    level: float = 0.95
    blocks: int = 10
    resamples: int = 2000
    seed: int = 0


def comparison_grids(
    first: SpatialStatistics,
    second: SpatialStatistics,
    way: tuple[str, str],
    resampling: Resampling,
) -> tuple[TextTable, TextTable]:
    """Levels of both data sets with their ratio, and the premises with both verdicts.

    The data sets are independent samples: the interval of a ratio combines the relative standard
    errors of both.

    Args:
        first: statistics of the data set in question.
        second: statistics of the one that it is compared with.
        way: estimator of the noise, and average of the signal-to-noise ratios.
        resampling: of the blocks of both.

    Raises:
        InputError: they differ in classes, regions or kernel.
    """
    _check_alike(first, second)
    names = f"{first.dataset}, {first.split}", f"{second.dataset}, {second.split}"
    levels = [dict(_levels(stats, way, resampling)) for stats in (first, second)]
    rows = [
        (what, _cell(one), _cell(levels[1][what]), *_ratio(one, levels[1][what]))
        for what, one in levels[0].items()
        if what in levels[1]
    ]
    percent = f"{100 * resampling.level:g} % interval"
    header = ("mean over regions", *names, "ratio", percent)
    judged = [
        {
            (claim.statement, claim.estimator, claim.average, _name(finding)): finding
            for claim in claims(stats, **resampling._asdict())
            if (claim.estimator, claim.average) in (("", ""), way)
            for finding in claim.findings
        }
        for stats in (first, second)
    ]
    premises: list[tuple[str, ...]] = []
    stated = ""
    for key, finding in judged[0].items():
        if key[0] != stated:
            stated = key[0]
            premises.append((stated, "", "", "", "", ""))
        other = judged[1].get(key)
        cells = (*_verdict(finding), *(_verdict(other) if other else (ABSENT, ABSENT)))
        premises.append((f"   {key[3]}", range_text(finding.wanted), *cells))
    return (
        TextTable("levels of both data sets", header, tuple(rows)),
        TextTable(
            "premises of SpatialSeg, Sec. III, on both data sets",
            ("premise", "claimed", names[0], "holds", names[1], "holds"),
            tuple(premises),
        ),
    )


def _check_alike(first: SpatialStatistics, second: SpatialStatistics) -> None:
    for what, one, other, advice in (
        ("the classes", first.classes, second.classes, "compare data sets with the same classes"),
        (
            "the background classes",
            first.background or "none",
            second.background or "none",
            "state the same dataset.background for both",
        ),
        ("the regions", first.partition, second.partition, "measure both with the same regions"),
        ("the kernel", first.kernel, second.kernel, "measure both with the same kernel"),
        (
            "the image sizes",
            first.region_map.shape,
            second.region_map.shape,
            "measure both with the same short_edge",
        ),
    ):
        if one != other:
            raise InputError(
                f"against: {what} differ ({_text(one)} of {first.dataset}, {_text(other)} of "
                f"{second.dataset}); {advice}."
            )


def _text(value: object) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _levels(
    stats: SpatialStatistics, way: tuple[str, str], resampling: Resampling
) -> Iterator[tuple[str, ValueInterval]]:
    """Every quantity that both data sets can have, by its name."""
    level, size, resamples, seed = resampling
    blocks = ConsecutiveBlocks(stats, size=size, resamples=resamples, seed=seed)

    def of(samples: Floats, part: str = ALL) -> ValueInterval:
        return blocks.interval(samples, part, level=level, scale="ratio")

    labels = blocks.mean(stats.labels)
    pixels = labels.sum((1, 2))
    if stats.background:
        yield "occupancy, %", of(100 * occupancy_of(labels.sum(1), stats.is_background))
    for index in stats.objects:
        share = 100 * labels[:, :, index].sum(1) / pixels
        yield f"{stats.classes[index]}, % of the pixels", of(share)
    for index in stats.objects:
        shown = stats.labels[:, :, index].sum(1) > 0
        yield f"{stats.classes[index]}, % of the images", of(100 * blocks.mean(shown.astype(float)))
    word = entropies(stats)[-1][0]
    entropy = entropy_of(labels[..., ~stats.is_background])
    yield f"{' '.join(['label entropy', *word.split()])}, bits", of(entropy.mean(1))
    for part in stats.subsets()[1:] or (ALL,):
        measures = {
            "mean, grey levels": blocks.mean(stats.mean, part),
            "Laplacian variance": blocks.mean(stats.laplacian, part),
            "noise, grey levels": blocks.mean(stats.noise[way[0]], part),
            "signal to noise": snr_samples(stats, blocks, part, *way),
        }
        for what, values in measures.items():
            for index, modality in enumerate(MODALITIES):
                yield f"{what}, {modality}, {part}", of(values[:, index].mean(1), part)


def _name(finding: Finding) -> str:
    """What is measured; which step is the largest differs between data sets."""
    is_step = finding.what.startswith("largest step")
    return finding.what.rpartition(" (")[0] if is_step else finding.what


def _ratio(above: ValueInterval, below: ValueInterval) -> tuple[str, str]:
    """Ratio of two independent quantities and its interval, from both on the logarithmic scale."""
    if below.value == 0 or not math.isfinite(below.value):
        return ABSENT, ABSENT
    ratio = above.value / below.value
    ends = (above.low, above.high, below.low, below.high)
    if above.value <= 0 or not all(end > 0 for end in ends):
        return digits(ratio), ABSENT
    reach = math.hypot(math.log(above.high / above.low) / 2, math.log(below.high / below.low) / 2)
    low, high = ratio * math.exp(-reach), ratio * math.exp(reach)
    return digits(ratio), f"[{digits(low)}, {digits(high)}]"


def _cell(interval: ValueInterval) -> str:
    if math.isnan(interval.low):
        return digits(interval.value)
    return f"{digits(interval.value)} [{digits(interval.low)}, {digits(interval.high)}]"


def _verdict(finding: Finding) -> tuple[str, str]:
    return _cell(finding.interval), SHORT[finding.verdict]
