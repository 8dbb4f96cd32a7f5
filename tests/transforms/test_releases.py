"""Every transform by the steps of its release, on whole arrays, one step after the other.

Each pixel carries its row and column of the file as maps of their own, so that labels, positions
and centres are compared without the arithmetic of `rgbt.transforms.maps`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch.nn import functional as F

from rgbt.config.component import build, constructor
from rgbt.config.compose import compose, load_choice
from rgbt.transforms.fixed_size import recoloured
from rgbt.types import IGNORE, Example, Sample
from tests.transforms.recipes import SIZES, noise

Arrays = dict[str, np.ndarray]
Step = Callable[[np.ndarray], np.ndarray]
IMAGES = ("rgb", "thermal")


def plain(sample: Sample, dtype: Any = np.uint8) -> Arrays:
    row, column = np.indices(sample.thermal.shape).astype(np.float32)
    assert sample.label is not None and sample.confidence is not None  # noqa: PT018
    images = {"rgb": sample.rgb.astype(dtype), "thermal": sample.thermal.astype(dtype)}
    exact = {"label": sample.label, "confidence": sample.confidence}
    return {**images, **exact, "row": row, "column": column}


def changed(arrays: Arrays, image: Step, exact: Step) -> Arrays:
    return {name: (image if name in IMAGES else exact)(values) for name, values in arrays.items()}


def mirrored(arrays: Arrays, yes: bool) -> Arrays:
    return changed(arrays, np.fliplr, np.fliplr) if yes else arrays


def cut(arrays: Arrays, top: int, left: int, height: int, width: int) -> Arrays:
    def part(values: np.ndarray) -> np.ndarray:
        return values[top : top + height, left : left + width]

    return changed(arrays, part, part)


def resized(arrays: Arrays, hw: tuple[int, int], how: int = cv2.INTER_LINEAR_EXACT) -> Arrays:
    def nearest(values: np.ndarray) -> np.ndarray:
        found = F.interpolate(torch.from_numpy(values.copy())[None, None], hw, mode="nearest")
        return found[0, 0].numpy()

    def image(values: np.ndarray) -> np.ndarray:
        return cv2.resize(np.ascontiguousarray(values), hw[::-1], interpolation=how)

    return changed(arrays, image, nearest)


def framed(arrays: Arrays, hw: tuple[int, int], corner: Any, rgb: Any, thermal: Any) -> Arrays:
    height, width = arrays["label"].shape
    top, left = corner or ((hw[0] - height) // 2, (hw[1] - width) // 2)
    sides = ((top, hw[0] - height - top), (left, hw[1] - width - left))
    fills = {"thermal": thermal, "label": IGNORE, "confidence": 0}
    found = {key: np.pad(arrays[key], sides, constant_values=fill) for key, fill in fills.items()}
    colour = np.broadcast_to(rgb, 3)
    channels = [np.pad(arrays["rgb"][..., c], sides, constant_values=colour[c]) for c in range(3)]
    places = {key: np.pad(arrays[key], sides, mode="edge") for key in ("row", "column")}
    return {**found, **places, "rgb": np.stack(channels, -1)}


def crm(t: Any, sample: Sample, rng: np.random.Generator) -> Arrays:
    arrays = plain(sample, np.uint8 if t.colour == "intended" else np.float32)
    height, width = sample.thermal.shape
    if t.sizes is not None:
        edge = int(rng.choice(t.sizes))
        factor = min(edge / min(height, width), (t.max_size or 10**9) / max(height, width))
        height, width = int(factor * height + 0.5), int(factor * width + 0.5)
        arrays = resized(arrays, (height, width))
    crop = np.minimum(t.crop_hw or (height, width), (height, width)).tolist()
    top, left = (int(rng.integers(a - b + 1)) for a, b in zip((height, width), crop, strict=True))
    arrays = mirrored(cut(arrays, top, left, *crop), rng.random() < t.flip_probability)
    images = t.coloured(*(np.ascontiguousarray(arrays[key]) for key in IMAGES), rng)
    return {**arrays, **{k: image.astype(t.dtype) for k, image in zip(IMAGES, images)}}


def cmx(t: Any, sample: Sample, rng: np.random.Generator) -> Arrays:
    arrays = mirrored(plain(sample), rng.random() < t.flip_probability)
    factor = float(rng.choice(t.factors))
    arrays = resized(arrays, tuple(max(1, int(side * factor)) for side in sample.thermal.shape))
    spans = []
    for length, crop in zip(arrays["label"].shape, t.crop_hw, strict=True):
        first = int(rng.integers(length - crop + 2)) if length > crop else 0
        spans.append((first, min(crop, length - first)))
    (top, height), (left, width) = spans
    colour = np.rint(t.padding_rgb[:: 1 if t.padding_order == "rgb" else -1])
    level = np.rint(np.mean(t.padding_thermal))
    return framed(cut(arrays, top, left, height, width), t.crop_hw, None, colour, level)


def cmnext(t: Any, sample: Sample, rng: np.random.Generator) -> Arrays:
    rgb = sample.rgb
    if rng.random() < t.colour_probability:
        rgb = recoloured(rgb, *rng.uniform(*t.colour_range, size=3))
    flipped = rng.random() < t.flip_probability
    if rng.random() < t.blur_probability:
        rgb = np.asarray(cv2.GaussianBlur(rgb, (3, 3), t.blur_deviation))
    arrays = mirrored(plain(replace(sample, rgb=rgb)), flipped)
    factor = float(rng.uniform(*t.scale_range))
    arrays = resized(arrays, tuple(max(1, round(side * factor)) for side in sample.thermal.shape))
    spans = []
    for length, crop in zip(arrays["label"].shape, t.crop_hw, strict=True):
        first = min(int(rng.integers(max(length - crop, 0) + 2)), length - 1)
        spans.append((first, min(crop, length - first)))
    (top, height), (left, width) = spans
    return framed(cut(arrays, top, left, height, width), t.crop_hw, (0, 0), 0, 0)


def rtfnet(t: Any, sample: Sample, rng: np.random.Generator) -> Arrays:
    arrays = mirrored(plain(sample), rng.random() < t.flip_probability)
    ends = []
    for length in sample.thermal.shape:
        largest = int(t.cut_share * length)
        first = int(rng.integers(max(1, largest)))
        ends.append((first, length - largest + int(rng.integers(largest + 1))))
    (top, bottom), (left, right) = ends
    return resized(cut(arrays, top, left, bottom - top, right - left), t.crop_hw)


def thesis(t: Any, sample: Sample, rng: np.random.Generator) -> Arrays:
    flipped, blurred = rng.random() < t.flip_probability, rng.random() < t.blur_probability
    grows = any(a > b for a, b in zip(t.crop_hw, sample.thermal.shape, strict=True))
    how = cv2.INTER_LINEAR_EXACT if grows else cv2.INTER_AREA
    arrays = resized(plain(sample), t.crop_hw, how)
    if t.label_resize == "bilinear":
        ignored = cv2.resize((sample.label == IGNORE).astype(np.float32), t.crop_hw[::-1])
        mixed = cv2.resize(sample.label, t.crop_hw[::-1], interpolation=cv2.INTER_LINEAR_EXACT)
        arrays["label"] = np.where(ignored > 0, IGNORE, mixed).astype(np.uint8)
    arrays = mirrored(arrays, flipped)
    return softened(arrays, t.blur_kernel) if blurred else arrays


def softened(arrays: Arrays, side: int) -> Arrays:
    soft = {key: np.ascontiguousarray(arrays[key]) for key in IMAGES}
    return arrays | {key: cv2.GaussianBlur(image, (side, side), 0) for key, image in soft.items()}


def turned(arrays: Arrays, angle: float, middle_xy: Any, fills: Any, middle_yx: Any) -> Arrays:
    """Places are counted from where the centre moves, rounded and clipped to the image."""
    matrix, (height, width) = cv2.getRotationMatrix2D(middle_xy, angle, 1), arrays["label"].shape
    found = {}
    for key, fill in zip((*IMAGES, "label", "confidence"), (*fills, 0.0)):
        how = cv2.INTER_LINEAR if key in IMAGES else cv2.INTER_NEAREST
        size, value = (width, height), np.broadcast_to(fill, 3).tolist()
        found[key] = cv2.warpAffine(
            np.ascontiguousarray(arrays[key]), matrix, size, flags=how, borderValue=value
        )
    row, column = centre(arrays, middle_yx)
    x, y = np.rint(matrix @ [column, row, 1]).clip(0, [width - 1, height - 1])
    rows, columns = np.indices((height, width))
    return {**found, "row": rows - y + middle_yx[0], "column": columns - x + middle_yx[1]}


def centre(arrays: Arrays, middle_yx: Any) -> Any:
    distance = np.hypot(arrays["row"] - middle_yx[0], arrays["column"] - middle_yx[1])
    return np.unravel_index(distance.argmin(), distance.shape)


def semseg(t: Any, sample: Sample, rng: np.random.Generator) -> Arrays:
    sides, middle = sample.thermal.shape, [side // 2 for side in sample.thermal.shape]
    factor = float(rng.uniform(*t.scale_range))
    arrays = resized(plain(sample, np.float32), tuple(max(1, round(factor * n)) for n in sides))
    (row, column), (rows, columns) = centre(arrays, middle), np.indices(arrays["label"].shape)
    arrays |= {"row": rows - row + middle[0], "column": columns - column + middle[1]}
    height, width = arrays["label"].shape
    if rng.random() < t.rotate_probability:
        angle, fills = (
            rng.uniform(-t.rotate_degrees, t.rotate_degrees),
            (t.padding_rgb, t.padding_thermal, IGNORE),
        )
        arrays = turned(arrays, angle, (width / 2, height / 2), fills, middle)
    if rng.random() < t.blur_probability:
        arrays = softened(arrays, t.blur_kernel)
    arrays = mirrored(arrays, rng.random() < t.flip_probability)
    full = (max(height, t.crop_hw[0]), max(width, t.crop_hw[1]))
    arrays = framed(arrays, full, None, t.padding_rgb, t.padding_thermal)
    top, left = (int(rng.integers(a - b + 1)) for a, b in zip(full, t.crop_hw))
    return cut(arrays, top, left, *t.crop_hw)


def heatnet(t: Any, sample: Sample, rng: np.random.Generator) -> Arrays:
    """Brought in by a rotation: black, and the label of road."""
    (height, width), middle = t.crop_hw, [side // 2 for side in sample.thermal.shape]
    top = int(rng.integers(t.resize_hw[0] - height + 1))
    left = t.side_margin + int(rng.integers(t.resize_hw[1] - 2 * t.side_margin - width + 1))
    arrays = cut(resized(plain(sample, np.float32), t.resize_hw), top, left, height, width)
    arrays = mirrored(arrays, rng.random() < t.flip_probability)
    if rng.random() < t.rotate_probability:
        angle = rng.uniform(-t.rotate_degrees, t.rotate_degrees)
        arrays = turned(arrays, angle, ((width - 1) / 2, (height - 1) / 2), (0, 0, 0), middle)
    if rng.random() < t.drop_probability:
        rows, columns = (int(rng.integers(*sides)) for sides in (t.drop_height, t.drop_width))
        top, left = int(rng.integers(height - rows + 1)), int(rng.integers(width - columns + 1))
        key = "rgb" if rng.random() < 0.5 else "thermal"
        arrays[key] = arrays[key].copy()
        arrays[key][top : top + rows, left : left + columns] = 127.5
    thermal = arrays["thermal"]
    if rng.random() < t.thermal_probability:
        thermal = 127.5 + rng.uniform(*t.thermal_range) * (thermal - 127.5)
    if rng.random() < t.class_probability:
        for label in np.unique(arrays["label"]):
            scaled = 127.5 + rng.uniform(*t.thermal_range) * (thermal - 127.5)
            thermal = np.where(arrays["label"] == label, scaled, thermal)
    return {**arrays, "thermal": thermal.astype(np.float32)}


STEPS = {
    "crm": crm,
    "crm_released": crm,
    "none": crm,
    "cmx_released": cmx,
    "cmnext_released": cmnext,
    "rtfnet_released": rtfnet,
    "thesis_blur": thesis,
    "thesis_released": thesis,
    "semseg": semseg,
    "heatnet": heatnet,
}
ROTATING = ("semseg", "heatnet")
# No two are equal, so that none is read for another one.
UNEQUAL = {"flip": 0.45, "colour": 0.4, "blur": 0.6, "rotate": 0.55, "drop": 0.5, "thermal": 0.65}


def unequal(*names: str) -> tuple[str, ...]:
    return tuple(f"transform.{name}_probability={UNEQUAL[name]}" for name in names)


WORDS = {
    "crm": unequal("flip", "colour"),
    # The mean of thermal and two of the three colours are rounded up.
    "cmx_released": ("transform.padding_thermal=[100.0,102.0,103.0]",),
    "cmnext_released": unequal("flip", "colour", "blur"),
    # Truncation after a float32 resize shows its last bit: no colours there, see test_crm.
    "crm_released": ("transform.colour_probability=0",),
    "thesis_blur": unequal("flip", "blur"),
    "semseg": ("model=semseg", *unequal("flip", "blur", "rotate")),
    "heatnet": (
        *("transform.resize_hw=[48,80]", "transform.crop_hw=[40,60]"),
        *("transform.drop_height=[5,20]", "transform.drop_width=[5,30]"),
        *("transform.class_probability=0.35", *unequal("flip", "rotate", "drop", "thermal")),
    ),
}


def made(name: str, *words: str) -> Any:
    sizes = ("scale.crop_hw=[40,56]", "scale.train_sizes=[30,48,70]")
    more = () if name in ROTATING else ("transform.track_position=true",)
    words = (*sizes, *more, *WORDS.get(name, ()), *words)
    return build(compose([f"transform={name}", *words]).transform)


def assert_is(found: Example, expected: Arrays, name: str) -> None:
    """Also the centre: of the pixels that show the file, the first one nearest to its middle."""
    for key in ("rgb", "thermal", "label", "confidence"):
        one, other = getattr(found, key), expected[key]
        assert (one.shape, one.dtype) == (other.shape, other.dtype), (name, key)
        np.testing.assert_allclose(one, other, atol=1e-3 if other.dtype == np.float32 else 0)
    if name not in ROTATING:
        assert found.position is not None
        assert found.position.dtype == np.float32
        np.testing.assert_array_equal(found.position, [expected["row"], expected["column"]])
    assert found.centre_yx == centre(expected, [side // 2 for side in found.original_hw])


@pytest.mark.parametrize("name", STEPS)
def test_training_is_the_steps_of_the_release(name: str) -> None:
    transform = made(name)
    for number in range(60):
        sample = noise(number, SIZES[number % len(SIZES)])
        found = transform.train(sample, np.random.default_rng(number))
        assert_is(found, STEPS[name](transform, sample, np.random.default_rng(number)), name)
        assert (found.original_hw, found.name) == (sample.thermal.shape, sample.name)


@pytest.mark.parametrize("name", STEPS)
def test_labels_and_positions_may_be_missing(name: str) -> None:
    transform = made(name)
    for number in range(4):
        sample = noise(number)
        whole, bare = (
            transform.train(given, np.random.default_rng(number))
            for given in (sample, replace(sample, label=None, confidence=None))
        )
        assert (bare.label == IGNORE).all()
        assert bare.confidence is None
        assert bare.centre_yx == whole.centre_yx
        assert (transform.test(replace(sample, label=None)).label == IGNORE).all()
        if name not in ROTATING:
            silent = replace(transform, track_position=False)
            found = silent.train(sample, np.random.default_rng(number))
            assert found.position is None
            np.testing.assert_array_equal(found.rgb, whole.rgb)


@pytest.mark.parametrize("name", STEPS)
def test_evaluation_keeps_files_or_resizes_images_alone(name: str) -> None:
    original, transform = noise(3), made(name)
    if name == "heatnet":
        sizes = {"resize_hw": (24, 32), "crop_hw": (20, 28), "drop_width": (5, 28)}
        smaller = replace(transform, **sizes).test(original)
    else:
        example = replace(transform, test_short_edge=None).test(original)
        for key in ("rgb", "thermal", "label", "confidence"):
            np.testing.assert_array_equal(getattr(example, key), getattr(original, key))
        assert example.centre_yx == (24, 32)
        smaller = replace(transform, test_short_edge=24).test(original)
    how = cv2.INTER_AREA if name.startswith("thesis") else cv2.INTER_LINEAR_EXACT
    for key in IMAGES:
        image = getattr(original, key).astype(smaller.rgb.dtype)
        expected = cv2.resize(image, (32, 24), interpolation=how)
        np.testing.assert_array_equal(getattr(smaller, key), expected)
    assert (smaller.position is None) == (name in ROTATING)
    np.testing.assert_array_equal(smaller.label, original.label)
    np.testing.assert_array_equal(smaller.confidence, original.confidence)


PUBLISHED: dict[str, dict[str, Any]] = {
    "crm": {
        "brightness_delta": 32,
        "hue_delta": 18,
        "max_size": 1920,
        "colour": "intended",
        **dict.fromkeys(("contrast_range", "saturation_range"), [0.5, 1.5]),
        **dict.fromkeys(("flip_probability", "colour_probability"), 0.5),
        "thermal_contrast_range": [0.5, 1.5],
    },
    "crm_released": {"colour": "released"},
    "rtfnet_released": {"flip_probability": 0.5, "cut_share": 0.1},
    "cmx_released": {"factors": [0.5, 0.75, 1, 1.25, 1.5, 1.75], "flip_probability": 0.5},
    "cmnext_released": {
        **dict.fromkeys(("colour_probability", "blur_probability"), 0.2),
        "flip_probability": 0.5,
        "blur_deviation": 0.8,
        "colour_range": [0.5, 1.5],
        "scale_range": [0.5, 2.0],
    },
    "thesis": {"flip_probability": 0.5, "blur_probability": 0.0, "label_resize": "nearest"},
    "thesis_blur": {"blur_probability": 0.5},
    "thesis_released": {"label_resize": "bilinear"},
    "semseg": {
        **dict.fromkeys(("rotate_probability", "blur_probability", "flip_probability"), 0.5),
        "scale_range": [0.5, 2.0],
        "rotate_degrees": 10,
        "blur_kernel": 5,
    },
    "heatnet": {
        **dict.fromkeys(("flip_probability", "rotate_probability", "drop_probability"), 0.5),
        "resize_hw": [320, 704],
        "crop_hw": [320, 640],
        "side_margin": 2,
        "drop_height": [100, 300],
        "drop_width": [100, 500],
        "rotate_degrees": 20,
        "thermal_probability": 0.5,
        "class_probability": 0.0,
        "thermal_range": [0.1, 1.0],
    },
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_configuration_has_every_setting_and_published_numbers(name: str) -> None:
    node = load_choice(f"transform/{name}")
    if "defaults" not in node:
        parameters = inspect.signature(constructor(node["_target_"], "transform")).parameters
        assert set(node) == {"_target_", *parameters}
    assert {key: node[key] for key in PUBLISHED[name]} == PUBLISHED[name]
