from __future__ import annotations

import math

import numpy as np
import pytest

from analysis.statistics.claims import claims
from analysis.statistics.judging import FAILS, HOLDS, OPEN, Claim, Judge, decide, every, most
from analysis.statistics.resampling import ConsecutiveBlocks, ValueInterval
from tests.analysis.statistics.scenes import made

IMAGES = 120
NIGHT = np.arange(IMAGES) >= IMAGES // 2


def by_key(found: tuple[Claim, ...], estimator: str = "", average: str = "") -> dict[str, Claim]:
    return {c.key: c for c in found if (c.estimator, c.average) == (estimator, average)}


def spread(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    """Factors around 1 that differ a little from image to image."""
    return np.exp(0.05 * np.random.default_rng(seed).normal(size=shape))


def as_the_paper_says() -> dict[str, np.ndarray]:
    """Rings 1 to 3 that fulfil every claim; a class per column: background, car, curve, bump."""
    labels = np.zeros((IMAGES, 3, 4))
    labels[:] = [[400, 300, 200, 100], [550, 200, 130, 120], [600, 100, 120, 180]]
    laplacian = np.empty((IMAGES, 2, 3))
    laplacian[:, 0] = [300, 250, 200]
    laplacian[:, 1] = [30, 25, 20]
    laplacian[~NIGHT, 0] *= 2
    laplacian[NIGHT, 1] *= 2
    noise = np.empty((IMAGES, 2, 3))
    noise[:, 0] = [12, 11, 10]
    noise[:, 1] = [1.2, 1.1, 1.0]
    noise[NIGHT] *= 2
    return {
        "labels": (labels * spread(labels.shape)).astype(np.int64),
        "laplacian": laplacian * spread(laplacian.shape),
        "noise": noise * spread(noise.shape),
    }


def test_a_sample_as_the_paper_says() -> None:
    found = claims(made(images=IMAGES, **as_the_paper_says()))
    plain = by_key(found)
    assert set(plain) == {
        *("occupancy/falls", "classes/central", "classes/except", "classes/even"),
        *("laplacian/centre", "laplacian/modality", "laplacian/day_rgb", "laplacian/day_thermal"),
        *("entropy/with_background", "entropy/without_background"),
    }
    (even,) = plain["classes/even"].findings  # curve 0.75; car 0.667 and bump 0.741
    assert even.interval.value == pytest.approx(0.75 - (0.667 + 0.741) / 2, abs=0.01)
    plain.pop("entropy/without_background")
    assert {key: claim.verdict for key, claim in plain.items()} == dict.fromkeys(plain, HOLDS)
    for average in ("pooled", "images"):
        noisy = by_key(found, "immerkaer", average)
        assert [claim.verdict for claim in noisy.values()] == [HOLDS] * 3
        (ratio,) = noisy["snr/modality"].findings
        assert ratio.interval.value == pytest.approx(10, rel=0.02)
        assert ratio.note == "so in 3 of 3 regions"
        assert len(noisy["snr/centre"].findings) == 4


def test_a_sample_that_is_the_other_way_round() -> None:
    given = as_the_paper_says()
    turned = {name: values[..., ::-1] for name, values in given.items() if name != "labels"}
    turned["labels"] = given["labels"][:, ::-1]
    # Modalities stay, day and night change places.
    turned = {name: values[::-1].copy() for name, values in turned.items()}
    turned["noise"][:, 1] *= 20
    plain = by_key(claims(made(images=IMAGES, **turned)))
    assert plain["laplacian/modality"].verdict == HOLDS
    for key in (
        "occupancy/falls",
        "laplacian/centre",
        "laplacian/day_rgb",
        "laplacian/day_thermal",
    ):
        assert plain[key].verdict == FAILS, key
    noisy = by_key(claims(made(images=IMAGES, **turned)), "std", "pooled")
    assert {claim.verdict for claim in noisy.values()} == {FAILS}


def test_one_rise_among_falls_is_no_fall() -> None:
    labels = np.zeros((IMAGES, 4, 2))
    labels[..., 1] = [400, 200, 300, 100]
    labels[..., 0] = 1000 - labels[..., 1]
    labels = (labels * spread(labels.shape)).astype(np.int64)
    stats = made(images=IMAGES, regions=4, classes=("unlabeled", "car"), labels=labels)
    falls = by_key(claims(stats))["occupancy/falls"]
    assert [each.verdict for each in falls.findings] == [HOLDS, FAILS]
    assert falls.verdict == FAILS
    assert falls.findings[1].what == "largest step outwards, points (2 to 3)"
    assert falls.findings[1].interval.value == pytest.approx(10, abs=0.3)
    assert falls.findings[1].note == "2 of 3 steps fall"


def test_too_few_blocks_decide_nothing() -> None:
    found = claims(made(images=IMAGES, **as_the_paper_says()), blocks=15)  # 4 + 4 blocks
    assert {claim.verdict for claim in found} == {OPEN}
    assert found[0].findings[0].note == "only 4 blocks of images"


def test_a_class_of_few_blocks_decides_nothing() -> None:
    given = as_the_paper_says()
    given["labels"][20:, :, 2] = 0  # curve in 2 blocks of 10
    plain = by_key(claims(made(images=IMAGES, **given)))
    by_class = {each.what.split(":")[0]: each for each in plain["classes/central"].findings}
    assert by_class["car"].verdict == HOLDS
    assert by_class["curve"].verdict == OPEN
    assert by_class["curve"].note == "only 2 blocks of images"
    assert plain["classes/even"].verdict == OPEN
    given["labels"][..., 3] = 0
    assert "classes/except" not in by_key(claims(made(images=IMAGES, **given)))


def test_without_day_and_night() -> None:
    plain = by_key(claims(made(images=IMAGES, night=False, **as_the_paper_says())))
    assert plain["laplacian/day_rgb"].verdict == OPEN
    assert plain["laplacian/day_rgb"].findings[0].note == "no images of both day and night"
    assert plain["occupancy/falls"].verdict == HOLDS


def test_strips_have_no_centre() -> None:
    keys = set(by_key(claims(made(images=IMAGES, partition="vertical3"))))
    assert keys == {"laplacian/modality", "laplacian/day_rgb", "laplacian/day_thermal"}
    labels = np.zeros((IMAGES, 3, 4), np.int64)
    labels[..., 0] = [90, 50, 80]
    labels[..., 1] = [10, 50, 20]
    plain = by_key(claims(made(images=IMAGES, partition="horizontal3", labels=labels)))
    assert plain["occupancy/middle"].verdict == HOLDS
    assert plain["occupancy/middle"].findings[0].interval.value == pytest.approx(35)


def test_verdicts() -> None:
    above = (1.0, math.inf)
    assert decide(ValueInterval(2, 1.1, 3), above) == HOLDS
    assert decide(ValueInterval(0.5, 0.2, 0.9), above) == FAILS
    assert decide(ValueInterval(1.5, 0.9, 2), above) == OPEN
    assert decide(ValueInterval(2, math.nan, math.nan), above) == OPEN
    assert every([HOLDS, HOLDS]) == HOLDS
    assert every([HOLDS, OPEN]) == OPEN
    assert every([HOLDS, OPEN, FAILS]) == FAILS
    assert every([]) == OPEN
    assert most([HOLDS, HOLDS, FAILS]) == HOLDS
    assert most([HOLDS, FAILS]) == FAILS
    assert most([HOLDS, OPEN]) == OPEN
    assert most([FAILS, FAILS, OPEN]) == FAILS
    assert most([]) == OPEN


def test_a_mean_gets_the_t_interval_of_its_blocks() -> None:
    values = np.random.default_rng(0).normal(size=60)
    stats = made(images=60, night=False)
    blocks = ConsecutiveBlocks(stats, size=10, resamples=20_000)
    means = values.reshape(6, 10).mean(1)
    reach = 2.570581835636314 * means.std(ddof=1) / math.sqrt(6)  # t of 5 degrees, 97.5 %
    found = blocks.interval(blocks.mean(values))
    assert found.value == pytest.approx(values.mean())
    np.testing.assert_allclose(found[1:], [means.mean() - reach, means.mean() + reach], atol=0.01)


def test_freedom_is_blocks_less_strata() -> None:
    """Day and night of 3 blocks each: 6 - 2 degrees, t = 2.776; the smaller stratum enlarges."""
    blocks = ConsecutiveBlocks(made(images=30), size=5, resamples=100)
    samples = np.array([10.0, 9.0, 11.0, 9.0, 11.0])  # a standard error of 1
    found = blocks.interval(samples)
    reach = 2.7764451051977987 * math.sqrt(3 / 2)
    np.testing.assert_allclose(found, [10, 10 - reach, 10 + reach])
    by_day = blocks.interval(samples, "day")  # 3 - 1 degrees
    assert by_day.high == pytest.approx(10 + 4.302652729696142 * math.sqrt(3 / 2))


def _judge(regions: int) -> Judge:
    stats = made(images=IMAGES, regions=regions, night=False)  # 12 blocks: 11 degrees of freedom
    return Judge(stats, ConsecutiveBlocks(stats, size=10, resamples=100), 0.95)


def test_more_steps_require_higher_confidence() -> None:
    """One of 4 steps at 2.6 standard errors: t is 2.20 for one number, 2.98 for one of four."""
    error = math.sqrt(12 / 11)  # what a standard error of 1 is enlarged to
    values = np.zeros((5, 5)) + [100, 80, 60, 40, 40 - 2.6 * error]
    values[1:, 4] += [-1, 1, -1, 1]
    judge = _judge(5)
    steps = judge.largest_step("steps", values)
    assert steps.verdict == OPEN
    assert steps.what == "steps (4 to 5)"
    assert steps.interval.high == pytest.approx((2.980872430052668 - 2.6) * error)
    assert judge.finding("alone", np.diff(values)[:, 3], (-math.inf, 0.0)).verdict == HOLDS


@pytest.mark.parametrize(("regions", "third"), [(2, 1), (5, 1), (9, 3), (11, 3)])
def test_centre_and_edge_are_thirds_of_the_regions(regions: int, third: int) -> None:
    values = np.arange(1.0, regions + 1) ** 2
    judge = _judge(regions)
    assert judge.centre(values) == pytest.approx(values[:third].mean())
    assert judge.edge(values) == pytest.approx(values[regions - third :].mean())


def test_blocks_are_neighbours_in_name_within_day_and_night() -> None:
    """Images listed backwards: blocks follow the names, and never join day and night."""
    stats = made(images=10)
    blocks = ConsecutiveBlocks(stats, size=2, resamples=100)
    assert blocks.sizes() == (3, 3)
    assert blocks.sizes("day") == (3,)
    present = np.zeros(10, bool)
    present[[0, 1, 5]] = True
    assert blocks.containing(present) == 2
    night_only = blocks.mean((np.arange(10) >= 5).astype(float), "night")
    np.testing.assert_array_equal(night_only, 1)
    np.testing.assert_allclose(blocks.mean(np.arange(10.0))[0], 4.5)


@pytest.mark.slow
def test_intervals_cover_the_true_value() -> None:
    """Frames of a block share their scene; a day / night ratio of 1 is inside 95 % of the time."""
    rng = np.random.default_rng(0)
    rounds, inside, inside_without_blocks = 600, 0, 0
    for _ in range(rounds):
        scene = np.repeat(rng.normal(size=(10, 1)), 10, axis=1).ravel()
        values = np.exp(0.4 * scene + 0.2 * rng.normal(size=100))
        stats = made(images=100)
        for size in (10, 1):
            blocks = ConsecutiveBlocks(
                stats, size=size, resamples=400, seed=int(rng.integers(2**31))
            )
            ratio = blocks.mean(values, "day") / blocks.mean(values, "night")
            found = blocks.interval(ratio, scale="ratio")
            if size == 10:
                inside += found.low <= 1 <= found.high
            else:
                inside_without_blocks += found.low <= 1 <= found.high
    print(f"coverage {inside / rounds:.3f}, without blocks {inside_without_blocks / rounds:.3f}")
    assert 0.93 <= inside / rounds <= 0.99
    assert inside_without_blocks / rounds < 0.7


def test_without_background_no_claim_is_about_occupancy() -> None:
    """Road is then a class as the others, and an entropy over all classes is left."""
    labels = np.full((40, 3, 4), 100, np.int64)
    stats = made(labels=labels, classes=("road", "car", "curve", "bump"), background=())
    found = by_key(claims(stats, resamples=100))
    assert not [key for key in found if key.startswith("occupancy/")]
    assert [key for key in found if key.startswith("entropy/")] == ["entropy/all_classes"]
    assert [each.what.partition(":")[0] for each in found["classes/central"].findings] == [
        *("road", "car", "curve"),
    ]
