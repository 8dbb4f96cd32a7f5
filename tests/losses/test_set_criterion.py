from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from rgbt.checks import InputError, RunError
from rgbt.losses.masks import Sampling
from rgbt.losses.points import Points
from rgbt.losses.spatial import PLAIN, SpatialWeight
from rgbt.types import Output
from tests.benchmarks.reference_criterion import Replayed, reference_criterion
from tests.losses.problems import criterion_of, problem_of, seeded

EDGE = replace(PLAIN, alpha=2.0, focus="edge")


def gradients(parts: dict[str, Tensor], output: Output) -> list[Tensor]:
    total = torch.stack(list(parts.values())).sum()
    return list(torch.autograd.grad(total, list(output.aux.values()), retain_graph=True))


def replayed(sampling: Sampling, sets: tuple[int, int], batch: Any) -> Any:
    """The same draws for the batched criterion and for the reference, 64 matcher points."""
    layers, passes = sets
    targets = sum(len(set(label.unique().tolist()) - {255}) for label in batch.label)
    source = Points(seeded(5), device=torch.device("cpu"))
    matcher = source.matcher(layers * passes, len(batch.label), 64)
    loss = source.loss(layers * passes, targets, sampling.candidates + sampling.fresh)
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
    draws = replayed(criterion.sampling, sizes[:2], batch)
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
    draws = replayed(criterion.sampling, (2, 2), batch)
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


def test_sums_stay_in_float32_under_autocast() -> None:
    output, batch = problem_of(2, 2, 2)
    half = Output(None, {name: tensor.bfloat16() for name, tensor in output.aux.items()})
    rounded = Output(None, {name: tensor.float() for name, tensor in half.aux.items()})
    expected = criterion_of()(rounded, batch, seeded())
    with torch.autocast("cpu", torch.bfloat16):
        parts = criterion_of()(half, batch, seeded())
    for name, part in parts.items():
        assert part.dtype == torch.float32
        assert torch.equal(part, expected[name])


def test_predictions_and_labels_that_do_not_fit_are_refused() -> None:
    output, batch = problem_of(1, 2, 2)
    criterion, label, aux = criterion_of(), batch.label, output.aux
    nan = {**aux, "class_logits": aux["class_logits"] * float("nan")}
    cut = {**aux, "mask_logits": aux["mask_logits"][:, :1]}
    for loss, given, changed, error, word in (
        (criterion, Output(torch.zeros(2, 5, 22, 32), {}), batch, InputError, "mask_logits"),
        (criterion_of(num_classes=4), output, batch, ValueError, "class_logits"),
        (criterion, Output(None, cut), batch, ValueError, "mask_logits"),
        (criterion, output, replace(batch, label=label[:1]), ValueError, "label"),
        (criterion, output, replace(batch, label=label.repeat(1, 2, 1)), ValueError, "not fit"),
        (criterion, output, replace(batch, label=label + 1), ValueError, "expected 0 to 4 or 255"),
        (criterion_of(spatial=EDGE), output, replace(batch, position=None), InputError, "position"),
        (criterion, Output(None, nan), batch, RunError, "matching cost"),
    ):
        with pytest.raises(error, match=word):
            loss(given, changed, seeded())
