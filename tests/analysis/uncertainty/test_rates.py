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
from tests.analysis.uncertainty.simulated_regions import Tilted

METRICS = ("mIoU", "Var", "region/1", "class/cone")
RUNS = 300
SETTINGS = Resampling(resamples=600, blocks="none")

pytestmark = pytest.mark.slow


def as_counts(array: np.ndarray) -> list[Counts]:
    return [counts_of(each) for each in array]


def true_values(population: Population) -> dict[str, float]:
    """Means over trainings of the scores over many images."""
    rng = np.random.default_rng(99)
    draws = 60 if population.training_sd else 8
    trainings = [counts_of(population.draw(rng, 3000, 1)[0]) for _ in range(draws)]
    return {
        metric: float(np.mean([value(metric, each, "released") for each in trainings]))
        for metric in METRICS
    }


def coverage(
    population: Population, images: int, trainings: int, settings: Resampling
) -> dict[str, float]:
    """Share of simulations whose widest interval holds the true value, by metric."""
    true = true_values(population)
    rng = np.random.default_rng(11)
    held = dict.fromkeys(METRICS, 0)
    for number in range(RUNS):
        seeds = as_counts(population.draw(rng, images, trainings))
        found = estimate(seeds, METRICS, replace(settings, seed=number))
        for metric in METRICS:
            interval = found[metric].both or found[metric].images
            assert interval is not None
            held[metric] += true[metric] in interval
    return {metric: count / RUNS for metric, count in held.items()}


def alarms(
    population: Population, images: int, trainings: int, settings: Resampling
) -> tuple[dict[str, float], float]:
    """Share of simulations with p <= 0.05 by metric, and with any such corrected p."""
    rng = np.random.default_rng(12)
    raised, any_of_all = dict.fromkeys(METRICS, 0), 0
    for number in range(RUNS):
        a, b = population.pair(rng, images, trainings, population)
        comparison = compare(as_counts(a), as_counts(b), METRICS, replace(settings, seed=number))
        for each in comparison.differences:
            raised[each.metric] += each.difference.p <= 0.05
        any_of_all += any(each.p_corrected <= 0.05 for each in comparison.differences)
    return {metric: count / RUNS for metric, count in raised.items()}, any_of_all / RUNS


@pytest.mark.parametrize("images", [100, 300])
def test_intervals_over_images(images: int):
    rates = coverage(Population(), images, 1, SETTINGS)
    print(images, rates)
    assert all(0.88 <= rate <= 0.99 for rate in rates.values())
    assert 0.91 <= np.mean(list(rates.values())) <= 0.97


@pytest.mark.parametrize("blocks", ["none", "auto", 10])
def test_intervals_over_correlated_neighbours(blocks):
    """Thirty scenes of ten frames: single images say far too much; "auto" is told no length."""
    rates = coverage(Population(block=10), 300, 1, replace(SETTINGS, blocks=blocks))
    print(blocks, rates)
    mean = np.mean(list(rates.values()))
    if blocks == "none":
        assert mean < 0.65
    else:
        assert mean > {"auto": 0.83, 10: 0.88}[blocks]


def test_runs_of_consecutive_numbers_are_scenes():
    """Forty scenes of eight frames with other frames between them: "auto" takes the scenes."""
    population, rates = Population(block=8), {}
    true, rng = true_values(population), np.random.default_rng(11)
    for gap in (0, 100):
        held = dict.fromkeys(METRICS, 0)
        for number in range(RUNS):
            (array,) = population.draw(rng, 320, 1)
            names = tuple(f"{place + gap * (place // 8):06d}D" for place in range(320))
            counts = replace(counts_of(array), names=names)
            settings = replace(SETTINGS, blocks="auto", seed=number)
            found = estimate([counts], METRICS, settings)
            for metric in METRICS:
                held[metric] += true[metric] in found[metric].images
        rates[gap] = float(np.mean(list(held.values()))) / RUNS
    print(rates)
    assert rates[100] > 0.91
    assert rates[100] > rates[0] > 0.83


@pytest.mark.parametrize("tilt", [0.0, 0.1, 0.2, 0.3])
@pytest.mark.parametrize("images", [100, 300])
def test_intervals_of_a_variance_of_few_regions(tilt: float, images: int):
    """True variances of 0 to 15, as in the papers' tables; quantiles never hold a true 0."""
    method, rng = Tilted(tilt), np.random.default_rng(4)
    held = 0
    for number in range(RUNS):
        found = estimate(method.draw(rng, images), ["Var"], replace(SETTINGS, seed=number))["Var"]
        assert found.value in found.images
        assert found.images.low >= 0
        held += method.true_variance in found.images
    print(images, method.true_variance, held / RUNS)
    assert held / RUNS >= (0.97 if tilt == 0 else 0.89)


@pytest.mark.parametrize("tilts", [(0.0, 0.0), (0.2, 0.2), (0.1, 0.3)])
def test_intervals_of_a_difference_of_variances(tilts: tuple[float, float]):
    a, b = (Tilted(tilt) for tilt in tilts)
    true, rng, held = b.true_variance - a.true_variance, np.random.default_rng(5), 0
    for number in range(RUNS):
        first, second = a.draw(rng, 200, b)
        settings = replace(SETTINGS, resamples=400, seed=number)
        held += (
            true in compare([first], [second], ["Var"], settings).differences[0].difference.images
        )
    print(tilts, held / RUNS)
    assert held / RUNS >= 0.9


@pytest.mark.parametrize("training_sd", [0.05, 0.15, 0.5])
@pytest.mark.parametrize("trainings", [2, 3, 5])
def test_intervals_over_images_and_seeds(training_sd: float, trainings: int):
    rates = coverage(Population(training_sd=training_sd), 100, trainings, SETTINGS)
    print(trainings, training_sd, rates)
    assert all(rate >= 0.88 for rate in rates.values())


@pytest.mark.parametrize(
    ("images", "blocks", "block"), [(20, "none", 1), (60, "none", 1), (200, "auto", 10)]
)
def test_false_alarms_over_images(images: int, blocks, block: int):
    population = Population(block=block)
    rates, any_of_all = alarms(population, images, 1, replace(SETTINGS, blocks=blocks))
    print(images, blocks, rates, any_of_all)
    assert all(rate <= 0.09 for rate in rates.values())
    assert 0.02 <= np.mean(list(rates.values())) <= 0.075
    assert any_of_all <= 0.09


@pytest.mark.parametrize("training_sd", [0.0, 0.15, 0.5])
@pytest.mark.parametrize("trainings", [2, 3])
def test_false_alarms_over_images_and_seeds(training_sd: float, trainings: int):
    rates, any_of_all = alarms(Population(training_sd=training_sd), 60, trainings, SETTINGS)
    print(trainings, training_sd, rates, any_of_all)
    assert all(rate <= 0.1 for rate in rates.values())
    assert any_of_all <= 0.1
