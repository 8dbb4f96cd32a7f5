"""Homographies, crops and warped frames against those recorded from the release."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rgbt.geometry.camera import homography, inner_rectangle
from rgbt.geometry.warp import Warp
from tests.geometry.views import HW, RELEASED, Recorded
from tests.models.golden import FOLDER

VIEWS = 6


@pytest.fixture(scope="module", params=[(480, 640), (48, 64)], ids=["480x640", "48x64"])
def recorded(request: pytest.FixtureRequest) -> Recorded:
    if not (FOLDER / "fill.py").exists():
        pytest.skip("reference material is not here")
    return Recorded(*request.param)


@pytest.fixture(scope="module")
def views(recorded: Recorded) -> Tensor:
    return homography(recorded.angles, recorded.camera.matrix(recorded.hw), "zxy")


@pytest.fixture(scope="module")
def warp(recorded: Recorded, views: Tensor) -> Warp:
    rectangle = inner_rectangle(views, recorded.hw, "corners")
    return Warp(views, rectangle, recorded.hw, "twice")


def test_corners_and_crops(recorded: Recorded, views: Tensor, warp: Warp) -> None:
    height, width = recorded.hw
    frame = [[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]]
    corners = views.new_tensor(frame) @ views.mT
    corners = corners / corners[..., 2:]
    expected = torch.from_numpy(recorded["corners"]).double()
    torch.testing.assert_close(corners, expected, atol=0.01, rtol=0)
    x_min, x_max, y_min, y_max = torch.from_numpy(recorded["crop"]).double().unbind(1)
    assert torch.equal(warp.rectangle, torch.stack([x_min, y_min, x_max, y_max], 1) - 0.5)


def test_images_to_one_grey_level(recorded: Recorded, warp: Warp) -> None:
    """The release rounds to whole levels after each of its two interpolations."""
    images = (recorded.image() / 255).expand(VIEWS, -1, -1, -1)
    ours = 255 * warp.bilinear(images, levels=255)
    torch.testing.assert_close(ours, ours.round(), atol=1e-3, rtol=0)
    unrounded = (255 * warp.bilinear(images)).round()
    for view in range(VIEWS):
        levels, theirs = recorded.sampled(f"{view}.image", ours[view].round())
        without, _ = recorded.sampled(f"{view}.image", unrounded[view])
        difference = (levels - theirs).abs()
        assert float(difference.max()) <= 1
        assert float(difference.mean()) < 0.14
        assert float(difference.mean()) < 0.8 * float((without - theirs).abs().mean())


def test_labels_exactly(recorded: Recorded, warp: Warp) -> None:
    """Every recorded pixel; by the histograms one pixel of all 1.8 million lies elsewhere."""
    ours = warp.nearest(recorded.label().expand(VIEWS, -1, -1), 0)
    moved = 0
    for view in range(VIEWS):
        labels, theirs = recorded.sampled(f"{view}.label", ours[view])
        assert torch.equal(labels, theirs)
        histogram = torch.from_numpy(recorded[f"{view}.label_histogram"])
        moved += int((torch.bincount(ours[view].flatten(), minlength=9) - histogram).abs().sum())
    assert moved <= 2


def test_logits_agree_up_to_rounding_of_opencv(recorded: Recorded, warp: Warp) -> None:
    ours = warp.bilinear(recorded.logits().expand(VIEWS, -1, -1, -1))
    for view in range(VIEWS):
        logits, theirs = recorded.sampled(f"{view}.logits", ours[view])
        difference = (logits - theirs).abs()
        assert float(difference.mean()) < 0.0095
        assert float(difference.quantile(0.99)) < 0.05
        assert float(difference.max()) < 0.16


def test_a_published_view_of_a_published_image() -> None:
    """yaw 4, pitch 7, roll 1: means, a pixel, a histogram, given with the release's facts."""
    height, width = HW
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    image = torch.stack([x / 639, y / 479, (x + y) % 256 / 255, torch.full(HW, 127 / 255)])
    label = (x // 80 + y // 60) % 9
    logits = torch.stack([(0.01 * x * (k + 1) + 0.02 * y).sin() for k in range(9)])
    view = homography(torch.tensor([[4.0, 7.0, 1.0]]), RELEASED.matrix(HW), "zxy")
    warp = Warp(view, inner_rectangle(view, HW, "corners"), HW, "twice")

    levels = (image * 255).floor() / 255  # the release makes 8 bits of its input first
    warped = warp.bilinear(levels[None])[0]
    means = torch.tensor([0.463681, 0.571039, 0.505372, 0.498032])
    torch.testing.assert_close(warped.mean((1, 2)), means, atol=3e-3, rtol=0)
    pixel = torch.tensor([0.470588, 0.568627, 0.239216, 0.498039])
    torch.testing.assert_close(warped[:, 240, 320], pixel, atol=1.01 / 255, rtol=0)

    labels = warp.nearest(label[None], 0)[0]
    histogram = [34171, 29973, 29839, 29671, 30084, 31762, 37309, 43621, 40770]
    assert int(labels[240, 320]) == 7
    assert (torch.bincount(labels.flatten()) - torch.tensor(histogram)).abs().max() <= 4

    mean = warp.bilinear(logits[None])[0].mean((1, 2))[:3]
    expected = torch.tensor([-0.015261, -0.014591, -0.014940])
    torch.testing.assert_close(mean, expected, atol=2e-4, rtol=0)
