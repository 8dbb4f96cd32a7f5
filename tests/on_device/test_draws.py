"""Random draws on the device: generators, points, stochastic depth, maskers and views."""

from __future__ import annotations

import pytest
import torch

from rgbt.geometry.camera import Camera
from rgbt.losses.points import Points
from rgbt.models.parts import keep_factors
from rgbt.randomness import torch_generator
from rgbt.transforms.views import VirtualView
from rgbt.types import MaskPair
from tests.maskers.test_masker import VARIANTS, configured
from tests.on_device.places import ON_DEVICE, device

pytestmark = ON_DEVICE

CAMERA = Camera(fx=70.2, fy=70.3, cx=32, cy=24, height=48, width=64)
VIEW = VirtualView(
    camera=CAMERA,
    **{"yaw": (-10.0, 10.0), "pitch": (-10.0, 10.0), "roll": (-5.0, 5.0)},
    **{"order": "zyx", "angles": "uniform", "mode": "both"},
    **{"rectangle": "largest", "resampling": "once", "outside": "ignore"},
)


def generator(seed: int = 0) -> torch.Generator:
    return torch_generator(seed, "test", device=device())


def test_points_lie_inside_and_do_not_depend_on_how_many_sets_are_requested() -> None:
    together = Points(generator(), device=device()).loss(3, 2, 101)
    one_by_one = Points(generator(), device=device())
    apart = torch.cat([one_by_one.loss(1, 2, 101) for _ in range(3)])
    assert together.device.type == device().type
    assert together.dtype == torch.float32
    assert torch.equal(together, apart)
    assert float(together.abs().max()) < 1
    assert abs(float(together.mean())) < 0.1


def test_residuals_are_kept_with_their_rate() -> None:
    rates = torch.tensor([0.0, 0.5])
    factors = keep_factors(rates, (1000, 1, 1, 1), generator(), device())
    assert factors.device.type == device().type
    assert (factors[0] == 1).all()
    assert set(factors[1].flatten().tolist()) == {0.0, 2.0}
    assert 0.8 < float(factors[1].mean()) < 1.2


@pytest.mark.parametrize("variant", VARIANTS)
def test_masks_are_drawn_on_the_device(variant: str) -> None:
    centre = torch.tensor([[120, 160]]).expand(6, 2).to(device())
    masker = configured(variant)
    masks, again = (masker((240, 320), centre, generator()) for _ in range(2))
    assert isinstance(masks, MaskPair)
    for one, other in zip(masks, again, strict=True):
        assert one.device.type == device().type
        assert one.dtype == torch.bool
        assert torch.equal(one, other)
    if masker.pairing == "comp":
        assert (masks.rgb ^ masks.thermal).all()


def test_views_are_those_of_the_cpu() -> None:
    angles = VIEW.draw(4, generator())
    assert angles.device.type == device().type
    warp, here = (VIEW.warp(each, (48, 64)) for each in (angles, angles.cpu()))
    image = torch.rand(4, 3, 48, 64)
    label = torch.randint(0, 9, (4, 48, 64))
    moved = warp.bilinear(image.to(device())).cpu()
    # Single pixels on the outline may fall to the other side.
    assert float((moved - here.bilinear(image)).abs().median()) < 1e-5
    differing = warp.nearest(label.to(device()), 255).cpu() != here.nearest(label, 255)
    assert float(differing.float().mean()) < 1e-2
