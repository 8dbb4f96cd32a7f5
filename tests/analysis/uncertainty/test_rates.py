"""How often intervals hold the true value, and tests raise a false alarm, on simulated methods.

Bounds are of the measured rate: nominal plus or minus what is known of each method, and three
standard errors of `RUNS` simulations.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.uncertainty import Resampling, compare, estimate
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from tests.analysis.uncertainty.simulated import Population, counts_of

METRICS = ("mIoU", "Var", "region/1", "class/cone")
RUNS = 300
SETTINGS = Resampling(resamples=600, blocks="none")

pytestmark = pytest.mark.slow


def as_counts(array: np.ndarray) -> list[Counts]:
    return [counts_of(counts) for counts in array]


def true_values(population: Population) -> dict[str, float]:
    """Means over trainings of the scores over many images."""
    rng = np.random.default_rng(99)
    draws = 60 if population.training_sd else 8
    trainings = [counts_of(population.draw(rng, 3000, 1)[0]) for _ in range(draws)]
    return {
        metric: float(np.mean([value(metric, training, "released") for training in trainings]))
        for metric in METRICS
    }


def coverage(
    population: Population, images: int, trainings: int, settings: Resampling, gap: int = 0
) -> dict[str, float]:
    """Share of simulations whose widest interval holds the true value, by metric.

    `gap`: numbers of frames between the scenes of the population.
    """
    true, rng, held = true_values(population), np.random.default_rng(11), dict.fromkeys(METRICS, 0)
    names = tuple(f"{place + gap * (place // population.block):06d}D" for place in range(images))
    for number in range(RUNS):
        seeds = [
            replace(counts, names=names)
            for counts in as_counts(population.draw(rng, images, trainings))
        ]
        found = estimate(seeds, METRICS, replace(settings, seed=number))
        for metric in METRICS:
            held[metric] += true[metric] in found[metric].interval
    print(population, images, trainings, settings.blocks, held)
    return {metric: count / RUNS for metric, count in held.items()}


@pytest.mark.parametrize("images", [100, 300])
def test_intervals_over_images(images: int) -> None:
    rates = coverage(Population(), images, 1, SETTINGS)
    assert all(0.88 <= rate <= 0.99 for rate in rates.values())
    assert 0.91 <= np.mean(list(rates.values())) <= 0.97


@pytest.mark.parametrize(
    ("block", "images", "blocks", "gap", "least", "most"),
    [
        # Thirty scenes of ten frames: single images say far too much; "auto" is told no length.
        *(
            (10, 300, "none", 0, 0.0, 0.65),
            (10, 300, "auto", 0, 0.83, 1),
            (10, 300, 10, 0, 0.88, 1),
        ),
        # Forty scenes of eight frames with other frames between them: "auto" takes the scenes.
        (8, 320, "auto", 100, 0.91, 1),
    ],
)
def test_intervals_over_correlated_neighbours(
    block: int, images: int, blocks, gap: int, least: float, most: float
) -> None:
    rates = coverage(Population(block=block), images, 1, replace(SETTINGS, blocks=blocks), gap)
    assert least < np.mean(list(rates.values())) < most


@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_intervals_of_a_variance_of_few_regions(tilt: float) -> None:
    """Also of a true 0, which quantiles of the resamples never hold."""
    rng, held = np.random.default_rng(4), 0
    true = true_values(Population(tilt=tilt))["Var"] if tilt else 0.0
    for number in range(RUNS):
        seeds = as_counts(Population(tilt=tilt).draw(rng, 100, 1))
        found = estimate(seeds, ["Var"], replace(SETTINGS, seed=number))["Var"]
        assert found.images.low >= 0
        held += true in found.images
    assert held / RUNS >= 0.89


@pytest.mark.parametrize("training_sd", [0.05, 0.5])
@pytest.mark.parametrize("trainings", [2, 5])
def test_intervals_over_images_and_seeds(training_sd: float, trainings: int) -> None:
    rates = coverage(Population(training_sd=training_sd), 100, trainings, SETTINGS)
    assert all(rate >= 0.88 for rate in rates.values())


@pytest.mark.parametrize(
    ("images", "blocks", "block", "trainings", "training_sd"),
    [
        *((20, "none", 1, 1, 0.0), (60, "none", 1, 1, 0.0), (200, "auto", 10, 1, 0.0)),
        *((60, "none", 1, 2, 0.0), (60, "none", 1, 2, 0.5), (60, "none", 1, 3, 0.15)),
    ],
)
def test_false_alarms(images: int, blocks, block: int, trainings: int, training_sd: float) -> None:
    """Share of simulations with p <= 0.05 by metric, and with any such corrected p."""
    population = Population(block=block, training_sd=training_sd)
    rng, raised, any_of_all = np.random.default_rng(12), dict.fromkeys(METRICS, 0), 0
    for number in range(RUNS):
        a, b = map(as_counts, population.pair(rng, images, trainings, population))
        settings = replace(SETTINGS, blocks=blocks, seed=number)
        found = compare(a, b, METRICS, settings).differences
        for line in found:
            raised[line.metric] += line.difference.p <= 0.05
        any_of_all += any(line.difference.p_corrected <= 0.05 for line in found)
    rates = [count / RUNS for count in raised.values()]
    print(images, blocks, trainings, training_sd, rates, any_of_all / RUNS)
    assert max(rates) <= 0.1
    assert any_of_all / RUNS <= 0.1
    if trainings == 1:
        assert 0.02 <= np.mean(rates) <= 0.075
