from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from torch import Tensor

from rgbt.checks import InputError, RunError
from rgbt.losses import set_criterion as module
from rgbt.losses.masks import Sampling
from rgbt.losses.points import PointSource
from rgbt.losses.spatial import PLAIN, SpatialWeight
from rgbt.types import Output

ROOT = Path(__file__).resolve().parents[2]
EDGE = replace(PLAIN, alpha=2.0, focus="edge")


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def gradients(parts: dict[str, Tensor], output: Output) -> list[Tensor]:
    total = torch.stack(list(parts.values())).sum()
    return list(torch.autograd.grad(total, list(output.aux.values()), retain_graph=True))


def replayed(reference: ModuleType, sampling: Sampling, sets: tuple[int, int], batch: Any) -> Any:
    """The same draws for the batched criterion and for the reference, 64 matcher points."""
    layers, passes = sets
    targets = sum(len(set(label.unique().tolist()) - {255}) for label in batch.label)
    source = PointSource(seeded(5), device=torch.device("cpu"))
    matcher = source.matcher(layers * passes, len(batch.label), 64)
    loss = source.loss(layers * passes, targets, sampling.candidates + sampling.fresh)
    return reference.Replayed(matcher, loss, passes)


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
    reference: ModuleType,
    make_problem: Any,
    make_criterion: Any,
    spatial: SpatialWeight,
    sizes: tuple[int, int, int],
) -> None:
    output, batch = make_problem(*sizes)
    criterion = make_criterion(spatial=spatial)
    draws = replayed(reference, criterion.sampling, sizes[:2], batch)
    batched = criterion.compare(output, batch, draws)
    expected = reference.reference_criterion(criterion, output, batch, draws)
    for name, part in batched.items():
        assert part.shape == (sizes[1],)
        assert torch.allclose(part, expected[name], rtol=1e-5, atol=1e-6), name
    for ours, theirs in zip(gradients(batched, output), gradients(expected, output), strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("queries", [2, 4])
def test_more_targets_than_queries(
    reference: ModuleType, make_problem: Any, make_criterion: Any, queries: int
) -> None:
    output, batch = make_problem(2, 2, 2, queries=queries)
    criterion = make_criterion()
    draws = replayed(reference, criterion.sampling, (2, 2), batch)
    batched = criterion.compare(output, batch, draws)
    expected = reference.reference_criterion(criterion, output, batch, draws)
    for name, part in batched.items():
        assert torch.allclose(part, expected[name], rtol=1e-5), name


def test_only_the_last_layer_without_deep_supervision(
    make_problem: Any, make_criterion: Any
) -> None:
    output, batch = make_problem(3, 2, 2)
    last = Output(None, {name: tensor[-1:] for name, tensor in output.aux.items()})
    shallow = make_criterion(deep_supervision=False)(output, batch, seeded())
    expected = make_criterion()(last, batch, seeded())
    for name, part in shallow.items():
        assert torch.equal(part, expected[name])


@pytest.mark.parametrize(
    "spatial",
    [
        replace(EDGE, alpha=0.0, dice_smoothing="none", normaliser="weights", match="weighted"),
        replace(EDGE, focus="none"),
    ],
)
def test_alpha_0_and_focus_none_are_the_plain_loss_bit_for_bit(
    make_problem: Any, make_criterion: Any, spatial: SpatialWeight
) -> None:
    output, batch = make_problem(2, 4, 2)
    plain = make_criterion()(output, batch, seeded())
    off = make_criterion(spatial=spatial)(output, replace(batch, position=None), seeded())
    for name, part in plain.items():
        assert torch.equal(part, off[name])
    for ours, theirs in zip(gradients(plain, output), gradients(off, output), strict=True):
        assert torch.equal(ours, theirs)


def test_weights_change_mask_and_dice_alone(make_problem: Any, make_criterion: Any) -> None:
    output, batch = make_problem(1, 4, 2)
    plain = make_criterion()(output, batch, seeded())
    weighted = make_criterion(spatial=EDGE)(output, batch, seeded())
    assert torch.equal(plain["class"], weighted["class"])
    assert (weighted["mask"] > plain["mask"]).all()  # every weight lies in [1, 3]
    assert (weighted["mask"] < 3 * plain["mask"]).all()
    assert (weighted["dice"] != plain["dice"]).all()


def test_passes_do_not_touch_each_other(make_problem: Any, make_criterion: Any) -> None:
    output, batch = make_problem(2, 3, 2)
    parts = make_criterion()(output, batch, seeded())
    for name in parts:
        for tensor in torch.autograd.grad(
            parts[name][1], list(output.aux.values()), retain_graph=True, allow_unused=True
        ):
            assert tensor is None or not tensor[:, [0, 2]].any()


def test_unchosen_masks_get_no_gradient(make_problem: Any, make_criterion: Any) -> None:
    output, batch = make_problem(1, 1, 1)
    _, masks = gradients(make_criterion()(output, batch, seeded()), output)
    targets = len(set(batch.label.unique().tolist()) - {255})
    assert int((masks.flatten(4).abs().sum(-1) > 0).sum()) == targets


def test_a_batch_without_targets(make_problem: Any, make_criterion: Any) -> None:
    output, batch = make_problem(2, 2, 2)
    empty = replace(batch, label=torch.full_like(batch.label, 255))
    parts = make_criterion(spatial=EDGE)(output, empty, seeded())
    assert parts["mask"].tolist() == [0.0, 0.0]
    assert parts["dice"].tolist() == [0.0, 0.0]
    # All queries are "no object": the mean of their cross-entropies, over both layers.
    no_object = -output.aux["class_logits"].log_softmax(-1)[..., -1].mean((2, 3)).sum(0)
    assert torch.allclose(parts["class"], 2.0 * no_object)
    classes, masks = gradients(parts, output)  # masks stay part of the graph
    assert classes.any()
    assert not masks.any()


def test_targets_are_counted_over_all_processes(
    make_problem: Any, make_criterion: Any, monkeypatch: Any
) -> None:
    output, batch = make_problem(1, 2, 2)
    alone = make_criterion()(output, batch, seeded())
    targets = sum(len(set(label.unique().tolist()) - {255}) for label in batch.label)

    def add_the_other_process(count: Tensor) -> None:
        count += 3 * targets  # it holds three times as many: (1 + 3) / 2 = 2 on average

    monkeypatch.setattr(module.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(module.distributed, "all_reduce", add_the_other_process)
    monkeypatch.setattr(module.distributed, "get_world_size", lambda: 2)
    shared = make_criterion()(output, batch, seeded())
    assert torch.equal(shared["class"], alone["class"])
    for name in ("mask", "dice"):
        assert torch.allclose(shared[name], alone[name] / 2)


def test_a_perfect_prediction_costs_little(make_batch: Any, make_criterion: Any) -> None:
    label = torch.arange(4).repeat_interleave(8)[None, None].expand(1, 32, 32).contiguous()
    masks = torch.stack([label[0, ::4, ::4] == k for k in range(4)]) * 40.0 - 20.0
    classes = 20.0 * torch.eye(6)[:4]
    aux = {"class_logits": classes[None, None, None], "mask_logits": masks[None, None, None]}
    parts = make_criterion()(Output(None, aux), make_batch(label), seeded())
    wrong = {**aux, "mask_logits": -aux["mask_logits"]}
    worse = make_criterion()(Output(None, wrong), make_batch(label), seeded())
    assert parts["class"] < 1e-6
    for name in ("mask", "dice"):
        assert parts[name] < 0.1 * worse[name]


def test_the_same_generator_gives_the_same_loss(make_problem: Any, make_criterion: Any) -> None:
    output, batch = make_problem(2, 2, 2)
    criterion = make_criterion()
    first, again, other = (criterion(output, batch, seeded(s))["mask"] for s in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_sums_stay_in_float32_under_autocast(make_problem: Any, make_criterion: Any) -> None:
    output, batch = make_problem(2, 2, 2)
    half = Output(None, {name: tensor.bfloat16() for name, tensor in output.aux.items()})
    rounded = Output(None, {name: tensor.float() for name, tensor in half.aux.items()})
    expected = make_criterion()(rounded, batch, seeded())
    with torch.autocast("cpu", torch.bfloat16):
        parts = make_criterion()(half, batch, seeded())
    for name, part in parts.items():
        assert part.dtype == torch.float32
        assert torch.equal(part, expected[name])


def test_raises(make_problem: Any, make_criterion: Any) -> None:
    output, batch = make_problem(1, 2, 2)
    criterion = make_criterion()
    with pytest.raises(InputError, match="mask_logits"):
        criterion(Output(torch.zeros(2, 5, 22, 32), {}), batch, seeded())
    with pytest.raises(ValueError, match="class_logits"):
        make_criterion(num_classes=4)(output, batch, seeded())
    cut = {**output.aux, "mask_logits": output.aux["mask_logits"][:, :1]}
    with pytest.raises(ValueError, match="mask_logits"):
        criterion(Output(None, cut), batch, seeded())
    with pytest.raises(ValueError, match="label"):
        criterion(output, replace(batch, label=batch.label[:1]), seeded())
    with pytest.raises(ValueError, match="does not fit"):
        criterion(output, replace(batch, label=batch.label.repeat(1, 2, 1)), seeded())
    with pytest.raises(ValueError, match="expected 0 to 4 or 255"):
        criterion(output, replace(batch, label=batch.label + 1), seeded())
    with pytest.raises(InputError, match="track_position"):
        make_criterion(spatial=EDGE)(output, replace(batch, position=None), seeded())
    bad = {**output.aux, "class_logits": output.aux["class_logits"] * float("nan")}
    with pytest.raises(RunError, match="matching cost"):
        criterion(Output(None, bad), batch, seeded())


@pytest.mark.parametrize("name", ["set_criterion", "set_criterion_spatial", "cross_entropy"])
def test_configuration_files_name_every_setting(name: str) -> None:
    node = OmegaConf.load(ROOT / "conf" / "loss" / f"{name}.yaml")
    assert isinstance(OmegaConf.to_container(node), dict)
    if name == "set_criterion_spatial":
        node = node.spatial
        assert set(node) == set(SpatialWeight.__dataclass_fields__)
        assert SpatialWeight(**node).active
