"""How often intervals of the variance over regions hold its true value, by their form.

Simulated splits whose true variance is known (`tests.analysis.uncertainty.simulated_regions`), and
pairs of methods on the same images. docs/explanation/counts-and-intervals.md explains them.

Run: python -m tests.benchmarks.bench_variance [trials, 300]
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from analysis.uncertainty import Interval, Resampling
from analysis.uncertainty.estimate import image_spread
from analysis.uncertainty.images import CommonImages, prepare
from analysis.uncertainty.intervals import Values, corrected, over_images
from rgbt.metrics.named import parse
from tests.analysis.uncertainty.simulated_regions import Tilted

LEVEL = 0.95
RESAMPLES = 1000
SPLITS = ((100, 1), (200, 1), (400, 1), (200, 10), (400, 10))
"""Images, and how many neighbours show one scene and are drawn together."""

TILTS = (0.0, 0.1, 0.2, 0.3, 0.5)
PAIRS = ((0.0, 0.0), (0.2, 0.2), (0.2, 0.25), (0.1, 0.3), (0.3, 0.2))
QUANTILES = ((1 - LEVEL) / 2, (1 + LEVEL) / 2)


@dataclass
class Tally:
    """Coverage and mean width of one form."""

    held: list[bool] = field(default_factory=list)
    widths: list[float] = field(default_factory=list)

    def add(self, interval: Interval, true: float) -> None:
        self.held.append(true in interval)
        self.widths.append(2 * interval.half)

    def __str__(self) -> str:
        return f"{100 * np.mean(self.held):.0f} / {np.mean(self.widths):.1f}"


def forms(
    images: CommonImages, value: float, resampled: Values, without: Values
) -> dict[str, Interval]:
    """Intervals of a variance or of a difference of variances."""
    low, high = np.quantile(resampled, QUANTILES)
    none = np.empty(0)  # without acceleration: BC
    bias, spread = float(resampled.mean()) - value, image_spread(images, resampled)
    whole = corrected(1e6, bias, spread, LEVEL)  # far from 0, so that a difference is not cut
    made = {
        "percentile": Interval(low, high),
        "basic": Interval(2 * value - high, 2 * value - low),
        "BC": over_images(value, resampled, none, method="bca", level=LEVEL),
        "BCa": over_images(value, resampled, without, method="bca", level=LEVEL),
        "without bias": Interval(whole.low - 1e6 + value, whole.high - 1e6 + value),
    }
    return {form: each for form, each in made.items() if each is not None}


def forms_of_variance(
    images: CommonImages, rows: Mapping[str, tuple[Values, ...]]
) -> dict[str, Interval]:
    """The same, cut at 0 and with the estimate inside, and forms that need a positive score."""
    points, resampled, without = rows["Var"]
    value = float(points.mean())
    made = forms(images, value, resampled, without)
    low, high = np.quantile(resampled, QUANTILES)
    made["log basic"] = Interval(value**2 / high, value**2 / low)
    made["studentised"] = _studentised(value, resampled, rows)
    return {
        form: Interval(min(max(0.0, each.low), value), max(each.high, value))
        for form, each in made.items()
    }


def _studentised(
    value: float, resampled: Values, rows: Mapping[str, tuple[Values, ...]]
) -> Interval:
    """Each resample over its own standard error, from the regions' errors to the first order."""
    regions = [name for name in rows if name.startswith("region/")]
    drawn = np.stack([rows[name][1] for name in regions], axis=-1)
    point = np.array([rows[name][0].mean() for name in regions])
    covariance = np.cov(drawn.T)

    def error(scores: Values) -> Values:
        slope = 2 * (scores - scores.mean(-1, keepdims=True)) / len(regions)
        found: Values = np.sqrt(np.einsum("...i,ij,...j", slope, covariance, slope) + 1e-12)
        return found

    low, high = np.quantile((resampled - value) / error(drawn), QUANTILES)
    own = float(error(point))
    return Interval(value - high * own, value - low * own)


def settings(block: int, seed: int) -> Resampling:
    return Resampling(resamples=RESAMPLES, blocks="none" if block == 1 else block, seed=seed)


def of_one(images: int, block: int, tilt: float, trials: int) -> dict[str, Tally]:
    """Coverage of the variance of one method."""
    method = Tilted(tilt, block=block)
    true, rng = method.true_variance, np.random.default_rng(1)
    names = ["Var", *(f"region/{number}" for number in range(1, method.regions + 1))]
    tallies: dict[str, Tally] = {}
    for seed in range(trials):
        prepared = prepare([method.draw(rng, images)], parse("Var"), settings(block, seed))
        (drawn,) = prepared.drawn([parse(name) for name in names])
        found = forms_of_variance(prepared, dict(zip(names, drawn.rows(), strict=True)))
        for form, interval in found.items():
            tallies.setdefault(form, Tally()).add(interval, true)
    return tallies


def of_two(images: int, block: int, tilts: tuple[float, float], trials: int) -> dict[str, Tally]:
    """Coverage of the difference of the variances of two methods on the same images."""
    a, b = (Tilted(tilt, block=block) for tilt in tilts)
    true, rng = b.true_variance - a.true_variance, np.random.default_rng(2)
    tallies: dict[str, Tally] = {}
    for seed in range(trials):
        pair = [[counts] for counts in a.draw(rng, images, b)]
        prepared = prepare(pair, parse("Var"), settings(block, seed))
        rows_a, rows_b = (next(drawn.rows()) for drawn in prepared.drawn([parse("Var")]))
        points, resampled, without = (b - a for a, b in zip(rows_a, rows_b, strict=True))
        for form, interval in forms(prepared, float(points[0]), resampled, without).items():
            tallies.setdefault(form, Tally()).add(interval, true)
    return tallies


def of_means(images: int, block: int, trials: int) -> dict[str, Tally]:
    """Coverage of the mIoU."""
    method, rng = Tilted(0.2, block=block), np.random.default_rng(3)
    true = method.true_miou
    tallies: dict[str, Tally] = {}
    for seed in range(trials):
        prepared = prepare([method.draw(rng, images)], parse("mIoU"), settings(block, seed))
        points, resampled, without = next(prepared.drawn([parse("mIoU")])[0].rows())
        for form, interval in forms(prepared, float(points[0]), resampled, without).items():
            tallies.setdefault(form, Tally()).add(interval, true)
    return tallies


def show(first: str, tallies: Mapping[str, Tally], *, header: bool) -> None:
    row, _, corner = first.partition("|")
    if header:
        print(f"\n| {corner} | {' | '.join(tallies)} |\n|{'---|' * (len(tallies) + 1)}")
    print(f"| {row} | {' | '.join(map(str, tallies.values()))} |", flush=True)


def main(trials: int) -> int:
    print(f"percent of {trials} trials that hold the truth / mean width; nominal {LEVEL:.0%}")
    for images, block in SPLITS:
        for tilt in TILTS:
            said = f"{images} images in scenes of {block}, true {Tilted(tilt).true_variance:.2f}"
            found = of_one(images, block, tilt, trials)
            show(f"{said}|variance over 5 regions", found, header=tilt == TILTS[0])
    for images, block in SPLITS:
        for tilts in PAIRS:
            a, b = (Tilted(tilt).true_variance for tilt in tilts)
            said = f"{images} images in scenes of {block}, {a:.1f} and {b:.1f}"
            found = of_two(images, block, tilts, trials)
            show(f"{said}|difference of two variances", found, header=tilts == PAIRS[0])
    for images, block in SPLITS:
        said = f"{images} images in scenes of {block}|mIoU"
        show(said, of_means(images, block, trials), header=(images, block) == SPLITS[0])
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 300))
