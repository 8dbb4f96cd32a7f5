"""CMX and CMNeXt: values by second computations, where maps go, random drops, starting weights."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.cmnext import PoolingGate, PpxBlock, window_mean
from rgbt.models.cmx.model import drop_rates
from rgbt.models.cmx.parts import CrossAttention, Rectification
from tests.models.plain import generator, images, nano, normal, randomise

BOTH = pytest.mark.parametrize("name", ["cmx", "cmnext"])


def drawn(module: nn.Module) -> Any:
    """Every parameter far from its start."""
    g = generator(5)
    for parameter in module.parameters():
        nn.init.normal_(parameter, std=0.5, generator=g)
    return module


@BOTH
def test_rectified_maps_continue_and_fused_maps_are_decoded(name: str) -> None:
    net = nano(name).eval()
    rectified, fused, fed = [], [], []
    for rectify, fuse in zip(net.backbone.FRMs, net.backbone.FFMs, strict=True):
        rectify.register_forward_hook(lambda _m, _i, out: rectified.append(out))
        fuse.register_forward_hook(lambda _m, args, out: fused.append((args, out)))
    for stage in (2, 3, 4):
        for prefix in ("", "extra_"):
            embed = net.backbone.get_submodule(f"{prefix}patch_embed{stage}")
            embed.register_forward_pre_hook(lambda _m, args: fed.append(args[0]))
    net.decode_head.register_forward_pre_hook(lambda _m, args: fed.extend(args[0]))
    net(*images(1))
    assert all(a is b for pair, (args, _) in zip(rectified, fused) for a, b in zip(pair, args))
    expected = [x for pair in rectified[:3] for x in pair] + [out for _, out in fused]
    assert len(fed) == len(expected) == 10
    assert all(a is b for a, b in zip(fed, expected))


def test_eps_of_every_normalisation() -> None:
    """CMX: 1e-6 in blocks and after stages; CMNeXt: in the layers of the thermal stream."""
    for name in ("cmx", "cmnext"):
        for path, module in nano(name).named_modules():
            expected = 1e-5
            if isinstance(module, nn.LayerNorm):
                inside = "block" in path or "norm" in path.split(".")[1]
                own = inside and path.endswith(("norm1", "norm2", "norm3", "norm4"))
                is_fine = own if name == "cmx" else "extra_" in path
                expected = 1e-6 if is_fine else 1e-5
            elif isinstance(module, nn.BatchNorm2d) and name == "cmx":
                expected = 1e-3 if path.startswith("decode_head") else 1e-5
            assert getattr(module, "eps", expected) == expected, path


def test_rectification_by_hand() -> None:
    """Weights from biases alone: 1/4 by channel and 1/2 by place of x1, 3/4 and 9/10 of x2."""
    layer = Rectification(1)
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    biases = (layer.channel_weights.mlp[-1].bias, layer.spatial_weights.mlp[-1].bias)
    for bias, shares in zip(biases, ((0.25, 0.75), (0.5, 0.9)), strict=True):
        bias.data = torch.tensor(shares).logit()
    x1, x2 = torch.tensor(2.0).view(1, 1, 1, 1), torch.tensor(10.0).view(1, 1, 1, 1)
    first, second = layer(x1, x2)
    assert first.item() == pytest.approx(2 + 0.5 * (0.75 + 0.9) * 10)
    assert second.item() == pytest.approx(10 + 0.5 * (0.25 + 0.5) * 2)


def test_cross_attention_by_loops() -> None:
    """Each stream reads the other's context; every column of a context sums to 1."""
    layer: CrossAttention = drawn(CrossAttention(4, 2))
    u = normal(1, 5, 4), normal(1, 5, 4, seed=1)
    expected = [torch.empty(1, 5, 4) for _ in u]
    for own, (other, kv) in enumerate(((u[1], layer.kv2), (u[0], layer.kv1))):
        k, v = kv(other)[0].chunk(2, -1)
        for head in range(2):
            part = slice(2 * head, 2 * head + 2)
            context = (k[:, part].T @ v[:, part] / math.sqrt(2)).exp()
            expected[own][0, :, part] = u[own][0, :, part] @ (context / context.sum(0))
    torch.testing.assert_close(layer(*u), tuple(expected))


@pytest.mark.parametrize(("eps", "evaluated"), [(None, 1e-3), (1e-5, 1e-5)])
def test_decoder_eps_in_evaluation(eps: float | None, evaluated: float) -> None:
    """A constant map c, statistics mean 0 and variance v: c / sqrt(v + eps)."""
    decoder = nano("cmx", decoder_norm_eps_eval=eps).decode_head
    norm = decoder.linear_fuse[1]
    x, variance = torch.full((1, 16, 2, 2), 3.0), 1e-3
    norm.running_var.fill_(variance)
    for mode, expected in ((False, evaluated), (True, 1e-3), (False, evaluated)):
        assert decoder.train(mode).linear_fuse[1].eps == expected
    torch.testing.assert_close(norm(x), torch.full_like(x, 3 / math.sqrt(variance + evaluated)))


# ---- stochastic depth ----------------------------------------------------------------------------


def test_drop_rates() -> None:
    ramp = drop_rates((3, 4, 6, 3), 0.1, "ramp")
    expected = torch.tensor([0.1 * i / 15 for i in range(16)])
    torch.testing.assert_close(ramp, expected.expand(2, 16))
    released = drop_rates((3, 4, 6, 3), 0.1, "released")
    torch.testing.assert_close(released[0, 3:7], torch.full((4,), 0.02))
    torch.testing.assert_close(released[1, 3:7], torch.full((4,), 0.4 / 15))
    assert torch.equal(released[:, :3], ramp[:, :3])
    assert torch.equal(released[:, 7:], ramp[:, 7:])


RAMP = ([1.0], [0.8, 0.6], [0.4], [0.2])


@pytest.mark.parametrize(
    ("name", "changes", "keeps"),
    [
        (
            "cmx",
            {"drop_path_stage2": "released", "decoder_dropout": 0.3},
            {
                "block": ([1.0], [0.8, 0.8], [0.4], [0.2]),
                "extra_block": ([1.0], [0.6, 0.6], [0.4], [0.2]),
            },
        ),
        ("cmnext", {"decoder_dropout": 0.3}, {"block": RAMP, "extra_block": RAMP}),
        ("mask2former", {"depths": (1, 2, 1, 1)}, dict.fromkeys(("RGB", "THR"), RAMP)),
    ],
)
def test_rates_reach_the_blocks_of_each_stream(
    name: str, changes: dict[str, Any], keeps: dict[str, tuple[list[float], ...]]
) -> None:
    """Five blocks at 0.8: keep 1, .8, .6, .4, .2; released stage 2 keeps .8 of RGB, .6 of thermal.

    The factor of a residual is 0 or 1 / keep; samples, residuals and streams have their own draws.
    """
    net = nano(name, drop_path_rate=0.8, **changes).train()
    if "decoder_dropout" in changes:
        assert net.decode_head.dropout == 0.3
    seen: dict[str, Tensor] = {}
    for path, module in net.backbone.named_modules():
        if hasattr(module, "norm1") and hasattr(module, "mlp"):
            module.register_forward_pre_hook(lambda _m, args, n=path: seen.update({n: args[1]}))
    net(*images(400, 32, 32), generator=generator())
    path = "{}{}.{}" if name != "mask2former" else "{}_branch.layers.{}.blocks.{}"
    for prefix, stages in keeps.items():
        for stage, blocks in enumerate(stages, int(name != "mask2former")):
            for number, keep in enumerate(blocks):
                factors = seen[path.format(prefix, stage, number)]
                assert factors.shape == (2, 400, 1, 1, 1)
                kept = factors > 0
                torch.testing.assert_close(factors[kept], torch.full((int(kept.sum()),), 1 / keep))
                assert abs(float(kept.float().mean()) - keep) < 0.06
    first, second = (seen[path.format(prefix, 3, 0)] for prefix in keeps)
    assert not torch.equal(first, second)
    assert not torch.equal(first[0], first[1])


# ---- thermal blocks of CMNeXt --------------------------------------------------------------------


@pytest.mark.parametrize("window", [1, 3, 7, 11])
@pytest.mark.parametrize("size", [(2, 3), (5, 4), (9, 14)])
def test_means_count_positions_inside_the_map_alone(window: int, size: tuple[int, int]) -> None:
    x, reach = normal(2, 3, *size), window // 2
    found = window_mean(x, window)
    for row in range(size[0]):
        for column in range(size[1]):
            rows = slice(max(row - reach, 0), row + reach + 1)
            inside = x[:, :, rows, max(column - reach, 0) : column + reach + 1]
            torch.testing.assert_close(
                found[:, :, row, column], inside.mean((2, 3)), rtol=1e-5, atol=1e-6
            )


def test_gate_multiplies_its_input_and_adds_it() -> None:
    """With weights that leave the map as it is: x sigmoid(x + means of x) + x."""
    gate = PoolingGate(3, (3, 7))
    for name, value in gate.named_parameters():
        value.data = torch.eye(3)[..., None, None] if name == "conv4.weight" else 0 * value.data
    gate.conv0.weight.data[:, 0, 3, 3] = 1
    x = normal(2, 3, 6, 5)
    mixed = x + window_mean(x, 3) + window_mean(x, 7)
    torch.testing.assert_close(gate(x), x * mixed.sigmoid() + x)


def test_thermal_block_by_its_equations() -> None:
    """y = x + l1 gate(norm(x)); a convolution of 3 channel means weighs y; + l2 ffn(norm(y))."""
    layer, x = PpxBlock(6, 12, windows=(3, 7, 11), layer_scale=0.3).eval(), normal(3, 6, 5, 4)
    randomise(layer)
    first, second = (s.view(-1, 1, 1) for s in (layer.layer_scale_1, layer.layer_scale_2))
    keep = torch.tensor([[1.0, 0, 0], [1, 0, 2]]).view(2, 3, 1, 1, 1)
    found = layer(x.permute(0, 2, 3, 1), keep).permute(0, 3, 1, 2)
    y = x + keep[0] * first * layer.attn(layer.norm1(x))
    means = F.pad(y.mean((2, 3)), (1, 1))
    kernel = layer.c_nets[0].weight.flatten()
    total = sum(kernel[step] * means[:, step : step + 6] for step in range(3))
    weighted = y / (1 + (-total).exp())[..., None, None]
    expected = weighted + keep[1] * second * layer.mlp(layer.norm2(y))
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)
