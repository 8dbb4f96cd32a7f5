"""CMX: values by second computations, where maps go, random drops, starting weights."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.models.cmx.network import MlpDecoder
from rgbt.models.cmx.mit import MitAttention, MitBlock, MixFfn
from rgbt.models.cmx.model import CMX, drop_rates
from tests.models import plain
from tests.models.golden import network
from tests.models.plain import generator as seeded
from tests.models.plain import images, normal

nano = partial(plain.nano, "cmx")
B2, B4 = (3, 4, 6, 3), (3, 8, 27, 3)


def randomise(module: nn.Module, seed: int = 5) -> Any:
    g = seeded(seed)
    for parameter in module.parameters():
        nn.init.normal_(parameter, std=0.5, generator=g)
    return module


def test_rectified_maps_go_on_and_fused_maps_to_the_decoder() -> None:
    net = nano().eval()
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


def test_images_that_are_too_small_raise() -> None:
    """Stage 1 has maps of a quarter of the image and a kernel of 8: 29 pixels give 8 places."""
    with pytest.raises(InputError, match=r"29 pixels.*28 x 64"):
        nano().eval()(*images(1, 28, 64))
    assert nano(sr_ratios=[2, 1, 1, 1]).eval()(*images(1, 5, 5)).logits is not None


def test_eps_of_every_normalisation() -> None:
    """Blocks and stages have 1e-6, everything else torch's 1e-5 but the decoder."""
    fine = ("norm1", "norm2", "norm3", "norm4")
    for name, module in nano().named_modules():
        if isinstance(module, nn.BatchNorm2d):
            assert module.eps == (1e-3 if name.startswith("decode_head") else 1e-5), name
        if isinstance(module, nn.LayerNorm):
            inside = "block" in name or "extra_norm" in name or name.startswith("backbone.norm")
            expected = 1e-6 if inside and name.endswith(fine) else 1e-5
            assert module.eps == expected, name


@pytest.mark.parametrize("reduction", [1, 2])
def test_attention_by_loops(reduction: int) -> None:
    """Three heads of two channels; a map of 5 x 4 is attended to as 2 x 2 where it is reduced."""
    layer: MitAttention = randomise(MitAttention(6, 3, reduction))
    x = normal(2, 5, 4, 6)
    expected = torch.empty(2, 20, 6)
    for n in range(2):
        seen = x[n].flatten(0, 1)
        if reduction > 1:
            weight = layer.sr.weight
            patches = [x[n, 2 * r : 2 * r + 2, 2 * c : 2 * c + 2] for r in (0, 1) for c in (0, 1)]
            seen = torch.stack([torch.einsum("hwi,oihw->o", p, weight) for p in patches])
            seen = layer.norm(seen + layer.sr.bias)
        q, kv = layer.q(x[n].flatten(0, 1)), layer.kv(seen)
        for head in range(3):
            part = slice(2 * head, 2 * head + 2)
            k, v = kv[:, :6][:, part], kv[:, 6:][:, part]
            for token in range(20):
                scores = torch.stack([q[token, part] @ key for key in k]) / math.sqrt(2)
                shares = scores.exp() / scores.exp().sum()
                expected[n, token, part] = shares @ v
    expected = layer.proj(expected).view(2, 5, 4, 6)
    torch.testing.assert_close(layer(x), expected, rtol=1e-4, atol=1e-5)


def test_feed_forward_sees_its_neighbours_only() -> None:
    """Values by loops over places, zero outside the map; GELU by its definition."""
    layer: MixFfn = randomise(MixFfn(2, 3))
    x = normal(1, 3, 4, 2)
    wide = layer.fc1(x)[0]
    kernel = layer.dwconv.dwconv.weight[:, 0]
    for r in range(3):
        for c in range(4):
            total = layer.dwconv.dwconv.bias.clone()
            for y in range(max(r - 1, 0), min(r + 2, 3)):
                for z in range(max(c - 1, 0), min(c + 2, 4)):
                    total = total + wide[y, z] * kernel[:, y - r + 1, z - c + 1]
            gelu = 0.5 * total * (1 + torch.erf(total / math.sqrt(2)))
            torch.testing.assert_close(layer(x)[0, r, c], layer.fc2(gelu), rtol=1e-4, atol=1e-5)


IMAGE = (36, 50)


def decoder() -> tuple[MlpDecoder, list[Tensor]]:
    net = MlpDecoder((3, 4, 5, 6), 2, dim=7, dropout=0.0, norm_eps=(1e-3, 1e-3))
    sizes = ((9, 13), (5, 7), (3, 4), (2, 2))
    maps = [normal(2, *hw, 3 + i, seed=i).double() for i, hw in enumerate(sizes)]
    return randomise(net).double(), maps


def in_released_order(net: MlpDecoder, maps: list[Tensor]) -> Tensor:
    """Projected, enlarged, joined from the smallest to the largest, then convolved."""
    joined = []
    for number in (4, 3, 2, 1):
        small = net.get_submodule(f"linear_c{number}.proj")(maps[number - 1]).permute(0, 3, 1, 2)
        joined.append(F.interpolate(small, size=(9, 13), mode="bilinear", align_corners=False))
    scores = net.linear_pred(net.linear_fuse(torch.cat(joined, 1)))
    return F.interpolate(scores.float(), size=IMAGE, mode="bilinear", align_corners=False)


@pytest.mark.parametrize("training", [False, True])
def test_decoder_equals_the_released_order(training: bool) -> None:
    (ours, maps), (theirs, _) = decoder(), decoder()
    found = ours.train(training)(maps, IMAGE)
    expected = in_released_order(theirs.train(training), maps)
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)

    g = normal(*found.shape, seed=9).double()
    (found * g).sum().backward()
    (expected * g).sum().backward()
    for (name, mine), theirs_too in zip(ours.named_parameters(), theirs.parameters()):
        torch.testing.assert_close(mine.grad, theirs_too.grad, msg=name, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("eps", "evaluated"), [(None, 1e-3), (1e-5, 1e-5)])
def test_decoder_eps_in_evaluation(eps: float | None, evaluated: float) -> None:
    """A constant map c, statistics mean 0 and variance v: c / sqrt(v + eps)."""
    decoder = nano(decoder_norm_eps_eval=eps).decode_head
    norm = decoder.linear_fuse[1]
    x, variance = torch.full((1, 16, 2, 2), 3.0), 1e-3
    norm.running_var.fill_(variance)
    for mode, expected in ((False, evaluated), (True, 1e-3), (False, evaluated)):
        assert decoder.train(mode).linear_fuse[1].eps == expected
    found = norm(x)
    torch.testing.assert_close(found, torch.full_like(x, 3 / math.sqrt(variance + evaluated)))


def test_starting_weights() -> None:
    """Linear maps of the backbone 0.02, convolutions sqrt(2 / outputs reached), biases 0."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        net: CMX = network("cmx_b0")
    spread = {name: float(p.detach().std()) for name, p in net.named_parameters() if p.dim() > 1}
    expected = {
        "backbone.extra_block4.0.mlp.fc1.weight": 0.02,
        "backbone.FRMs.3.channel_weights.mlp.0.weight": 0.02,
        "backbone.FFMs.2.cross.cross_attn.kv1.weight": 0.02,
        "backbone.extra_patch_embed1.proj.weight": math.sqrt(2 / (49 * 32)),
        "backbone.block1.0.attn.sr.weight": math.sqrt(2 / (64 * 32)),
        "backbone.block3.0.mlp.dwconv.dwconv.weight": math.sqrt(2 / 9),
        "backbone.FFMs.3.channel_emb.residual.weight": math.sqrt(2 / 256),
        "decode_head.linear_fuse.0.weight": math.sqrt(2 / 2048),
        "decode_head.linear_pred.weight": math.sqrt(2 / 512),
        "decode_head.linear_c4.proj.weight": math.sqrt(1 / (3 * 256)),
    }
    assert {name: spread[name] for name in expected} == pytest.approx(expected, rel=0.05)
    for name, p in net.named_parameters():
        if name.startswith("backbone.") and p.dim() == 1:
            constant = torch.zeros_like(p) if name.endswith("bias") else torch.ones_like(p)
            assert torch.equal(p, constant), name
    assert net.decode_head.linear_fuse[0].bias.any()


def test_drop_rates() -> None:
    ramp = drop_rates(B2, 0.1, "ramp")
    expected = torch.tensor([0.1 * i / 15 for i in range(16)])
    torch.testing.assert_close(ramp, expected.expand(2, 16))

    released = drop_rates(B2, 0.1, "released")
    torch.testing.assert_close(released[0, 3:7], torch.full((4,), 0.02))
    torch.testing.assert_close(released[1, 3:7], torch.full((4,), 0.4 / 15))
    assert torch.equal(released[:, :3], ramp[:, :3])
    assert torch.equal(released[:, 7:], ramp[:, 7:])

    deep = drop_rates(B4, 0.1, "released")
    torch.testing.assert_close(deep[0, 3:11], torch.full((8,), 0.0075))
    torch.testing.assert_close(deep[1, 3:11], torch.full((8,), 0.01))


def test_rates_reach_the_blocks_of_each_stream() -> None:
    """Five blocks at 0.8: keep 1, .8, .6, .4, .2; released stage 2 keeps .8 of RGB, .6 of thermal.

    The factor of a residual is 0 or 1 / keep; samples, residuals and streams have their own draws.
    """
    count = 400
    net = nano(drop_path_rate=0.8, drop_path_stage2="released").train().backbone
    seen: dict[str, Tensor] = {}
    for name, module in net.named_modules():
        if isinstance(module, MitBlock):
            module.register_forward_pre_hook(lambda _m, args, n=name: seen.update({n: args[1]}))
    net(nano().inputs(*images(count, 29, 29)), seeded(0))
    keeps = {
        "block": ([1.0], [0.8, 0.8], [0.4], [0.2]),
        "extra_block": ([1.0], [0.6, 0.6], [0.4], [0.2]),
    }
    for prefix, stages in keeps.items():
        for stage, blocks in enumerate(stages, 1):
            for number, keep in enumerate(blocks):
                factors = seen[f"{prefix}{stage}.{number}"]
                assert factors.shape == (2, count, 1, 1, 1)
                kept = factors > 0
                torch.testing.assert_close(factors[kept], torch.full((int(kept.sum()),), 1 / keep))
                assert abs(float(kept.float().mean()) - keep) < 0.06
    assert not torch.equal(seen["block3.0"], seen["extra_block3.0"])
    assert not torch.equal(seen["block3.0"][0], seen["block3.0"][1])


def test_a_dropped_residual_leaves_the_sample_alone() -> None:
    block: MitBlock = randomise(MitBlock(4, 2, 1, 8, norm_eps=1e-6))
    x = normal(3, 2, 2, 4)
    keep = torch.tensor([[0.0, 1.0, 0.0], [0.0, 1.0, 2.0]]).view(2, 3, 1, 1, 1)
    out = block(x, keep)
    torch.testing.assert_close(out[0], x[0])
    torch.testing.assert_close(out[1], block(x)[1])
    torch.testing.assert_close(out[2:], x[2:] + 2 * block.mlp(block.norm2(x[2:])))


def test_decoder_drops_whole_channels() -> None:
    head = nano(decoder_dropout=0.5).decode_head.train()
    seen = []
    head.linear_pred.register_forward_pre_hook(lambda _m, args: seen.append(args[0]))
    maps = [normal(2, 8 // s, 8 // s, d) for s, d in ((1, 8), (2, 8), (4, 12), (8, 16))]
    wholes: list[Tensor] = []
    head.linear_fuse[2].register_forward_hook(lambda _m, _i, out: wholes.append(out))
    head(maps, (32, 32), seeded(0))
    (whole,) = wholes
    dropped = ~seen[0].flatten(2).any(-1) & whole.flatten(2).any(-1)
    assert 0 < int(dropped.sum()) < dropped.numel()
    expected = whole * 2 * ~dropped[..., None, None]
    torch.testing.assert_close(seen[0], expected)


def test_bfloat16_autocast_trains() -> None:
    net = nano(drop_path_rate=0.1, decoder_dropout=0.1).train()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        logits = net(*images(2), generator=seeded(0)).logits
    assert logits.dtype == torch.float32
    logits.square().mean().backward()
    assert all(p.grad.isfinite().all() for p in net.parameters())
