"""Semseg and HeatNet: every step alone, computed again with other means."""

from __future__ import annotations

from dataclasses import replace
from math import cos, radians, sin
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.assembly import training_setup
from rgbt.assembly.training_setup import TrainingSetup
from rgbt.checks import InputError
from rgbt.requirements import record_of
from rgbt.transforms.rotating import HeatNetTransform, SemsegTransform, rotated
from rgbt.types import IGNORE, Example, Sample
from tests.composed import specified
from tests.transforms.recipes import noise

HW = (64, 128)
MEAN = (123.675, 116.28, 103.53)
STILL: dict[str, Any] = {
    **{"scale_range": (1.0, 1.0), "rotate_probability": 0.0, "rotate_degrees": 10.0},
    **{"blur_probability": 0.0, "blur_kernel": 5, "flip_probability": 0.0, "crop_hw": HW},
    **{"padding_rgb": MEAN, "padding_thermal": 114.495, "test_short_edge": None},
}
NOTHING: dict[str, Any] = {
    **{"resize_hw": (32, 64), "crop_hw": (32, 56), "side_margin": 2, "flip_probability": 0.0},
    **{"rotate_probability": 0.0, "rotate_degrees": 20.0, "drop_probability": 0.0},
    **{"drop_height": (10, 30), "drop_width": (10, 50), "thermal_probability": 0.0},
    **{"class_probability": 0.0, "thermal_range": (0.1, 1.0)},
}


def sample(**changes: Any) -> Sample:
    return noise(0, HW, **changes)


def semseg(original: Sample, number: int, **changes: Any) -> Example:
    return SemsegTransform(**{**STILL, **changes}).train(original, np.random.default_rng(number))


def heatnet(original: Sample, number: int, **changes: Any) -> Example:
    made = HeatNetTransform(**{**NOTHING, **changes})
    return made.train(original, np.random.default_rng(number))


# ---- semseg ---------------------------------------------------------------------------------


@pytest.mark.parametrize("number", range(3))
def test_semseg_rotates_as_opencv(number: int) -> None:
    """About (w / 2, h / 2), with the mean colour and ignored labels outside."""
    original = sample(label=np.full(HW, 3, np.uint8))
    found = semseg(original, number, rotate_probability=1.0)
    rng = np.random.default_rng(number)
    rng.uniform(1.0, 1.0), rng.random()
    matrix = cv2.getRotationMatrix2D((HW[1] / 2, HW[0] / 2), float(rng.uniform(-10, 10)), 1)
    size, border = (HW[1], HW[0]), {"borderMode": cv2.BORDER_CONSTANT}
    rgb = cv2.warpAffine(original.rgb.astype(np.float32), matrix, size, borderValue=MEAN, **border)
    nearest = {"flags": cv2.INTER_NEAREST, **border}
    label = cv2.warpAffine(original.label, matrix, size, borderValue=IGNORE, **nearest)
    np.testing.assert_allclose(found.rgb, rgb, atol=2e-3)
    np.testing.assert_array_equal(found.label, label)
    outside = found.label == IGNORE
    assert outside.any()
    assert not found.confidence[outside].any()
    assert found.thermal[0, 0] in (np.float32(114.495), original.thermal[0, 0])


def test_semseg_pads_with_the_mean_colour() -> None:
    """64 x 128 in 73 x 138: 4 rows above and 5 below, 5 columns at either side."""
    original = sample()
    found = semseg(original, 0, crop_hw=(73, 138))
    sides = (4, 5, 5, 5, cv2.BORDER_CONSTANT)
    rgb = cv2.copyMakeBorder(original.rgb.astype(np.float32), *sides, value=MEAN)
    np.testing.assert_allclose(found.rgb, rgb, atol=2e-3)
    label = cv2.copyMakeBorder(original.label, *sides, value=IGNORE)
    np.testing.assert_array_equal(found.label, label)
    assert found.thermal[0, 0] == np.float32(114.495)
    assert found.centre_yx == (4 + 32, 5 + 64)


def test_semseg_blurs_and_mirrors_all_maps_together() -> None:
    original = sample()
    found = semseg(original, 1, blur_probability=1.0, flip_probability=1.0)
    rgb = cv2.GaussianBlur(original.rgb.astype(np.float32), (5, 5), 0)[:, ::-1]
    np.testing.assert_allclose(found.rgb, rgb, atol=2e-3)
    np.testing.assert_array_equal(found.label, original.label[:, ::-1])
    np.testing.assert_array_equal(found.confidence, original.confidence[:, ::-1])
    assert found.centre_yx == (32, 127 - 64)


def test_semseg_crops_reach_every_place() -> None:
    place = np.add.outer(np.arange(3) * 50, np.arange(4)).astype(np.uint8)
    original = Sample(np.zeros((3, 4, 3), np.uint8), place, place, "x")
    found = [semseg(original, number, crop_hw=(2, 3)) for number in range(60)]
    assert {int(each.label[0, 0]) for each in found} == {0, 1, 50, 51}
    for each in found:
        np.testing.assert_array_equal(each.thermal, each.label)
        assert int(each.label[each.centre_yx]) == 52  # row 1, column 2, in every crop


def test_published_numbers_of_the_teacher() -> None:
    """Configuration mv_pspnet50 of the thesis' code; batch and auxiliary weight of semseg."""
    spec = specified(("+experiment=thermal_teacher_semseg", "scale=paper", "dataset.root=x"))
    made: SemsegTransform = spec.transform.build()
    assert (made.crop_hw, made.padding_rgb) == ((473, 473), MEAN)
    assert made.padding_thermal == pytest.approx(sum(MEAN) / 3)
    optimizer = spec.optimizer.values
    assert (optimizer["lr"], optimizer["backbone_multiplier"]) == (0.1, 0.1)
    assert (optimizer["momentum"], optimizer["weight_decay"]) == (0.9, 1e-4)
    assert (spec.loss.values["weight"], spec.data.batch_size) == (0.4, 16)
    assert spec.trainer.max_steps == 400 * (12170 // 16)
    assert (spec.prediction.window_hw, spec.prediction.mirrored) == ((473, 473), True)
    assert spec.schedule.build()(152000, 304000, 760) == pytest.approx(0.5**0.9)


# ---- HeatNet --------------------------------------------------------------------------------


def test_heatnet_crops_lie_between_the_margins_and_reach_both() -> None:
    """Columns 2 to 61 of 64 are shown; 56 of them begin at 2, 3, ..., 6."""
    original = sample(label=np.tile(np.arange(HW[1], dtype=np.uint8), (HW[0], 1)))
    labels = [heatnet(original, number).label for number in range(60)]
    assert all((np.diff(label[0].astype(int)) == 2).all() for label in labels)
    assert {label.shape for label in labels} == {(32, 56)}
    assert {int(label[0, 0]) // 2 for label in labels} == {2, 3, 4, 5, 6}


def rotated_by_hand(array: np.ndarray, angle: float, fill: float) -> np.ndarray:
    """Nearest, about the middle of the array, counter-clockwise; pixel after pixel."""
    height, width = array.shape
    result = np.full_like(array, fill)
    middle_y, middle_x = (height - 1) / 2, (width - 1) / 2
    c, s = cos(radians(angle)), sin(radians(angle))
    for i, j in np.ndindex(height, width):
        x, y = j - middle_x, i - middle_y
        column, row = round(c * x - s * y + middle_x), round(s * x + c * y + middle_y)
        if 0 <= row < height and 0 <= column < width:
            result[i, j] = array[row, column]
    return result


def test_heatnet_rotation_brings_in_road_and_black() -> None:
    original = sample(label=np.full(HW, 7, np.uint8), confidence=np.ones(HW, np.float32))
    for number in range(4):
        still, turned = (heatnet(original, number, rotate_probability=p) for p in (0.0, 1.0))
        # Draws in order: top, left, mirrored, rotated, angle.
        rng = np.random.default_rng(number)
        rng.integers(1), rng.integers(5), rng.random(), rng.random()
        expected = rotated_by_hand(still.label, float(rng.uniform(-20, 20)), 0)
        assert (turned.label != expected).mean() < 0.01, "ties of half pixels may differ"
        outside = expected == 0
        assert 0 < outside.mean() < 0.5
        np.testing.assert_array_equal(turned.confidence, turned.label / 7)
        inner = cv2.erode(outside.astype(np.uint8), np.ones((5, 5))) > 0
        assert not turned.rgb[inner].any()
        assert not turned.thermal[inner].any()
        bare = heatnet(replace(original, label=None), number, rotate_probability=1.0)
        assert (bare.label == IGNORE).all()


@pytest.mark.parametrize(("centre", "expected"), [((10, 25), (5, 20)), ((10, 40), (0, 20))])
def test_rotation_moves_images_and_centres_alike(
    centre: tuple[int, int], expected: tuple[int, int]
) -> None:
    """Counter-clockwise; a centre that leaves the image becomes its nearest pixel."""
    image = np.zeros((21, 41), np.float32)
    image[centre] = 1.0
    rgb, label = np.repeat(image[..., None], 3, 2), np.zeros((21, 41), np.uint8)
    example = Example(rgb, image, label, centre, None, (21, 41), "x")
    turned = rotated(example, 90.0, (20.0, 10.0), ((0, 0, 0), 0.0, IGNORE))
    assert turned.centre_yx == expected
    if expected[0]:
        assert np.unravel_index(turned.thermal.argmax(), (21, 41)) == expected


def test_heatnet_drops_one_block_of_one_image() -> None:
    original, dropped = sample(), []
    for number in range(60):
        still, example = (heatnet(original, number, drop_probability=p) for p in (0.0, 1.0))
        changed = [
            np.argwhere((new != old).any(-1) if new.ndim == 3 else new != old)
            for new, old in ((example.rgb, still.rgb), (example.thermal, still.thermal))
        ]
        assert [len(each) > 0 for each in changed].count(True) == 1
        image = int(len(changed[1]) > 0)
        (top, left), (bottom, right) = changed[image].min(0), changed[image].max(0)
        block = (example.rgb, example.thermal)[image][top : bottom + 1, left : right + 1]
        assert (block == 127.5).all()
        dropped.append((image, bottom - top + 1, right - left + 1))
    kinds, heights, widths = (np.array(each) for each in zip(*dropped, strict=True))
    assert 15 < kinds.sum() < 45
    assert (heights.min() >= 9, heights.max() <= 29) == (True, True)  # a pixel may be 127.5 before
    assert (widths.min() >= 9, widths.max() <= 49) == (True, True)


def test_heatnet_scales_thermal_about_the_middle_grey_level() -> None:
    original, factors = sample(), []
    for number in range(40):
        still, example = (heatnet(original, number, thermal_probability=p) for p in (0.0, 1.0))
        apart = np.abs(still.thermal - 127.5) > 20
        ratio = (example.thermal[apart] - 127.5) / (still.thermal[apart] - 127.5)
        assert np.ptp(ratio) < 1e-4
        factors.append(float(ratio.mean()))
        np.testing.assert_array_equal(example.rgb, still.rgb)
    assert 0.1 <= min(factors) < 0.25
    assert 0.85 < max(factors) <= 1.0


def test_heatnet_classes_have_factors_of_their_own() -> None:
    original = sample(label=np.repeat([[3] * 128, [9] * 128], 32, 0).astype(np.uint8))
    still, example = (heatnet(original, 1, class_probability=p) for p in (0.0, 1.0))
    factors = []
    for label in (3, 9):
        inside = (still.label == label) & (np.abs(still.thermal - 127.5) > 20)
        ratio = (example.thermal[inside] - 127.5) / (still.thermal[inside] - 127.5)
        assert np.ptp(ratio) < 1e-4
        factors.append(ratio.mean())
    assert abs(factors[0] - factors[1]) > 0.01


def test_heatnet_target_keeps_blocks_and_thermal(monkeypatch: pytest.MonkeyPatch) -> None:
    chances = ("drop_probability", "thermal_probability", "class_probability")
    full = HeatNetTransform(**{**NOTHING, **dict.fromkeys(chances, 1.0)})
    target = record_of(full).for_target
    assert target == replace(full, **dict.fromkeys(chances, 0.0))
    assert record_of(target).for_target is None
    # Training takes the transform of each domain.
    taken: list[Any] = []
    monkeypatch.setattr(
        training_setup, "train_batches", lambda *given: taken.append(given[2]) or SimpleNamespace()
    )
    monkeypatch.setattr(training_setup, "PairedBatches", lambda *_, **__: None)
    spec = specified(("+experiment=heatnet_original",))
    named = {"domains": spec.domains, "loading": spec.data, "trainer": spec.trainer}
    session: Any = SimpleNamespace(spec=spec, transform=full, **named)
    datasets, none = {"source": None, "target": None}, None
    setup = TrainingSetup(session, none, {}, datasets, none, {}, {}, None, none, none)  # type: ignore[arg-type]
    setup.batches(range(1))
    assert taken == [full, target]


def test_heatnet_evaluation_resizes_the_image_and_keeps_the_label() -> None:
    original, made = sample(), HeatNetTransform(**{**NOTHING, "rotate_probability": 1.0})
    example = made.test(original)
    resized = cv2.resize(original.thermal.astype(np.float32), (64, 32))
    np.testing.assert_allclose(example.thermal, resized, atol=1e-3)
    np.testing.assert_array_equal(example.label, original.label)
    np.testing.assert_array_equal(example.confidence, original.confidence)
    assert (made.test(replace(original, label=None)).label == IGNORE).all()


@pytest.mark.parametrize(
    ("changes", "key"), [({"crop_hw": (32, 61)}, "crop_hw"), ({"drop_height": (10, 33)}, "drop_")]
)
def test_heatnet_sizes_that_do_not_fit_are_refused(changes: dict[str, Any], key: str) -> None:
    with pytest.raises(InputError, match=f"transform.{key}"):
        HeatNetTransform(**{**NOTHING, **changes})


def test_heatnet_published_sizes() -> None:
    """320 x 960 of 650 x 1920; columns 148 to 851 in the test, 150 to 849 in training."""
    spec = specified(("+experiment=heatnet_original", "scale=paper", "dataset.root=x"))
    assert spec.dataset.values["crop"] == (0, 650, 2 * 148, 2 * 852)
    assert spec.dataset.values["thermal_range"] == (21800, 25000)
    assert (spec.data.batch_size, spec.trainer.max_steps) == (8, 200 * 1506)
    assert (spec.prediction.counted, spec.prediction.label_resize) == ("image", "nearest")
