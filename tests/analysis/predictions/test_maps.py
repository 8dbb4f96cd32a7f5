from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.predictions.maps import MapSum, PixelMaps
from rgbt.checks import InputError


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
    summed = MapSum(3)
    intersection, union = np.zeros((2, 3, 3, 5), int)
    for label, prediction in zip(labels, predictions, strict=True):
        summed.add(label, prediction)
        for y, x in np.ndindex(3, 5):
            if label[y, x] == 255:
                continue
            if label[y, x] == prediction[y, x]:
                intersection[label[y, x], y, x] += 1
            for index in {label[y, x], prediction[y, x]}:
                union[index, y, x] += 1
    np.testing.assert_array_equal(summed.sums, [intersection, union])
    assert summed.sums[1, 1, 0, 0] == images
    assert summed.is_one_size


def test_mean_over_classes_by_hand() -> None:
    # pixels: a 2/4, b 1/1 | a 1/2, b absent | nothing labelled
    found = maps([[[2, 1, 0]], [[1, 0, 0]]], [[[4, 2, 0]], [[1, 0, 0]]])
    np.testing.assert_allclose(found.iou(), [[0.75, 0.5, np.nan]])


def test_saved_and_loaded_are_equal(tmp_path: Path) -> None:
    before = maps([[[2, 1]], [[1, 0]]], [[[4, 2]], [[1, 0]]])
    before.save(tmp_path / "maps.npz")
    after = PixelMaps.load(tmp_path / "maps.npz")
    np.testing.assert_array_equal(after.intersection, before.intersection)
    np.testing.assert_array_equal(after.union, before.union)
    assert after.union.dtype == np.int32
    nothing = np.zeros((2, 1, 1), np.int32)
    without = {"intersection": nothing, "union": nothing}
    assert replace(after, **without).__dict__.keys() == before.__dict__.keys()
    for key in ("images", "classes", "palette", "dataset", "split", "name"):
        assert getattr(after, key) == getattr(before, key)


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the file of pixel maps"):
        PixelMaps.load(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("text")
    with pytest.raises(InputError, match="not a readable file of pixel maps"):
        PixelMaps.load(tmp_path / "text.npz")
    np.savez(tmp_path / "other.npz", format=np.array("rgbt counts 1"))
    with pytest.raises(InputError, match="not a readable file of pixel maps"):
        PixelMaps.load(tmp_path / "other.npz")
    with pytest.raises(ValueError, match="K=2"):
        maps([[[1]], [[1]]], [[[1]]])
