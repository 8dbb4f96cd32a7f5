"""Class mixing: how many classes are pasted, and what a mix of two pairs looks like."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rgbt.randomness import torch_generator
from rgbt.schemes.self_training import mixed, pasted_pixels, seen_as
from rgbt.types import Batch
from tests.losses.problems import batch_of


def drawn(label: Tensor, number: int = 0) -> Tensor:
    return pasted_pixels(label, torch_generator(0, "class mix", number))


def images(value: float, label: int, height: int = 2) -> Batch:
    size = (1, height, 3)
    batch = batch_of(torch.full(size, label))
    rgb = torch.full((1, 3, *size[1:]), value) * torch.tensor([1.0, 2.0, 3.0]).view(1, 3, 1, 1)
    thermal, weight = torch.full((1, *size), 10 * value), torch.full(size, 0.25)
    return replace(batch, rgb=rgb, thermal=thermal, confidence=weight)


@pytest.mark.parametrize(("values", "pasted"), [([0, 3, 7, 9], 2), ([0, 3, 255], 2), ([5], 1)])
def test_half_of_the_values_of_the_batch_are_pasted(values: list[int], pasted: int) -> None:
    """Rounded up, 255 among them; each image has all values here."""
    label = torch.tensor(values).expand(8, 2, -1).contiguous()
    masks = drawn(label)
    for image in masks:
        # Whole classes: both rows are the same.
        assert torch.equal(image[0], image[1])
        assert image[0].sum() == pasted
    assert len(values) == 1 or not all(torch.equal(masks[0], each) for each in masks)


def test_both_images_label_and_weight_are_pasted_with_one_mask() -> None:
    source, target = images(0.01, label=3), images(0.02, label=5)
    pasted = torch.tensor([[[True, False, False], [False, True, False]]])
    found = mixed(source, target, pasted)
    assert found.label.tolist() == [[[3, 5, 5], [5, 3, 5]]]
    assert found.confidence is not None
    assert found.confidence.tolist() == [[[1.0, 0.25, 0.25], [0.25, 1.0, 0.25]]]
    for name in ("rgb", "thermal"):
        one, two, mix = (getattr(each, name) for each in (source, target, found))
        assert torch.equal(mix[0, :, pasted[0]], one[0, :, pasted[0]])
        assert torch.equal(mix[0, :, ~pasted[0]], two[0, :, ~pasted[0]])
        assert not torch.equal(one, two)


def test_views_that_differ_paste_what_the_source_sees() -> None:
    batch = images(0.1, label=3)
    # (0.1, 0.2, 0.3): 0.0299 + 0.1174 + 0.0342.
    thermal = seen_as(batch, "rgb", "thermal").thermal
    torch.testing.assert_close(thermal, torch.full_like(thermal, 0.1815))
    rgb = seen_as(batch, "thermal", "rgb").rgb
    assert torch.equal(rgb, torch.ones_like(rgb))
    for views in (("rgb", "rgb"), ("thermal", "thermal"), (None, None), ("rgbt", "rgb")):
        assert seen_as(batch, *views) is batch  # type: ignore[arg-type]
