"""Profiles, heat maps, corruptions, consistency and gradients: the numbers that are drawn."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.figures.inputs import check_same_images
from analysis.figures.scores import (
    class_consistency,
    class_means,
    corrupted,
    corruption_means,
    curve_points,
    draw_bars,
    draw_consistency,
    draw_curves,
    draw_heat,
    draw_profiles,
    draw_robustness,
    gradient_curves,
    map_of,
    region_means,
)
from analysis.results import Levels, trainings
from analysis.uncertainty import Resampling
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.runs.folder import MetricLine
from tests.analysis.counts import counts_of
from tests.analysis.figures.drawn import letters, strips, texts
from tests.analysis.robust_runs import SCORES, less, write_levels
from tests.measured import differing

FAST = Resampling(resamples=200, blocks="none")


def test_gradients_by_hand() -> None:
    frame = gradient_curves(3)  # 1/4, 1/2, 3/4
    np.testing.assert_allclose(frame["value"], [np.log2(3), 0, np.log2(3), 0.5, 0, 0.5])


# Temporal, Fig. 5.


def alike(share: int, partition: str = "aligned1") -> Counts:
    """Pairs that agree on class 0 in `share` of 100 pixels; the others are class 1 in frame 2."""
    pairs = np.zeros((3, 2, 2), int)
    pairs[0, 0] = share, 100 - share
    return counts_of(pairs, partition=partition)


def test_series_by_hand_and_their_means() -> None:
    # Seeds of one variant are averaged: 80 and 90 percent.
    frame = class_consistency({"(G)": [alike(60)], "(H)": [alike(80), alike(90)]}, "released")
    assert frame["protocol"][0] == "aligned"
    np.testing.assert_allclose(frame["value"], [60, 0, 85, 0])
    np.testing.assert_allclose(frame["low"], [60, 0, 85, 0])
    np.testing.assert_allclose(frame["mean_tc"], [30, 30, 42.5, 42.5])


@pytest.mark.parametrize(
    ("partition", "union", "title", "axis"),
    [
        ("aligned1", 100, "virtual views, first frame warped into the second", "CA open"),
        ("next1", 100, "consecutive frames", "CA open"),
        (
            *("released1", 100 + 60 + 100 - 120),
            *("virtual views, frames not warped (as released)", "CA (released) open"),
        ),
    ],
)
def test_ca_is_by_the_union_of_the_protocol(
    tmp_path: Path, partition: str, union: int, title: str, axis: str
) -> None:
    frame = class_consistency({"(G)": [alike(60, partition)]}, "released")
    np.testing.assert_allclose(frame["low"], [100 * 60 / union, 0])
    found = texts(draw_consistency(frame), tmp_path)
    assert title in found
    assert any(text.endswith(axis) for text in found)


def test_predictions_of_several_kinds_are_refused() -> None:
    with pytest.raises(InputError, match="counts by aligned1 cannot be compared"):
        class_consistency({"x": [alike(60)], "y": [alike(60, "released1")]}, "released")
    with pytest.raises(InputError, match="ring2 are counts of single frames"):
        class_consistency({"x": [counts_of(np.ones((2, 2, 2), int))]}, "released")


# Regions.


def method(seed: int = 0, regions: int = 2) -> Counts:
    """40 images of 2 classes with 20 pixels of each in every region: the same labels every time."""
    right = np.random.default_rng(seed).integers(1, 20, (40, regions, 2))
    matrices = np.stack([[right[..., 0], 20 - right[..., 0]], [20 - right[..., 1], right[..., 1]]])
    return counts_of(np.moveaxis(matrices, (0, 1), (2, 3)))


def test_means_by_hand_and_over_seeds() -> None:
    first = counts_of(np.array([[[6, 2], [0, 2]], [[8, 0], [0, 2]]]))  # 62.5 and 100
    second = counts_of(np.array([[[8, 0], [0, 2]], [[6, 2], [0, 2]]]))
    frame = region_means({"grbm": [first, second, second]}, "released")
    np.testing.assert_allclose(frame["value"], [(62.5 + 200) / 3, (100 + 125) / 3])
    assert frame["mIoU"][0] == pytest.approx(50 * (14 / 16 + 4 / 6))
    assert frame["low"].isna().all()


@pytest.mark.parametrize(("seeds", "covers"), [(1, "images"), (2, "images and seeds")])
def test_intervals_cover_images_and_seeds(seeds: int, covers: str) -> None:
    frame = region_means({"m": [method(seed) for seed in range(seeds)]}, None, FAST)
    assert (frame["covers"] == covers).all()
    assert ((frame["low"] < frame["value"]) & (frame["value"] < frame["high"])).all()
    assert (frame["seeds"][0], frame["images"][0]) == (seeds, 40)


def test_methods_that_are_measured_differently_are_a_remark(
    capsys: pytest.CaptureFixture[str],
) -> None:
    every = [method(), differing(method(1), view="thermal"), method(2)]
    assert check_same_images(every) is every[0]
    assert "is measured differently (view: rgbt, thermal)" in capsys.readouterr().err
    check_same_images(every, alike=False)
    check_same_images([method(), method(1)])
    assert capsys.readouterr().err == ""


def test_partitions_by_name() -> None:
    for name, regions in (("ring5", strips(5, "ring")), ("vertical4", strips(4))):
        np.testing.assert_array_equal(map_of(name, (48, 64)), regions.map((48, 64)))
    assert map_of("ring9_released_3_4", (480, 640)).max() == 8
    with pytest.raises(InputError, match="'rings' is not a partition"):
        map_of("rings", (48, 64))


def test_heat_maps_share_one_scale_and_show_their_values(tmp_path: Path) -> None:
    frame = region_means({"a": [method(0)], "b": [method(1)]}, None)
    frame["value"] = [10, 90, 50, float("nan")]
    figure = draw_heat(frame, (48, 64))
    first, second = (axes.images[0] for axes in figure.axes[:2])
    assert first.get_clim() == second.get_clim() == (10, 90)
    inner = strips(2, "ring").map((48, 64)) == 0
    np.testing.assert_array_equal(first.get_array(), np.where(inner, 10, 90))
    assert {"10.0", "90.0", "-", "mIoU of the region (%)"} <= set(texts(figure, tmp_path))


@pytest.mark.parametrize("number", [2, 3])
def test_profiles_say_what_their_intervals_cover(tmp_path: Path, number: int) -> None:
    methods = {f"m{n}": [method(n)] for n in range(number)}
    frame = region_means(methods, None, FAST)
    figure = draw_profiles(frame, 0.95)
    found = texts(figure, tmp_path)
    assert {"95 % intervals over images", "1 seed, 40 images", "region (ring2)"} <= set(found)
    assert f"m1 (mIoU {frame['mIoU'][2]:.1f})" in found
    assert len(figure.axes[0].collections) == number  # bands of two, bars of three


def test_bars_of_classes_are_means_over_seeds(tmp_path: Path) -> None:
    first = counts_of(np.array([[[6, 2], [0, 2]]]), unscored=("class1",))
    second = counts_of(np.array([[[8, 0], [1, 1]]]), unscored=("class1",))
    frame = class_means({"grbm": [first, second], "crm": [second]}, "released")
    assert frame["tick"].tolist() == [*["class0"] * 2, *["class1 (not in means)"] * 2]
    values = [(75 + 800 / 9) / 2, 800 / 9, (50 + 50) / 2, 50]
    np.testing.assert_allclose(frame["value"], values)
    found = texts(draw_bars(frame, "IoU (%)"), tmp_path)
    assert {"class0", "grbm", "crm", "IoU (%)", "88.9", "50.0"} <= set(found)


def test_curves_have_a_panel_for_loss_and_validation(tmp_path: Path) -> None:
    lines = [
        MetricLine(10, "train", 0.0, {"loss": 2.0}),
        MetricLine(10, "val", 0.0, {"mIoU": 0.25}),
        MetricLine(20, "train", 0.0, {"loss": 1.0}),
        MetricLine(20, "test", 0.0, {"mIoU": 0.5}),
    ]
    frame = curve_points({"a $cost": lines, "b": lines[:1]})
    assert frame[["series", "x", "value"]].to_numpy().tolist() == [
        *(["a $cost", 10, 2.0], ["a $cost", 10, 25.0], ["a $cost", 20, 1.0], ["b", 10, 2.0])
    ]
    found = texts(draw_curves(frame), tmp_path)
    assert {"training loss", "validation mIoU (%)", "step", "a $cost", "b"} <= set(found)
    with pytest.raises(InputError, match="no loss and no validation"):
        curve_points({"a": lines[3:]})


# Corruptions.


@pytest.fixture
def training(tmp_path: Path) -> object:
    def made(name: str, scores: dict) -> Levels:
        ((_, found),) = trainings(str(write_levels(tmp_path / name, scores)))
        return found

    return made


@pytest.fixture
def methods(training) -> dict[str, list[Levels]]:
    two_images = {key: score for key, score in less(20).items() if key[0] != "thermal"}
    return {
        "CRM": [training("a", SCORES), training("b", less(10))],
        "RTFNet": [training("c", two_images)],
    }


def test_mean_deviation_and_share_of_clean(methods) -> None:
    frame = corrupted(methods, "released").set_index(["row", "severity", "method"])
    assert len(frame) == 9  # five of CRM, four of RTFNet
    noisy, single = frame.loc["noise", 16, "CRM"], frame.loc["noise", 16, "RTFNet"]
    assert noisy["mIoU"] == pytest.approx(35, abs=1e-3)
    assert noisy["mIoU_sd"] == pytest.approx(10 / np.sqrt(2), abs=1e-3)  # 40 and 30
    # 40 / 80 and 30 / 70 of the own clean score.
    assert noisy["relative"] == pytest.approx(100 * (40 / 80 + 30 / 70) / 2, abs=1e-2)
    spread = 100 * (40 / 80 - 30 / 70) / np.sqrt(2)
    assert noisy["relative_sd"] == pytest.approx(spread, abs=1e-2)
    assert (noisy["seeds"], noisy["unit"]) == (2, "grey levels (std)")
    assert single["mIoU"] == pytest.approx(20, abs=1e-3)
    assert np.isnan(single["mIoU_sd"])
    shown = corrupted(methods, "released", ["rgb_removed"])
    assert [*shown["row"].unique()] == ["clean", "rgb_removed"]


def test_bars_of_corruptions_are_means_over_severities(methods) -> None:
    frame = corruption_means(corrupted(methods, None)).set_index(["tick", "series"])["value"]
    assert frame["noise, RGB and thermal", "CRM"] == pytest.approx((55 + 35) / 2, abs=1e-3)
    assert frame["clean", "RTFNet"] == pytest.approx(60, abs=1e-3)


@pytest.mark.parametrize("score", ["mIoU", "relative"])
def test_draws_every_panel_with_its_unit_and_methods(methods, tmp_path: Path, score: str) -> None:
    figure = draw_robustness(corrupted(methods, None), score)
    found = texts(figure, tmp_path)
    assert {"one image missing", "noise, RGB and thermal", "grey levels (std)"} <= set(found)
    assert {"CRM (2 seeds)", "RTFNet (1 seed)", "16", "clean"} <= set(found)
    assert ("% of clean mIoU" in found, "mIoU (%)" in found) == (score != "mIoU", score == "mIoU")
    assert min(letters(figure, tmp_path)) >= 7
    curves, _ = figure.axes
    dashed = [line for line in curves.lines if line.get_linestyle() == "--"]
    clean = [75, 60] if score == "mIoU" else [100, 100]
    assert [line.get_ydata()[0] for line in dashed] == pytest.approx(clean, abs=1e-3)
    drawn = [line.get_ydata() for line in curves.lines if line.get_marker() != "None"]
    expected = [75, 55, 35] if score == "mIoU" else [100, 60 / 1.6 + 50 / 1.4, 46.43]
    np.testing.assert_allclose(drawn[0], expected, atol=0.01)


def test_a_method_that_was_not_measured_keeps_its_colour(training) -> None:
    few = {key: score for key, score in SCORES.items() if key[0] in ("clean", "rgb_removed")}
    methods = {"few": [training("a", few)], "all": [training("b", less(10))]}
    figure = draw_robustness(corrupted(methods, None, ["noise"]))
    lines = {line.get_label(): line for line in figure.axes[0].lines}
    assert len(lines["few (1 seed)"].get_ydata()) == 1
    assert lines["all (1 seed)"].get_color() == "#D55E00"
    partly = corrupted({"ours": [training("c", few), training("d", SCORES)]}, None)
    assert [*partly["row"]] == ["clean", "rgb_removed"]


def test_incompatible_inputs_are_refused(training, methods) -> None:
    def ladder(*severities: float) -> dict:
        own = {("noise", "noise", "std", severity): 50 for severity in severities}
        return {("clean", "clean", "", 0.0): 80, **own}

    short, long = training("s", ladder(8.0)), training("l", ladder(8.0, 16.0))
    for both in ({"x": [short, long]}, {"x": [short], "y": [long]}):
        with pytest.raises(InputError, match=r"noise was measured at .*\[8.0\].*\[8.0, 16.0\]"):
            corrupted(both, "released")
    with pytest.raises(InputError, match="'nois' was not measured; did you mean 'noise'"):
        corrupted(methods, "released", ["nois"])
    clean, noisy = short
    cut = clean, replace(noisy, counts=noisy.counts.select(["00000D"]))
    with pytest.raises(InputError, match="not of the same images"):
        corrupted({"x": [cut]}, "released")
