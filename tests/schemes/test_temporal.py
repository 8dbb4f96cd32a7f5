"""Two frames through shared weights: which calls are made, and what the loss is given."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.geometry.camera import Camera
from rgbt.geometry.warp import Warp, halved_all, halved_mean
from rgbt.models.mask2former.network import semantic_logits
from rgbt.requirements import LossRecord
from rgbt.schemes.temporal import Temporal
from rgbt.transforms.views import VirtualView
from rgbt.types import Batch, Frame, Output
from tests.losses.problems import batch_of
from tests.models.plain import images
from tests.models.test_mask2former import nano

B, K, HW = 3, 4, (48, 64)


def generator_of(purpose: str) -> torch.Generator:
    return torch.Generator().manual_seed(len(purpose))


def batch(count: int = B, hw: tuple[int, int] = HW) -> Batch:
    rgb, thermal = images(count, *hw)
    label = torch.randint(K, (count, *hw), generator=torch.Generator().manual_seed(5))
    return replace(batch_of(label), rgb=rgb, thermal=thermal)


class Net(nn.Module):
    """Two convolutions; counts its calls."""

    def __init__(self, norm: nn.Module) -> None:
        super().__init__()
        with torch.random.fork_rng():
            torch.manual_seed(0)
            self.first, self.last = nn.Conv2d(4, 6, 3, padding=1), nn.Conv2d(6, K, 1)
        self.norm = norm
        self.calls: list[int] = []

    def forward(self, rgb: Tensor, thermal: Tensor, *, generator: Any = None) -> Output:
        self.calls.append(len(rgb))
        inner = self.norm(self.first(torch.cat([rgb, thermal], 1))).relu()
        return Output(self.last(inner), {"inner": inner})


class Recorded:
    """A loss of two frames, and of their queries, that keeps what it is given."""

    record = LossRecord(frames=2, reads_warped=True)

    def __call__(
        self, first: Frame, second: Frame, warped: Tensor, valid: Tensor, generator: Any
    ) -> dict[str, Tensor]:
        self.first, self.second, self.warped, self.valid = first, second, warped, valid
        parts = [(f.logits * f.batch.label[:, None]).square().mean() for f in (first, second)]
        half = warped.shape[2:] != second.logits.shape[2:]
        compared = halved_mean(second.logits) if half else second.logits
        parts.append((warped - compared.softmax(1)).square().mean())
        queries = [frame.output.aux.get("class_logits") for frame in (first, second)]
        parts += [logits.square().mean() for logits in queries if logits is not None]
        return {str(number): part for number, part in enumerate(parts)}


def view(**changes: Any) -> VirtualView:
    settings: dict[str, Any] = {
        "camera": Camera(fx=70.0, fy=70.0, cx=31.5, cy=23.5, height=48, width=64),
        "order": "zyx",
        "yaw": (-10.0, 10.0),
        "pitch": (-10.0, 10.0),
        "roll": (-5.0, 5.0),
        "angles": "uniform",
        "mode": "both",
        "rectangle": "largest",
        "resampling": "once",
        "outside": "ignore",
    }
    return VirtualView(**{**settings, **changes})


def scheme(model: Any, **changes: Any) -> Temporal:
    settings: dict[str, Any] = {"loss": Recorded(), "view": view()}
    return Temporal(
        model=model, **{**settings, "warps": "probabilities", "detach": False} | changes
    )


def step(temporal: Temporal, given: Batch | None = None) -> Any:
    """The loss that has seen a step, after its backward pass."""
    (phase,) = temporal.phases(given or batch(), generator_of)
    assert phase.optimizers == ("main",)
    torch.stack(list(phase.parts.values())).sum().backward()
    return temporal.loss


def gradients(module: nn.Module) -> list[Tensor]:
    found = [parameter.grad for parameter in module.parameters()]
    assert all(gradient is not None and gradient.isfinite().all() for gradient in found)
    return [gradient for gradient in found if gradient is not None]


@pytest.mark.parametrize(
    ("norm", "calls"),
    [
        (nn.BatchNorm2d(6), 2),
        (nn.SyncBatchNorm(6).eval(), 2),
        (nn.GroupNorm(2, 6), 1),
        (nn.Identity(), 1),
    ],
)
def test_outputs_gradients_and_statistics_are_those_of_two_calls(
    norm: nn.Module, calls: int
) -> None:
    net, given = Net(norm), batch()
    apart = deepcopy(net)
    loss = step(scheme(net), given)
    assert net.calls == [2 * B // calls] * calls

    # The second frame is the view of the first; every sample turns by its own angles.
    drawn = view().draw(B, generator_of("virtual view"))
    warp = view().warp(drawn, HW)
    assert len(set(drawn[:, 0].tolist())) == B
    frames = loss.first.batch, loss.second.batch
    assert frames[0] is given
    assert torch.equal(frames[1].rgb, view().batch(given, warp).rgb)
    assert torch.equal(frames[1].label, view().batch(given, warp).label)
    assert torch.equal(loss.valid, warp.inside())
    outputs = [apart(frame.rgb, frame.thermal) for frame in frames]
    first, second = (Frame(o, f, o.logits) for o, f in zip(outputs, frames, strict=True))
    warped = warp.bilinear(outputs[0].logits.softmax(1))
    parts = Recorded()(first, second, warped, loss.valid, None)
    torch.stack(list(parts.values())).sum().backward()
    for frame, output in zip((loss.first, loss.second), outputs, strict=True):
        torch.testing.assert_close(frame.logits, output.logits)
        torch.testing.assert_close(frame.output.aux["inner"], output.aux["inner"])
        assert frame.logits is frame.output.logits
    for mine, theirs in zip(gradients(net), gradients(apart), strict=True):
        torch.testing.assert_close(mine, theirs)
    for mine, theirs in zip(net.buffers(), apart.buffers(), strict=True):
        torch.testing.assert_close(mine, theirs)


class Half:
    """A view that lies half a pixel to the right: each pixel is the mean of two."""

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        return torch.zeros(count, 3)

    def warp(self, angles: Tensor, image_hw: tuple[int, int]) -> Warp:
        shift = torch.eye(3, dtype=torch.float64).repeat(len(angles), 1, 1)
        shift[:, 0, 2] = -0.5
        edges = [-0.5, -0.5, image_hw[1] - 0.5, image_hw[0] - 0.5]
        return Warp(shift, torch.tensor([edges]).double().expand(len(angles), 4), image_hw, "once")

    def batch(self, batch: Batch, warp: Warp) -> Batch:
        return batch

    def valid(self, warp: Warp) -> Tensor:
        return warp.inside()


class Fixed(nn.Module):
    """Scores of two classes: 0 and log 3 times 0, 1, 2, 0 along a row of four pixels."""

    def __init__(self) -> None:
        super().__init__()
        row = torch.tensor([0.0, 1.0, 2.0, 0.0]) * torch.log(torch.tensor(3.0))
        self.scores = nn.Parameter(torch.stack([torch.zeros(4), row])[None, :, None])

    def forward(self, rgb: Tensor, thermal: Tensor, *, generator: Any = None) -> Output:
        return Output(self.scores.expand(len(rgb), 2, 1, 4), {})


@pytest.mark.parametrize(
    ("warps", "expected"),
    [
        # Shares of class 2: 1/2, 3/4, 9/10, 1/2; the last pixel has no neighbour on the right.
        ("probabilities", [0.625, 0.825, 0.7, 0.5]),
        # Mean scores of class 2: log 3 times 1/2, 3/2, 1, 0.
        ("logits", [3**0.5 / (1 + 3**0.5), 3**1.5 / (1 + 3**1.5), 0.75, 0.5]),
    ],
)
@pytest.mark.parametrize("detach", [False, True])
def test_scores_or_probabilities_are_brought_into_the_second_frame(
    warps: Any, expected: list[float], detach: bool
) -> None:
    net = Fixed()
    temporal = scheme(net, view=Half(), warps=warps, detach=detach)
    (_,) = temporal.phases(batch(1, (1, 4)), generator_of)
    warped: Tensor = temporal.loss.warped
    assert warped[0, 1, 0].tolist() == pytest.approx(expected)
    assert warped.sum(1)[0, 0].tolist() == pytest.approx([1] * 4)
    assert warped.requires_grad is not detach
    if not detach:
        warped[0, 1, 0, 2].backward()
        assert net.scores.grad is not None
        touched = net.scores.grad[0, 1, 0] != 0
        assert touched.tolist() == [False, False, True, True]


@pytest.mark.parametrize("hw", [HW, (48, 61)])
@pytest.mark.parametrize("warps", ["probabilities", "logits"])
def test_half_resolution_warps_means_of_two_by_two_scores(warps: Any, hw: tuple[int, int]) -> None:
    camera = Camera(fx=70.0, fy=70.0, cx=31.5, cy=23.5, height=hw[0], width=hw[1])
    turned = view(mode="rotation", camera=camera)
    full, half = (
        step(scheme(Net(nn.Identity()), view=turned, warps=warps, resolution=size), batch(hw=hw))
        for size in ("full", "half")
    )
    scores = halved_mean(full.first.logits)
    warp = turned.warp(turned.draw(B, generator_of("virtual view")), hw).halved()
    expected = (
        warp.bilinear(scores.softmax(1))
        if warps == "probabilities"
        else warp.bilinear(scores).softmax(1)
    )
    assert half.warped.shape == (B, K, 24, -(-hw[1] // 2))
    assert torch.equal(half.warped, expected)
    counted = halved_all(full.valid)
    assert torch.equal(half.valid[..., :-1], counted[..., :-1])
    assert not bool((half.valid & ~counted).any())
    assert not counted.all()
    assert torch.equal(half.second.logits, full.second.logits)  # itself, it is whole


class Smaller(Half):
    """A view in which a step of one pixel is one of three pixels of the first frame."""

    def warp(self, angles: Tensor, image_hw: tuple[int, int]) -> Warp:
        still = super().warp(angles, image_hw)
        shrink = torch.eye(3, dtype=torch.float64).repeat(len(angles), 1, 1)
        shrink[:, 0, 0], shrink[:, 0, 2] = 1 / 3, 4 - 4.4 / 3  # the last pixel shows column 4.4
        return replace(still, homography=shrink)


def test_half_pixel_beyond_the_first_frame_does_not_count() -> None:
    """The last of five columns shows 4.4, and half a pixel further is 5.9, beyond 5.5."""
    shown = scheme(Net(nn.Identity()), view=Smaller(), loss=Recorded(), resolution="half")
    loss = step(shown, batch(1, (2, 5)))
    full = Smaller().warp(torch.zeros(1, 3), (2, 5))
    assert full.inside()[0, 0].tolist() == [False, False, False, True, True]
    assert halved_all(full.inside()).tolist() == [[[False, False, True]]]
    assert not loss.valid.any()


def test_dense_logits_are_the_logarithm_of_semantic_scores() -> None:
    net, hw = nano().train(), (60, 84)
    output = net(*images(2, *hw))
    dense = net.dense_logits(output, hw)
    assert dense.shape == (2, K, *hw)
    classes = output.aux["class_logits"][-1, 0].softmax(-1)[..., :-1]
    masks = F.interpolate(output.aux["mask_logits"][-1, 0], (64, 96), mode="bilinear").sigmoid()
    scores = torch.einsum("bqk,bqhw->bkhw", classes, masks)[..., : hw[0], : hw[1]]
    torch.testing.assert_close(dense.softmax(1), scores / scores.sum(1, keepdim=True))
    # Of a class that no query names, logits and gradients are finite.
    classes = torch.tensor([[[200.0, -200.0, 0.0]]], requires_grad=True)
    masks = torch.full((1, 1, 8, 8), 3.0, requires_grad=True)
    output = Output(None, {"class_logits": classes[None, None], "mask_logits": masks[None, None]})
    dense = net.dense_logits(output, (32, 32))
    assert semantic_logits(classes, masks, (32, 32), (32, 32)).min() == 0
    assert dense.isfinite().all()
    dense.softmax(1).square().sum().backward()
    assert classes.grad.isfinite().all()
    assert masks.grad.isfinite().all()
