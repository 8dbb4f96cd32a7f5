"""The race of points: planted differences are decided, equal points are not."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from analysis.uncertainty import Resampling
from analysis.uncertainty.contrasts import Evidence
from analysis.uncertainty.verdicts import AnyTime, decide
from rgbt.checks import InputError
from sweeps.point import Outcome, Point
from sweeps.table.cells import OWN_COUNTS
from sweeps.verdicts.best_point import (
    ERROR_RATE,
    BestPointJudge,
    Race,
    ScoreFile,
    fewest_seeds,
    level_of,
)
from sweeps.verdicts.judge import CellRunId
from tests.sweeps.verdicts.planted import planted_outcome

POINT = Point("p", ())


def judge(*labels: str, maximize: bool = True) -> BestPointJudge:
    files = dict.fromkeys(labels, ScoreFile(metric="pixel_accuracy", path=OWN_COUNTS))
    return BestPointJudge(files, maximize=maximize, settings=Resampling(resamples=200))


def runs(means: Mapping[str, float], seeds: int) -> dict[CellRunId, Outcome]:
    return {
        (label, seed): planted_outcome(POINT, mean, label, seed)
        for label, mean in means.items()
        for seed in range(1, seeds + 1)
    }


CLEAR = {"#1": 60.0, "#2": 80.0, "#3": 70.0}


@pytest.mark.parametrize(("maximize", "best", "second"), [(True, "#2", "#3"), (False, "#1", "#3")])
def test_race_clear_differences_are_decided(maximize: bool, best: str, second: str) -> None:
    race = judge(*CLEAR, maximize=maximize).race(runs(CLEAR, fewest_seeds(3)))
    assert (race.leader, race.open, race.is_decided) == (best, [best], True)
    standings = {each.label: each for each in race.standings}
    assert {each.worse_than for each in race.standings} == {"", best}
    found = standings[second].difference
    assert found is not None
    assert found.interval is not None
    assert found.estimate == pytest.approx(CLEAR[second] - CLEAR[best], abs=1.5)
    assert found.interval.low < found.estimate < found.interval.high
    assert race.level == pytest.approx(0.975)


def test_race_one_seed_below_the_fewest_decides_nothing() -> None:
    race = judge(*CLEAR).race(runs(CLEAR, fewest_seeds(3) - 1))
    assert (race.leader, race.open, race.is_decided) == ("#2", list(CLEAR), False)


def test_race_equal_points_stay_while_a_bad_one_leaves() -> None:
    means = {"#1": 70.0, "#2": 70.0, "#3": 50.0}
    race = judge(*means).race(runs(means, 10))
    assert race.open == ["#1", "#2"]
    assert not race.is_decided
    (other,) = (each for each in race.standings if each.label in race.open and each.difference)
    assert other.difference is not None
    assert other.difference.kind == "undecided"


def test_race_differences_use_the_seeds_that_both_have() -> None:
    every = runs(CLEAR, 6)
    del every["#3", 2], every["#3", 3]
    every["#3", 3] = Outcome(POINT, "failed", "no memory")
    race = judge(*CLEAR).race(every)
    third = race.standings[2]
    assert (third.seeds, third.difference and third.difference.seeds) == ((1, 4, 5, 6), 4)
    assert third.reason == "a run failed: no memory"


def test_race_without_common_seeds_has_no_difference() -> None:
    every = runs(CLEAR, 2)
    every = {each: run for each, run in every.items() if each != ("#1", 1)}
    every = {each: run for each, run in every.items() if each[0] != "#3"}
    every.pop(("#2", 2))
    race = judge(*CLEAR).race(every)
    assert (race.leader, race.is_decided) == ("#2", False)
    assert [each.difference for each in race.standings] == [None, None, None]
    assert judge(*CLEAR).race({}) == Race(
        standings=tuple(replace(each, seeds=()) for each in race.standings),
        leader="",
        level=race.level,
    )


def test_race_other_images_raise() -> None:
    every = runs({"#1": 60.0, "#2": 70.0}, 4)
    (result,) = every["#2", 1].results
    counts = result.counts()
    renamed = replace(counts, names=tuple(f"x{name}" for name in counts.names))
    other = replace(result, by_path={OWN_COUNTS: renamed})  # type: ignore[call-arg]
    every["#2", 1] = replace(every["#2", 1], results=(other,))
    with pytest.raises(InputError):
        judge("#1", "#2").race(every)


def test_level_shares_the_error_rate_between_the_pairs() -> None:
    for points in (2, 3, 11):
        assert (points - 1) * (1 - level_of(points)) / 2 == pytest.approx(ERROR_RATE)
    assert [fewest_seeds(points) for points in (2, 3)] == [4, 5]


def test_best_of_equal_points_is_rarely_called_worse() -> None:
    """The first of three equal points, looked at after every seed: the bound is 2.5 %."""
    generator, count, rule = np.random.default_rng(0), 150, AnyTime(level=level_of(3))
    wrong = 0
    for _ in range(count):
        values = generator.normal(size=(3, 10))
        for seeds in range(5, 11):
            differences = (values[0] - values[1:])[:, :seeds]
            evidences = [_evidence(each) for each in differences]
            if any(
                decide([each], (-math.inf, 0.0), rule, "all").kind == "holds" for each in evidences
            ):
                wrong += 1
                break
    # Of 150 races, more than 9 occur with a probability below 1 % where the rate is 2.5 %.
    assert wrong <= 9


def _evidence(values: np.ndarray) -> Evidence:
    count = tuple(range(len(values)))
    return Evidence(values=tuple(values.tolist()), seeds=count, error=0.0, blocks=40, said="")
