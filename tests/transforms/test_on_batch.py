"""Augmentation of whole batches: the bits of the augmentation of single examples."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from rgbt.checks import InputError
from rgbt.data.loaders import collate
from rgbt.randomness import numpy_generator
from rgbt.transforms.crm import CrmTransform
from rgbt.transforms.hsv import to_hsv, to_rgb
from rgbt.transforms.joint import View, bilinear_taps
from rgbt.types import Batch, Sample
from tests.on_device.places import device, on_device
from tests.transforms.recipes import crm

SIZES = ((48, 64), (60, 50), (48, 64), (31, 77))
"""Of the originals; two of a kind."""


def transform(**changes: Any) -> CrmTransform:
    return crm(**{"max_size": 140, "crop_hw": (22, 24), **changes})


def sample(number: int, *, labelled: bool = True, confident: bool = False) -> Sample:
    rng = np.random.default_rng(number)
    hw = SIZES[number % len(SIZES)]
    label = rng.integers(0, 9, hw, dtype=np.uint8)
    return Sample(
        rgb=rng.integers(0, 256, (*hw, 3), dtype=np.uint8),
        thermal=rng.integers(0, 256, hw, dtype=np.uint8),
        label=label if labelled else None,
        name=f"{number}",
        confidence=rng.random(hw, dtype=np.float32) if confident else None,
    )


def one_by_one(made: CrmTransform, samples: list[Sample], epoch: int) -> Batch:
    examples = [
        made.train(each, numpy_generator(0, "augment", epoch, int(each.name))) for each in samples
    ]
    return collate(examples).to("cpu")


def together(made: CrmTransform, samples: list[Sample], epoch: int) -> Batch:
    drawn = [
        made.drawn(each, numpy_generator(0, "augment", epoch, int(each.name))) for each in samples
    ]
    return made.stack(drawn).to("cpu")


def assert_equal(one: Batch, other: Batch) -> None:
    for each in fields(Batch):
        a, b = getattr(one, each.name), getattr(other, each.name)
        if isinstance(a, torch.Tensor):
            assert a.dtype == b.dtype
            assert torch.equal(a, b), each.name
        else:
            assert a == b, each.name


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"colour_probability": 1.0},
        {"track_position": False, "flip_probability": 1.0},
        {"sizes": None, "crop_hw": (30, 40)},  # nothing is resized
    ],
)
def test_a_batch_is_what_its_examples_are(changes: dict[str, Any]) -> None:
    made = transform(**changes)
    samples = [sample(number) for number in range(8)]
    for epoch in range(4):
        assert_equal(one_by_one(made, samples, epoch), together(made, samples, epoch))


def test_labels_may_be_missing_and_carry_confidences() -> None:
    made = transform()
    without = [sample(number, labelled=False) for number in range(3)]
    batch = together(made, without, 0)
    assert_equal(one_by_one(made, without, 0), batch)
    assert (batch.label == 255).all()
    sure = [sample(number, confident=True) for number in range(3)]
    assert_equal(one_by_one(made, sure, 1), together(made, sure, 1))
    mixed = [sample(0), sample(1, confident=True)]
    with pytest.raises(InputError, match="all labels of one batch"):
        together(made, mixed, 0)


def test_an_example_does_not_depend_on_its_batch() -> None:
    made = transform(colour_probability=1.0)
    samples = [sample(number) for number in range(6)]
    whole = together(made, samples, 2)
    for place, each in enumerate(samples):
        alone = together(made, [each], 2)
        assert torch.equal(alone.rgb[0], whole.rgb[place])
        assert torch.equal(alone.thermal[0], whole.thermal[place])
        assert torch.equal(alone.label[0], whole.label[place])


@on_device
def test_a_gpu_gives_the_same_bits() -> None:
    made = transform(colour_probability=1.0)
    drawn = [made.drawn(sample(n), numpy_generator(0, "augment", 0, n)) for n in range(8)]
    there = made.stack(drawn).to(device())
    here = {each.name: getattr(there, each.name) for each in fields(Batch)}
    moved = {
        key: value.cpu() if isinstance(value, torch.Tensor) else value
        for key, value in here.items()
    }
    assert_equal(made.stack(drawn).to("cpu"), Batch(**moved))


def test_released_colours_stay_with_single_images() -> None:
    assert transform().record.works_on_batches
    assert not transform(colour="released").record.works_on_batches


def test_refuses_crops_of_different_size() -> None:
    with pytest.raises(
        InputError, match=r"must have one size, got 24x32 \('0'\) and 29x24 \('1'\)"
    ):
        together(transform(sizes=(24,), crop_hw=(90, 90)), [sample(0), sample(1)], 0)


@pytest.mark.parametrize(("source", "resized"), [(480, 240), (640, 1280), (97, 120), (120, 97)])
def test_taps_by_hand_and_by_opencv(source: int, resized: int) -> None:
    line = np.random.default_rng(0).integers(0, 256, (1, source), dtype=np.uint8)
    taps = bilinear_taps(source, resized, slice(0, resized))
    expected = cv2.resize(line, (resized, 1), interpolation=cv2.INTER_LINEAR_EXACT)[0]
    levels = line[0].astype(np.int64)
    found = levels[taps.first] * (256 - taps.weight) + levels[taps.second] * taps.weight
    np.testing.assert_array_equal((found + 128) >> 8, expected)


def test_taps_of_halving_and_doubling() -> None:
    """Half: between 2 i and 2 i + 1. Double: a quarter to either side, and nothing outside."""
    half = bilinear_taps(4, 2, slice(0, 2))
    assert (half.first.tolist(), half.second.tolist(), half.weight.tolist()) == (
        [0, 2],
        [1, 3],
        [128, 128],
    )
    double = bilinear_taps(2, 4, slice(0, 4))
    assert double.first.tolist() == [0, 0, 0, 1]
    assert double.weight.tolist() == [0, 64, 192, 0]


def test_a_mirrored_view_reads_its_columns_backwards() -> None:
    straight, mirrored = (
        View((4, 6), (4, 6), (1, 2), (2, 3), flipped) for flipped in (False, True)
    )
    assert straight.taps()[1].first.tolist() == [2, 3, 4]
    assert mirrored.taps()[1].first.tolist() == [4, 3, 2]
    assert mirrored.taps()[0].first.tolist() == [1, 2]


def test_hsv_is_opencv_s() -> None:
    """Every fifth level of each channel; the whole cube was compared once, all are equal."""
    levels = torch.arange(0, 256, 5)
    rgb = torch.stack(torch.meshgrid(levels, levels, levels, indexing="ij"), -1).view(1, -1, 3)
    expected = cv2.cvtColor(rgb.numpy().astype(np.uint8), cv2.COLOR_RGB2HSV)
    found = torch.stack(to_hsv(rgb), -1)
    np.testing.assert_array_equal(found, expected)
    hue = torch.arange(180)
    hsv = torch.stack(torch.meshgrid(hue, levels, levels, indexing="ij"), -1).view(1, -1, 3)
    whole = hsv[:, : hsv.shape[1] // 64 * 64]  # OpenCV rounds otherwise at the end of a row
    expected = cv2.cvtColor(whole.numpy().astype(np.uint8), cv2.COLOR_HSV2RGB)
    np.testing.assert_array_equal(to_rgb(*whole.unbind(-1)), expected)
    # By hand: hue 15 is 30 degrees, half way from red to yellow.
    assert to_rgb(*torch.tensor([15, 255, 200])).tolist() == [200, 100, 0]
    assert to_rgb(*torch.tensor([0, 0, 77])).tolist() == [77, 77, 77]
