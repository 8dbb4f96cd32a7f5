"""Random draws on the device: points and maskers."""

from __future__ import annotations

import pytest
import torch

from rgbt.losses.points import Points
from rgbt.randomness import torch_generator
from tests.maskers.test_masker import VARIANTS, configured
from tests.on_device.places import ON_DEVICE, device

pytestmark = ON_DEVICE


def generator(seed: int = 0) -> torch.Generator:
    return torch_generator(seed, "test", device=device())


def test_points_lie_inside_whatever_the_number_of_sets() -> None:
    together = Points(generator(), device=device()).loss(3, 2, 101)
    one_by_one = Points(generator(), device=device())
    apart = torch.cat([one_by_one.loss(1, 2, 101) for _ in range(3)])
    assert (together.device.type, together.dtype) == (device().type, torch.float32)
    assert torch.equal(together, apart)
    assert float(together.abs().max()) < 1


@pytest.mark.parametrize("variant", VARIANTS)
def test_masks_are_drawn_on_the_device(variant: str) -> None:
    centre = torch.tensor([[120, 160]]).expand(6, 2).to(device())
    masks, again = (configured(variant)((240, 320), centre, generator()) for _ in range(2))
    for one, other in zip(masks, again, strict=True):
        assert (one.device.type, one.dtype) == (device().type, torch.bool)
        assert torch.equal(one, other)
