"""HeatNet's augmentation: every step alone, computed again with other means."""

from __future__ import annotations

from dataclasses import replace
from math import cos, radians, sin
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.assembly.training_setup import TrainingSetup
from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.requirements import record_of
from rgbt.transforms.heatnet import HeatNetTransform
from rgbt.transforms.rotation import Rotation
from rgbt.types import IGNORE, Example, Sample
from tests.composed import specified
from tests.models.golden import compose
from tests.transforms.test_thesis import sample

HW = (64, 128)
NOTHING: dict[str, Any] = {
    **{"resize_hw": (32, 64), "crop_hw": (32, 56), "side_margin": 2, "flip_probability": 0.0},
    **{"rotate_probability": 0.0, "rotate_degrees": 20.0, "drop_probability": 0.0},
    **{"drop_height": (10, 30), "drop_width": (10, 50), "thermal_probability": 0.0},
    **{"class_probability": 0.0, "thermal_range": (0.1, 1.0)},
}


def heatnet(**changes: Any) -> HeatNetTransform:
    return HeatNetTransform(**{**NOTHING, **changes})


def trained(original: Sample, number: int, **changes: Any) -> Example:
    return heatnet(**changes).train(original, np.random.default_rng(number))


def test_crops_lie_between_the_margins_and_reach_both() -> None:
    """Columns 2 to 61 of 64 are shown; 56 of them begin at 2, 3, ..., 6."""
    original = replace(sample(), label=np.tile(np.arange(HW[1], dtype=np.uint8), (HW[0], 1)))
    firsts = set()
    for number in range(60):
        label = trained(original, number).label
        firsts.add(int(label[0, 0]) // 2)
        assert (np.diff(label[0].astype(int)) == 2).all()
        assert label.shape == (32, 56)
    assert firsts == {2, 3, 4, 5, 6}


def test_images_are_resized_as_opencv_resizes_them() -> None:
    original = sample()
    example = trained(original, 1, crop_hw=(32, 60), side_margin=2)
    for found, image in ((example.rgb, original.rgb), (example.thermal, original.thermal)):
        resized = cv2.resize(image.astype(np.float32), (64, 32), interpolation=cv2.INTER_LINEAR)
        np.testing.assert_allclose(found, resized[:, 2:62], atol=1e-3)
        assert found.dtype == np.float32
    flipped = trained(original, 1, crop_hw=(32, 60), flip_probability=1.0)
    np.testing.assert_array_equal(flipped.rgb, example.rgb[:, ::-1])
    np.testing.assert_array_equal(flipped.label, example.label[:, ::-1])
    np.testing.assert_array_equal(flipped.confidence, example.confidence[:, ::-1])


def rotated_by_hand(array: np.ndarray, angle: float, fill: float) -> np.ndarray:
    """Nearest, about the middle of the array, counter-clockwise; pixel after pixel."""
    height, width = array.shape
    result = np.full_like(array, fill)
    middle_y, middle_x = (height - 1) / 2, (width - 1) / 2
    c, s = cos(radians(angle)), sin(radians(angle))
    for i in range(height):
        for j in range(width):
            x, y = j - middle_x, i - middle_y
            column, row = round(c * x - s * y + middle_x), round(s * x + c * y + middle_y)
            if 0 <= row < height and 0 <= column < width:
                result[i, j] = array[row, column]
    return result


def test_rotation_is_about_the_middle_and_brings_in_road_and_black() -> None:
    original = replace(sample(), label=np.full(HW, 7, np.uint8), confidence=np.ones(HW, np.float32))
    angles = set()
    for number in range(6):
        still = trained(original, number)
        turned = trained(original, number, rotate_probability=1.0)
        # Draws in order: top, left, mirrored, rotated, angle.
        rng = np.random.default_rng(number)
        rng.integers(1), rng.integers(5), rng.random(), rng.random()
        angle = float(rng.uniform(-20, 20))
        angles.add(angle > 0)
        expected = rotated_by_hand(still.label, angle, 0)
        assert (turned.label != expected).mean() < 0.01, "ties of half pixels may differ"
        outside = expected == 0
        assert 0 < outside.mean() < 0.5
        assert set(np.unique(turned.label)) == {0, 7}
        assert set(np.unique(turned.confidence)) == {0.0, 1.0}
        np.testing.assert_array_equal(turned.confidence == 0, turned.label == 0)
        inner = cv2.erode(outside.astype(np.uint8), np.ones((5, 5))) > 0
        assert not turned.rgb[inner].any()
        assert not turned.thermal[inner].any()
    assert angles == {True, False}


def test_unlabelled_images_stay_ignored_where_they_are_rotated() -> None:
    bare = sample(labelled=False)
    for number in range(4):
        assert (trained(bare, number, rotate_probability=1.0).label == IGNORE).all()


def test_rotation_moves_images_and_points_alike() -> None:
    rotation = Rotation((21, 41), 90.0, (20.0, 10.0))
    image = np.zeros((21, 41), np.float32)
    image[10, 25] = 1.0
    turned = rotation.image(image, 0.0)
    assert np.unravel_index(turned.argmax(), turned.shape) == (5, 20)  # counter-clockwise
    assert rotation.point(10, 25) == (5, 20)
    assert rotation.point(10, 40) == (0, 20)  # outside: the nearest pixel


def test_one_block_of_one_image_becomes_the_middle_grey_level() -> None:
    original, dropped = sample(), []
    for number in range(60):
        still = trained(original, number)
        example = trained(original, number, drop_probability=1.0)
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
        np.testing.assert_array_equal(example.label, still.label)
    kinds, heights, widths = zip(*dropped, strict=True)
    assert 15 < sum(kinds) < 45
    assert min(heights) >= 9 and max(heights) <= 29  # noqa: PT018 - a pixel may be 127.5 before
    assert min(widths) >= 9 and max(widths) <= 49  # noqa: PT018


def test_thermal_is_scaled_about_the_middle_grey_level() -> None:
    original, factors = sample(), []
    for number in range(40):
        still = trained(original, number)
        example = trained(original, number, thermal_probability=1.0)
        apart = np.abs(still.thermal - 127.5) > 20
        ratio = (example.thermal[apart] - 127.5) / (still.thermal[apart] - 127.5)
        assert np.ptp(ratio) < 1e-4
        factors.append(float(ratio.mean()))
        np.testing.assert_array_equal(example.rgb, still.rgb)
    assert 0.1 <= min(factors) < 0.25
    assert 0.85 < max(factors) <= 1.0


def test_classes_have_factors_of_their_own_on_request() -> None:
    original = replace(sample(), label=np.repeat([[3] * 128, [9] * 128], 32, 0).astype(np.uint8))
    still, example = (trained(original, 1, class_probability=p) for p in (0.0, 1.0))
    factors = []
    for label in (3, 9):
        inside = (still.label == label) & (np.abs(still.thermal - 127.5) > 20)
        ratio = (example.thermal[inside] - 127.5) / (still.thermal[inside] - 127.5)
        assert np.ptp(ratio) < 1e-4
        factors.append(ratio.mean())
    assert abs(factors[0] - factors[1]) > 0.01


def test_probability_of_half_changes_half_of_the_images() -> None:
    original = sample()
    for key in ("rotate_probability", "drop_probability", "thermal_probability"):
        changed = 0
        for number in range(200):
            still, example = (trained(original, number, **{key: p}) for p in (0.0, 0.5))
            changed += int(
                (example.thermal != still.thermal).any() or (example.rgb != still.rgb).any()
            )
        assert 75 < changed < 125, key


def test_images_of_the_target_keep_blocks_and_thermal() -> None:
    full = heatnet(drop_probability=1.0, thermal_probability=1.0, class_probability=1.0)
    target = record_of(full).for_target
    original = sample()
    found = target.train(original, np.random.default_rng(5))
    plain = trained(original, 5)
    np.testing.assert_array_equal(found.thermal, plain.thermal)
    np.testing.assert_array_equal(found.rgb, plain.rgb)
    assert record_of(target).for_target is None


def test_training_takes_the_transform_of_each_domain(monkeypatch: pytest.MonkeyPatch) -> None:
    from types import SimpleNamespace

    from rgbt.assembly import training_setup

    taken: list[Any] = []
    monkeypatch.setattr(
        training_setup, "train_batches", lambda *given: taken.append(given[2]) or SimpleNamespace()
    )
    monkeypatch.setattr(training_setup, "PairedBatches", lambda *_, **__: None)
    transform = heatnet(drop_probability=1.0)
    spec = specified(("+experiment=heatnet_original",))
    session: Any = SimpleNamespace(
        spec=spec,
        transform=transform,
        domains=spec.domains,
        loading=spec.data,
        trainer=spec.trainer,
    )
    datasets: Any = {"source": None, "target": None}
    none: Any = None
    setup = TrainingSetup(session, none, {}, datasets, none, {}, {}, None, none, none)
    setup.batches(range(1))
    assert [each.drop_probability for each in taken] == [1.0, 0.0]


def test_evaluation_resizes_the_image_and_keeps_the_label() -> None:
    original = sample()
    example = heatnet(rotate_probability=1.0, drop_probability=1.0).test(original)
    assert example.rgb.shape == (32, 64, 3)
    resized = cv2.resize(original.thermal.astype(np.float32), (64, 32))
    np.testing.assert_allclose(example.thermal, resized, atol=1e-3)
    np.testing.assert_array_equal(example.label, original.label)
    assert (heatnet().test(sample(labelled=False)).label == IGNORE).all()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"crop_hw": (32, 61)}, r"crop_hw=\[32, 61\] must fit into .*\[32, 60\]"),
        ({"drop_height": (10, 33)}, r"drop_height=\[10, 33\].* must not exceed"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        heatnet(**changes)


def test_published_sizes_and_probabilities() -> None:
    """320 x 960 of 650 x 1920; columns 148 to 851 in the test, 150 to 849 in training."""
    made: HeatNetTransform = build(compose("transform=heatnet").transform)
    assert (made.resize_hw, made.crop_hw, made.side_margin) == ((320, 704), (320, 640), 2)
    assert (made.drop_height, made.drop_width) == ((100, 300), (100, 500))
    assert (made.rotate_degrees, made.thermal_range) == (20.0, (0.1, 1.0))
    found = {key: value for key, value in vars(made).items() if key.endswith("probability")}
    assert found == {
        **dict.fromkeys(("flip_probability", "rotate_probability", "drop_probability"), 0.5),
        **{"thermal_probability": 0.5, "class_probability": 0.0},
    }
    spec = specified(("+experiment=heatnet_original", "scale=paper", "dataset.root=x"))
    assert spec.dataset.values["crop"] == (0, 650, 2 * 148, 2 * 852)
    assert spec.dataset.values["thermal_range"] == (21800, 25000)
    assert (spec.data.batch_size, spec.trainer.max_steps) == (8, 200 * 1506)
    assert (spec.prediction.counted, spec.prediction.label_resize) == ("image", "nearest")
