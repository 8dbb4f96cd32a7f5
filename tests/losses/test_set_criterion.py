from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from rgbt.checks import InputError, RunError
from rgbt.losses import set_criterion
from rgbt.losses.points import Points
from rgbt.losses.set_criterion import SetCriterion, mask_and_dice
from rgbt.losses.spatial import PLAIN, PointWeights, SpatialWeight
from rgbt.types import Output
from tests.benchmarks.reference_criterion import Replayed, reference_criterion
from tests.losses.problems import criterion_of, problem_of, seeded

EDGE = replace(PLAIN, alpha=2.0, focus="edge")


def gradients(parts: dict[str, Tensor], output: Output) -> list[Tensor]:
    total = torch.stack(list(parts.values())).sum()
    return list(torch.autograd.grad(total, list(output.aux.values()), retain_graph=True))


def replayed(criterion: SetCriterion, sets: tuple[int, int], batch: Any) -> Any:
    """The same draws for the batched criterion and for the reference, 64 matcher points."""
    layers, passes = sets
    targets = sum(len(set(label.unique().tolist()) - {255}) for label in batch.label)
    source = Points(seeded(5), device=torch.device("cpu"))
    matcher = source.matcher(layers * passes, len(batch.label), 64)
    loss = source.loss(layers * passes, targets, criterion.num_drawn)
    return Replayed(matcher, loss, passes)


SPATIAL = [
    PLAIN,
    EDGE,
    replace(EDGE, focus="center", normaliser="weights", dice_smoothing="none"),
    replace(EDGE, match="weighted", padding="zero", passes="fused", dice_smoothing="none"),
    replace(EDGE, match="weighted", normaliser="weights", centre="crop", d_max="crop"),
]


@pytest.mark.parametrize("spatial", SPATIAL)
@pytest.mark.parametrize("sizes", [(3, 4, 2), (1, 1, 3), (2, 3, 1), (2, 2, 2)])
def test_equals_the_loop_over_passes_layers_and_images(
    spatial: SpatialWeight, sizes: tuple[int, int, int]
) -> None:
    output, batch = problem_of(*sizes)
    criterion = criterion_of(spatial=spatial)
    draws = replayed(criterion, sizes[:2], batch)
    batched = criterion.compare(output, batch, draws)
    expected = reference_criterion(criterion, output, batch, draws)
    for name, part in batched.items():
        assert part.shape == (sizes[1],)
        assert torch.allclose(part, expected[name], rtol=1e-5, atol=1e-6), name
    for ours, theirs in zip(gradients(batched, output), gradients(expected, output), strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("queries", [2, 4])
def test_more_targets_than_queries(queries: int) -> None:
    output, batch = problem_of(2, 2, 2, queries=queries)
    criterion = criterion_of()
    draws = replayed(criterion, (2, 2), batch)
    batched = criterion.compare(output, batch, draws)
    expected = reference_criterion(criterion, output, batch, draws)
    for name, part in batched.items():
        assert torch.allclose(part, expected[name], rtol=1e-5), name


def test_only_the_last_layer_without_deep_supervision() -> None:
    output, batch = problem_of(3, 2, 2)
    last = Output(None, {name: tensor[-1:] for name, tensor in output.aux.items()})
    shallow = criterion_of(deep_supervision=False)(output, batch, seeded())
    expected = criterion_of()(last, batch, seeded())
    for name, part in shallow.items():
        assert torch.equal(part, expected[name])


@pytest.mark.parametrize(
    "spatial",
    [
        replace(EDGE, alpha=0.0, dice_smoothing="none", normaliser="weights", match="weighted"),
        replace(EDGE, focus="none"),
    ],
)
def test_alpha_0_and_focus_none_are_the_plain_loss_bit_for_bit(spatial: SpatialWeight) -> None:
    output, batch = problem_of(2, 4, 2)
    plain = criterion_of()(output, batch, seeded())
    off = criterion_of(spatial=spatial)(output, replace(batch, position=None), seeded())
    for name, part in plain.items():
        assert torch.equal(part, off[name])
    for ours, theirs in zip(gradients(plain, output), gradients(off, output), strict=True):
        assert torch.equal(ours, theirs)


def test_a_batch_without_targets() -> None:
    output, batch = problem_of(2, 2, 2)
    empty = replace(batch, label=torch.full_like(batch.label, 255))
    parts = criterion_of(spatial=EDGE)(output, empty, seeded())
    assert parts["mask"].tolist() == [0.0, 0.0]
    assert parts["dice"].tolist() == [0.0, 0.0]
    # All queries are "no object": the mean of their cross-entropies, over both layers.
    no_object = -output.aux["class_logits"].log_softmax(-1)[..., -1].mean((2, 3)).sum(0)
    assert torch.allclose(parts["class"], 2.0 * no_object)
    classes, masks = gradients(parts, output)  # masks stay part of the graph
    assert classes.any()
    assert not masks.any()


def test_predictions_and_labels_that_do_not_fit_are_refused() -> None:
    output, batch = problem_of(1, 2, 2)
    criterion, label, aux = criterion_of(), batch.label, output.aux
    nan = {**aux, "class_logits": aux["class_logits"] * float("nan")}
    cut = {**aux, "mask_logits": aux["mask_logits"][:, :1]}
    for loss, given, changed, error, word in (
        (criterion_of(num_classes=4), output, batch, ValueError, "do not fit"),
        (criterion, Output(None, cut), batch, ValueError, "do not fit"),
        (criterion, output, replace(batch, label=label[:1]), ValueError, "do not fit"),
        (criterion, output, replace(batch, label=label.repeat(1, 2, 1)), ValueError, "do not fit"),
        (criterion, output, replace(batch, label=label + 1), ValueError, "expected 0 to 4 or 255"),
        (criterion_of(spatial=EDGE), output, replace(batch, position=None), InputError, "position"),
        (criterion, Output(None, nan), batch, RunError, "matching cost"),
    ):
        with pytest.raises(error, match=word):
            loss(given, changed, seeded())


def test_plain_losses_by_hand() -> None:
    # s = 1/2 and 3/4 against t = 1 and 0: BCE = (log 2 + log 4) / 2,
    # dice = 1 - (2 * 1/2 + 1) / (5/4 + 1 + 1) = 1 - 8/13.
    x, t = torch.tensor([[0.0, math.log(3)]]), torch.tensor([[1.0, 0.0]])
    bce, dice = mask_and_dice(x, t, None)
    assert torch.allclose(bce, torch.tensor([1.5 * math.log(2)]))
    assert torch.allclose(dice, torch.tensor([5 / 13]))


def test_weighted_losses_by_hand() -> None:
    # The same with weights 1 and 3, divided by two points: BCE = (log 2 + 3 log 4) / 2;
    # dice without smoothing = 1 - (2 * 1/2) / (1/2 + 9/4 + 1) = 1 - 4/15.
    x, t = torch.tensor([[0.0, math.log(3)]]), torch.tensor([[1.0, 0.0]])
    w = PointWeights(torch.tensor([[1.0, 3.0]]), torch.tensor([2.0]), torch.tensor([0.0]))
    bce, dice = mask_and_dice(x, t, w)
    assert torch.allclose(bce, torch.tensor([3.5 * math.log(2)]))
    assert torch.allclose(dice, torch.tensor([11 / 15]))


def test_large_logits_stay_finite() -> None:
    x = torch.tensor([[200.0, -200.0]], requires_grad=True)
    bce, dice = mask_and_dice(x, torch.tensor([[0.0, 1.0]]), None)
    assert bce.item() == 200.0
    (bce + dice).sum().backward()
    assert x.grad is not None
    assert x.grad.isfinite().all()


def test_gradients() -> None:
    generator = seeded(0)
    x = torch.randn(3, 6, dtype=torch.float64, generator=generator, requires_grad=True)
    t = torch.rand(3, 6, dtype=torch.float64, generator=generator)
    w = PointWeights(1 + t, (1 + t).sum(-1), torch.zeros(3, dtype=torch.float64))
    assert torch.autograd.gradcheck(lambda x: mask_and_dice(x, t, None), x)
    assert torch.autograd.gradcheck(lambda x: mask_and_dice(x, t, w), x)


def test_losses_do_not_depend_on_the_chunks(monkeypatch: Any) -> None:
    output, batch = problem_of(3, 4, 2)
    criterion = criterion_of()

    def losses() -> torch.Tensor:
        points = Points(seeded(0), device=torch.device("cpu"))
        return torch.stack(list(criterion.compare(output, batch, points).values()))

    whole = losses()
    monkeypatch.setattr(set_criterion, "CHUNK_BYTES", 1)
    assert torch.allclose(whole, losses(), rtol=1e-6)
