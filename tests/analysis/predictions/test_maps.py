from __future__ import annotations

import numpy as np

from analysis.predictions.maps import PixelMaps, add_image


def maps(intersection: object, union: object) -> PixelMaps:
    both = np.array(intersection, np.int32), np.array(union, np.int32)
    return PixelMaps(
        intersection=both[0],
        union=both[1],
        images=4,
        classes=("a", "b")[: len(both[0])],
        palette=((0, 0, 0), (1, 2, 3)),
        dataset="f",
        split="test",
        name="m",
    )


def test_sums_are_those_of_a_loop_over_pixels() -> None:
    rng = np.random.default_rng(0)
    images = 300  # more than a byte holds
    labels = rng.integers(0, 4, (images, 3, 5), np.uint8)
    labels[labels == 3] = 255
    predictions = rng.integers(0, 3, (images, 3, 5), np.uint8)
    labels[:, 0, 0] = predictions[:, 0, 0] = 1  # always right: counts beyond 255
    sums = np.zeros((2, 3, 3, 5), np.int32)
    intersection, union = np.zeros((2, 3, 3, 5), int)
    for label, prediction in zip(labels, predictions, strict=True):
        add_image(sums, label, prediction)
        for y, x in np.ndindex(3, 5):
            if label[y, x] == 255:
                continue
            if label[y, x] == prediction[y, x]:
                intersection[label[y, x], y, x] += 1
            for index in {label[y, x], prediction[y, x]}:
                union[index, y, x] += 1
    np.testing.assert_array_equal(sums, [intersection, union])
    assert sums[1, 1, 0, 0] == images


def test_mean_over_classes_by_hand() -> None:
    # pixels: a 2/4, b 1/1 | a 1/2, b absent | nothing labelled
    found = maps([[[2, 1, 0]], [[1, 0, 0]]], [[[4, 2, 0]], [[1, 0, 0]]])
    np.testing.assert_allclose(found.iou(), [[0.75, 0.5, np.nan]])
