"""Resampled counts against loops over images."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from analysis.uncertainty import Resampling
from analysis.uncertainty import images as room
from analysis.uncertainty.images import CommonImages, _influence, prepare
from analysis.uncertainty.same_images import common
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import parse, value
from tests.analysis.uncertainty.simulated import Population, counts_of, pairs_of

METRICS = ("mIoU", "Var", "region/2", "class/car", "class/cone/acc", "class/cone/region/1")
ASKED = [parse(metric) for metric in METRICS]
FEW = Resampling(resamples=100, blocks="none")


def drawn(images: int = 14, trainings: int = 2, seed: int = 0, **changes) -> list[Counts]:
    array = Population(**changes).draw(np.random.default_rng(seed), images, trainings)
    return [counts_of(each) for each in array]


def weighted(counts: Counts, weights: np.ndarray) -> Counts:
    """The counts with every image repeated, as a user would do it."""
    names = [
        name for name, weight in zip(counts.names, weights, strict=True) for _ in range(weight)
    ]
    return counts.select(names)


def looped(seeds: list[Counts], weights: np.ndarray, absent: str = "released") -> list[float]:
    """Mean over seeds of each metric, one training and one image at a time."""
    by_seed = [
        [value(metric, weighted(each, weights), absent) for metric in METRICS] for each in seeds
    ]
    return np.mean(by_seed, axis=0).tolist()


def recorded(monkeypatch: pytest.MonkeyPatch, method: str) -> list[np.ndarray]:
    """Arrays that the generators of `images` return from now on."""
    kept: list[np.ndarray] = []
    make = room.numpy_generator

    class Recorder:
        def __init__(self, *arguments):
            self.rng = make(*arguments)

        def __getattr__(self, name: str):
            def call(*arguments, **keywords):
                found = getattr(self.rng, name)(*arguments, **keywords)
                if name == method:
                    kept.append(found)
                return found

            return call

    monkeypatch.setattr(room, "numpy_generator", Recorder)
    return kept


# Sums.


def test_points_are_the_scores_of_each_seed():
    seeds = drawn()
    (points,) = prepare([seeds], ASKED[0], FEW).points(ASKED)
    expected = [[value(metric, each, "released") for each in seeds] for metric in METRICS]
    np.testing.assert_allclose(points, expected, rtol=1e-13)


@pytest.mark.parametrize("blocks", [1, 3, 7])
def test_block_sums_are_exact_in_any_order_of_names(blocks: int):
    rng = np.random.default_rng(0)
    array = rng.integers(0, 2**31 - 1, (70, 2, 4, 4)).astype(np.int32)
    order = rng.permutation(70)
    counts = counts_of(array)
    shuffled = counts.select([counts.names[place] for place in order])
    images = prepare([[shuffled]], ASKED[0], replace(FEW, blocks=blocks))
    ours = images.methods[0][0].reshape(-1, 2, 4, 4)
    assert ours.shape[0] == images.blocks.count
    for number in range(images.blocks.count):
        inside = [shuffled.names[p] for p in np.flatnonzero(images.blocks.index == number)]
        direct = np.zeros((2, 4, 4), object)  # Python's integers know no overflow
        for name in inside:
            direct = direct + array[counts.names.index(name)].astype(object)
        assert (ours[number] == direct.astype(np.float64)).all()
        assert ours[number].max() > 2**31 or blocks == 1


# Resamples.


@pytest.mark.parametrize(
    ("absent", "blocks", "count"),
    [("released", "none", 33), ("exclude", "none", 33), ("released", 3, 11)],
)
def test_resampled_is_the_loop_over_images(monkeypatch, absent, blocks, count: int):
    seeds, settings = drawn(33), replace(FEW, absent=absent, blocks=blocks)
    weights = recorded(monkeypatch, "multinomial")
    images = prepare([seeds], ASKED[0], settings)
    (resampled,) = images.resampled(ASKED)
    (only,) = weights
    assert only.shape == (100, count)
    assert (only.sum(1) == count).all()
    assert resampled.shape == (len(METRICS), 100)
    for number in range(0, 100, 9):
        expected = looped(seeds, only[number][images.blocks.index], absent)
        np.testing.assert_allclose(resampled[:, number], expected, rtol=1e-12)


@pytest.mark.parametrize("absent", ["released", "exclude"])
def test_pairs_of_frames_are_drawn_with_all_their_sets(monkeypatch: pytest.MonkeyPatch, absent):
    seeds = [pairs_of(14, 0.6, seed) for seed in range(2)]
    metrics = ("TC", "CA", "CA_released", "class/cone/TC")
    weights = recorded(monkeypatch, "multinomial")
    images = prepare([seeds], parse("TC"), replace(FEW, absent=absent))
    (resampled,) = images.resampled([parse(metric) for metric in metrics])
    (only,) = weights
    assert only.shape == (100, 14)
    for number in range(0, 100, 7):
        expected = [
            np.mean([value(metric, weighted(each, only[number]), absent) for each in seeds])
            for metric in metrics
        ]
        np.testing.assert_allclose(resampled[:, number], expected, rtol=1e-12)


def test_without_each_is_the_loop_over_images():
    seeds = drawn()
    (without,) = prepare([seeds], ASKED[0], FEW).without_each(ASKED)
    assert without.shape == (len(METRICS), 14)
    for place in range(14):
        weights = np.ones(14, np.int64)
        weights[place] = 0
        np.testing.assert_allclose(without[:, place], looped(seeds, weights), rtol=1e-12)


def exchanged(a: Counts, b: Counts, flags: np.ndarray) -> tuple[Counts, Counts]:
    """Predictions of the images with a flag change sides."""
    first, second = a.counts.copy(), b.counts.copy()
    for place in np.flatnonzero(flags):
        first[place], second[place] = b.counts[place], a.counts[place]
    return replace(a, counts=first), replace(b, counts=second)


@pytest.mark.parametrize(("trainings_a", "trainings_b"), [(1, 1), (2, 2), (2, 3), (4, 2), (1, 3)])
def test_swapped_is_the_loop_over_images(monkeypatch, trainings_a: int, trainings_b: int):
    """Training i of a with training i of b, each as often as the least common multiple asks."""
    rng = np.random.default_rng(0)
    most = max(trainings_a, trainings_b)
    arrays = Population().pair(rng, 12, most, Population(skill=2.0))
    a = [counts_of(each) for each in arrays[0][:trainings_a]]
    b = [counts_of(each) for each in arrays[1][:trainings_b]]
    flags = recorded(monkeypatch, "integers")
    swapped_a, swapped_b = prepare([a, b], ASKED[0], FEW).swapped(ASKED)
    only = flags[0]
    assert only.shape == (100, 12)
    assert len(flags) == math.lcm(trainings_a, trainings_b)
    assert all((each == only).all() for each in flags)  # every pair sees the same exchanges
    for number in range(0, 100, 23):
        pairs = [
            exchanged(a[place % trainings_a], b[place % trainings_b], only[number])
            for place in range(math.lcm(trainings_a, trainings_b))
        ]
        ones = np.ones(12, np.int64)
        for found, side in ((swapped_a, 0), (swapped_b, 1)):
            expected = looped([pair[side] for pair in pairs], ones)
            np.testing.assert_allclose(found[:, number], expected, rtol=1e-12)


# Draws.


def numbers(images: CommonImages) -> np.ndarray:
    return np.concatenate([*images.resampled(ASKED), *images.swapped(ASKED)])


def test_numbers_do_not_depend_on_the_chunk(monkeypatch: pytest.MonkeyPatch):
    """How many resamples fit into the cache is nothing that a result may hang on."""
    a, b = drawn(seed=0), drawn(seed=0, skill=2.0)
    settings = replace(FEW, resamples=230)
    whole = numbers(prepare([a, b], ASKED[0], settings))
    monkeypatch.setattr(room, "CHUNK", 97)
    cut = numbers(prepare([a, b], ASKED[0], settings))
    assert whole.shape == cut.shape == (4 * len(METRICS), 230)
    np.testing.assert_array_equal(cut, whole)


def test_order_of_the_other_counts_does_not_matter():
    a, b = drawn(seed=0), drawn(seed=0, skill=2.0)
    names = np.random.default_rng(5).permutation(a[0].names).tolist()
    first = prepare([a, b], ASKED[0], FEW)
    second = prepare(
        [[a[0], a[1].select(names)], [each.select(names) for each in b]], *(ASKED[0], FEW)
    )
    np.testing.assert_array_equal(numbers(first), numbers(second))


# Day and night.


def by_day(counts: Counts, at_night: list[bool]) -> Counts:
    return replace(counts, night=tuple(at_night))


def test_day_and_night_are_over_their_own_images():
    at_night = [place % 3 == 0 for place in range(30)]
    counts = by_day(drawn(30, 1)[0], at_night)
    for part, wanted in (("day", False), ("night", True)):
        names = [n for n, dark in zip(counts.names, at_night, strict=True) if dark == wanted]
        asked, plain = parse(f"{part}/Var"), parse("Var")
        images = prepare([[counts]], asked, FEW)
        alone = prepare([[replace(counts, night=None).select(names)]], plain, FEW)
        assert images.images == len(names)
        np.testing.assert_array_equal(images.methods[0], alone.methods[0])
        np.testing.assert_array_equal(images.resampled([asked])[0], alone.resampled([plain])[0])


# Refusals.

DARK = tuple(place % 2 == 0 for place in range(12))


def changed_label(counts: Counts) -> Counts:
    array = counts.counts.copy()
    array[7, 1, 0, 2] += 1
    return replace(counts, counts=array)


@pytest.mark.parametrize(
    ("change", "metric", "word"),
    [
        (lambda b: replace(b, classes=("road", "car", "person", "tree")), "mIoU", "person, tree; "),
        (lambda b: replace(b, partition="ring5"), "mIoU", "by ring2 cannot be compared .* ring5"),
        (lambda b: replace(b, partition="ring1", counts=b.counts[:, :1]), "mIoU", "by ring1"),
        (lambda b: b.select(b.names[:-1]), "mIoU", "12 .* against 11 .* '00011D' .*leave_out"),
        (lambda b: replace(b, names=tuple(f"1{n}" for n in b.names)), "mIoU", "different images"),
        (changed_label, "mIoU", "'00007D' has different labels .*1 images do"),
        (lambda b: replace(b, night=None), "night/mIoU", "'night/mIoU'"),
        # Else the nights of the one are compared with other images of the other.
        (lambda b: replace(b, night=DARK[::-1]), "night/mIoU", "night"),
        (lambda b: replace(b, night=(*DARK[:-2], False, False)), "night/mIoU", "night"),
    ],
)
def test_counts_that_cannot_be_compared_are_refused(change, metric: str, word: str):
    a, b = (replace(each, night=DARK) for each in drawn(12, 2))
    with pytest.raises(InputError, match=word):
        prepare([[a], [change(b)]], parse(metric), FEW)
    with pytest.raises(InputError):
        prepare([[change(b), a]], parse(metric), FEW)


def test_other_labels_of_pairs_of_frames():
    """The label says which matrix a pixel is in; both predictions may differ."""
    a, b = pairs_of(20, 0.5), pairs_of(20, 0.9, seed=1)
    prepare([[a], [b]], parse("TC"), FEW)
    changed = b.counts.copy()
    changed[7, [0, 1], 0, 0] += [-1, 1]
    with pytest.raises(InputError, match=r"'00007D' has different labels .*1 images do"):
        prepare([[a], [replace(b, counts=changed)]], parse("TC"), FEW)


# What both hold.


def test_common_images_are_in_the_order_of_the_first():
    a, b = drawn(12, 2)
    first = a.select(a.names[:9][::-1])
    (one,), (other,) = common([[first], [b.select(b.names[3:])]])
    assert one.names == other.names == a.names[3:9][::-1]
    np.testing.assert_array_equal(one.counts, a.counts[3:9][::-1])
    np.testing.assert_array_equal(other.counts, b.counts[3:9][::-1])
    # Every two share one, all three none.
    three = [a.select([a.names[i] for i in pair]) for pair in ((0, 1), (0, 2), (1, 2))]
    with pytest.raises(InputError, match="no image is in all counts"):
        common([three[:1], three[1:]])


def test_blocks_are_made_for_accuracy_and_miou_of_both_methods_and_their_difference():
    """Rows: scores of the first method, of the second, and second less first."""
    arrays = Population().pair(np.random.default_rng(0), 12, 1, Population(skill=2.0))
    methods = [[counts_of(each[0])] for each in arrays]
    single = prepare(methods, ASKED[0], replace(FEW, blocks="none"))
    auto = replace(single, settings=replace(single.settings, blocks="auto"))
    rows = _influence(auto)
    first, second = auto.without_each([parse("mIoU"), parse("pixel_accuracy")])
    assert rows.shape == (6, 12)
    np.testing.assert_allclose(rows, np.concatenate([first, second, second - first]))


def test_blocks_of_pairs_are_made_for_their_own_scores():
    counts = pairs_of(40, 0.5)
    single = prepare([[counts]], parse("TC"), FEW)
    watched = [parse("TC"), parse("CA")]
    expected = single.without_each(watched)[0]
    found = _influence(replace(single, settings=replace(FEW, blocks="auto")))
    np.testing.assert_allclose(found, expected)
