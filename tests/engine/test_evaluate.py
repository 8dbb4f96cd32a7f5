"""Predictions of networks with several heads: each image by its own, at the size of its label."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from rgbt.checks import RunError
from rgbt.engine.evaluate import class_maps, class_scores
from rgbt.randomness import torch_generator
from rgbt.types import Batch, Output, View

HEADS = ("day", "night", "dusk")


class Heads(nn.Module):
    """Scores that show image, view and head; records its arguments."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.backbone = nn.Sequential(nn.Conv2d(4, 6, 3, padding=1), nn.BatchNorm2d(6), nn.ReLU())
        self.heads = nn.ModuleDict({name: nn.Conv2d(6, 5, 1) for name in HEADS})
        self.calls: list[tuple[Any, ...]] = []

    def forward(
        self,
        rgb: Tensor,
        thermal: Tensor,
        *,
        views: tuple[View, ...] = (),
        head: str | None = None,
    ) -> Output:
        self.calls.append((len(rgb), views, head))
        image = torch.cat([rgb * (views != ("thermal",)), thermal * (views != ("rgb",))], 1)
        return Output(self.heads[head or "day"](self.backbone(image)), {})


def batch(size: int = 7) -> Batch:
    draw = torch_generator(0, "images")
    return Batch(
        rgb=torch.rand(size, 3, 6, 8, generator=draw),
        thermal=torch.rand(size, 1, 6, 8, generator=draw),
        label=torch.zeros(size, 12, 16, dtype=torch.int64),
        name=tuple(map(str, range(size))),
        centre_yx=torch.zeros(size, 2, dtype=torch.int64),
        position=None,
        original_hw=torch.full((size, 2), 12),
    )


@pytest.fixture
def model() -> Heads:
    return Heads().eval()


@pytest.mark.parametrize("view", [None, "rgb", "thermal"])
@pytest.mark.parametrize(
    "chosen", [(0, 1, 0, 0, 1, 2, 0), (1, 0, 0, 0, 0, 0, 0), (2, 2, 1, 1, 0, 0, 0), (1,) * 7]
)
def test_mixed_heads_equal_every_image_alone(
    model: Heads, chosen: tuple[int, ...], view: View | None
) -> None:
    images, heads = batch(), tuple(HEADS[index] for index in chosen)
    found = class_scores(model, images, view, heads)
    assert len(model.calls) == len(set(heads))
    requested: dict[str, Any] = {} if view is None else {"views": (view,)}
    for index, head in enumerate(heads):
        rgb, thermal = images.rgb[index : index + 1], images.thermal[index : index + 1]
        alone = model(rgb, thermal, head=head, **requested).logits[0]
        torch.testing.assert_close(found[index], alone, atol=1e-6, rtol=1e-5)
    classes = class_maps(model, images, Fabric(accelerator="cpu", devices=1), view, heads)
    assert (classes.shape, classes.dtype) == ((7, 12, 16), torch.uint8)


def test_what_is_not_chosen_is_left_to_the_network(model: Heads) -> None:
    for heads in ((), (None,) * 7):
        class_scores(model, batch(), None, heads)
    class_scores(model, batch(), "rgb", ("day",) * 7)
    assert model.calls == [(7, (), None), (7, (), None), (7, ("rgb",), "day")]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_scores_that_are_not_finite_are_refused_with_the_image(model: Heads, value: float) -> None:
    fabric = Fabric(accelerator="cpu", devices=1)
    data = batch(3)
    data.rgb[1, 0, 2, 3] = value
    with pytest.raises(RunError, match="^image '1': the network's class scores are NaN or inf"):
        class_maps(model, data, fabric)
