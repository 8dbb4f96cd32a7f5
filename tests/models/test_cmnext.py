"""CMNeXt: its thermal blocks by second computations, starting weights, where maps go."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch
from torch import Tensor, nn

from rgbt.checks import InputError
from rgbt.models.cmnext import CMNeXt
from rgbt.models.cmnext import ConvFfn, PoolingGate, PpxBlock, window_mean
from rgbt.models.cmx.mit import MitBlock
from tests.models import plain
from tests.models.golden import network
from tests.models.plain import generator as seeded
from tests.models.plain import images, normal

nano = partial(plain.nano, "cmnext")


def mean_of_window(x: Tensor, row: int, column: int, reach: int) -> Tensor:
    """Of one channel, the positions inside the map alone."""
    rows = slice(max(row - reach, 0), row + reach + 1)
    return x[rows, max(column - reach, 0) : column + reach + 1].mean()


@pytest.mark.parametrize("window", [1, 3, 7, 11])
@pytest.mark.parametrize("size", [(2, 3), (5, 4), (9, 14)])
def test_means_count_positions_inside_the_map_alone(window: int, size: tuple[int, int]) -> None:
    x = normal(2, 3, *size)
    found = window_mean(x, window)
    expected = torch.stack(
        [
            torch.stack([mean_of_window(each, r, c, window // 2) for c in range(size[1])])
            for each in x.flatten(0, 1)
            for r in range(size[0])
        ]
    ).view(x.shape)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


def test_gate_multiplies_its_input_and_adds_it() -> None:
    """With weights that leave the map as it is: x sigmoid(x + means of x) + x."""
    gate = PoolingGate(3, (3, 7))
    nn.init.zeros_(gate.conv0.weight)
    nn.init.zeros_(gate.conv0.bias)  # type: ignore[arg-type]
    gate.conv0.weight.data[:, 0, 3, 3] = 1
    gate.conv4.weight.data = torch.eye(3)[..., None, None]
    nn.init.zeros_(gate.conv4.bias)  # type: ignore[arg-type]
    x = normal(2, 3, 6, 5)
    mixed = x + window_mean(x, 3) + window_mean(x, 7)
    torch.testing.assert_close(gate(x), x * mixed.sigmoid() + x)


def randomised(module: nn.Module) -> nn.Module:
    plain.randomise(module)
    return module.eval()


def block(layer_scale: float = 0.3) -> PpxBlock:
    made = randomised(PpxBlock(6, 12, windows=(3, 7, 11), layer_scale=layer_scale))
    assert isinstance(made, PpxBlock)
    for scale in (made.layer_scale_1, made.layer_scale_2):
        scale.data.uniform_(0.2, 0.5, generator=seeded(3))
    return made


def test_block_by_its_equations() -> None:
    """y = x + l1 gate(norm(x)); a convolution of 3 channel means weighs y; + l2 ffn(norm(y))."""
    layer, x = block(), normal(2, 6, 5, 4)
    y = x + layer.layer_scale_1.view(-1, 1, 1) * layer.attn(layer.norm1(x))
    means, kernel = y.mean((2, 3)), layer.c_nets[0].weight.flatten()
    weighted = torch.empty_like(y)
    for n in range(2):
        for channel in range(6):
            total = torch.zeros(())
            for step in (-1, 0, 1):
                if 0 <= channel + step < 6:
                    total = total + kernel[step + 1] * means[n, channel + step]
            weighted[n, channel] = y[n, channel] / (1 + (-total).exp())
    expected = weighted + layer.layer_scale_2.view(-1, 1, 1) * layer.mlp(layer.norm2(y))
    found = layer(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


def test_feed_forward_is_exact_gelu_between_convolutions() -> None:
    layer = randomised(ConvFfn(3, 5))
    assert isinstance(layer, ConvFfn)
    x = normal(1, 3, 4, 6)
    wide = layer.dwconv(layer.fc1(x))
    gelu = 0.5 * wide * (1 + torch.erf(wide / math.sqrt(2)))
    torch.testing.assert_close(layer(x), layer.fc2(gelu))


def test_dropped_residuals_leave_the_weighted_map() -> None:
    layer, x = block(), normal(3, 4, 5, 6)
    keep = torch.tensor([[0.0, 1.0, 0.0], [0.0, 1.0, 2.0]]).view(2, 3, 1, 1, 1)
    found = layer(x, keep)
    weights = layer.c_nets(x.mean((1, 2))[:, None]).view(3, 1, 1, 6)
    torch.testing.assert_close(found[0], (weights * x)[0])
    torch.testing.assert_close(found[1], layer(x)[1])
    third = x[2:].permute(0, 3, 1, 2)
    residual = layer.layer_scale_2.view(-1, 1, 1) * layer.mlp(layer.norm2(third))
    expected = (weights * x)[2:] + 2 * residual.permute(0, 2, 3, 1)
    torch.testing.assert_close(found[2:], expected)


def test_rates_reach_the_blocks_of_both_streams() -> None:
    """Five blocks at 0.8: keep 1, .8, .6, .4, .2 in either stream, drawn apart."""
    count = 300
    net = nano(drop_path_rate=0.8).train()
    seen: dict[str, Tensor] = {}
    for name, module in net.backbone.named_modules():
        if isinstance(module, (MitBlock, PpxBlock)):
            module.register_forward_pre_hook(lambda _m, args, n=name: seen.update({n: args[1]}))
    net(*images(count, 29, 29), generator=seeded(0))
    order = ("block1.0", "block2.0", "block2.1", "block3.0", "block4.0")
    for prefix in ("", "extra_"):
        for name, keep in zip(order, (1.0, 0.8, 0.6, 0.4, 0.2), strict=True):
            factors = seen[f"{prefix}{name}"]
            kept = factors > 0
            torch.testing.assert_close(factors[kept], torch.full((int(kept.sum()),), 1 / keep))
            assert abs(float(kept.float().mean()) - keep) < 0.07
    assert not torch.equal(seen["block3.0"], seen["extra_block3.0"])


def test_eps_of_every_normalisation() -> None:
    """The thermal stream's layer normalisations have 1e-6, everything else 1e-5."""
    kinds = (nn.LayerNorm, nn.BatchNorm2d)
    for name, module in nano().named_modules():
        if isinstance(module, kinds):
            is_thermal_map = "extra_" in name and isinstance(module, nn.LayerNorm)
            assert module.eps == (1e-6 if is_thermal_map else 1e-5), name


def test_starting_weights() -> None:
    """Groups are not divided out, also between the streams and in the decoder."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        net: CMNeXt = network("cmnext_b0")
    found = {name: p.detach() for name, p in net.named_parameters()}
    spread = {name: float(p.std()) for name, p in found.items() if p.dim() > 1}
    expected = {
        "backbone.block4.0.mlp.fc1.weight": 0.02,
        "backbone.FRMs.3.channel_weights.mlp.0.weight": 0.02,
        "decode_head.linear_c4.proj.weight": 0.02,
        "backbone.extra_patch_embed1.proj.weight": math.sqrt(2 / (49 * 32)),
        "backbone.block3.0.mlp.dwconv.dwconv.weight": math.sqrt(2 / (9 * 640)),
        "backbone.extra_block4.0.attn.conv0.weight": math.sqrt(2 / (49 * 256)),
        "backbone.extra_block4.0.attn.conv4.weight": math.sqrt(2 / 256),
        "backbone.extra_block2.0.mlp.fc1.weight": math.sqrt(2 / 512),
        "backbone.extra_block2.0.mlp.dwconv.dwconv.weight": math.sqrt(2 / (9 * 512)),
        "backbone.FFMs.3.channel_emb.channel_embed.1.weight": math.sqrt(2 / (9 * 256)),
        "decode_head.linear_fuse.0.weight": math.sqrt(2 / 256),
        "decode_head.linear_pred.weight": math.sqrt(2 / 9),
    }
    assert {name: spread[name] for name in expected} == pytest.approx(expected, rel=0.05)
    for name, p in found.items():
        if p.dim() == 1:
            scale = 0.01 if "layer_scale" in name else 1.0
            assert torch.equal(p, torch.full_like(p, 0.0 if name.endswith("bias") else scale)), name
    # The convolution of the channel weights keeps torch's uniform start, at most 1 / sqrt(3).
    kernels = torch.cat([p.flatten() for name, p in found.items() if "c_nets" in name])
    assert 0.4 < float(kernels.abs().max()) <= 1 / math.sqrt(3)


def test_stages_continue_with_rectified_maps() -> None:
    net = nano().eval()
    rectified, fed = [], []
    for rectify in net.backbone.FRMs:
        rectify.register_forward_hook(lambda _m, _i, out: rectified.extend(out))
    for stage in (2, 3, 4):
        for prefix in ("", "extra_"):
            embed = net.backbone.get_submodule(f"{prefix}patch_embed{stage}")
            embed.register_forward_pre_hook(lambda _m, args: fed.append(args[0]))
    net(*images(1))
    assert len(fed) == 6
    assert all(a is b for a, b in zip(rectified, fed))


def test_images_that_are_too_small_raise() -> None:
    with pytest.raises(InputError, match=r"29 pixels.*27 x 64"):
        nano().eval()(*images(1, 27, 64))


def test_bfloat16_autocast_trains() -> None:
    net = nano(drop_path_rate=0.1, decoder_dropout=0.1).train()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        logits = net(*images(2), generator=seeded(0)).logits
    assert logits.dtype == torch.float32
    logits.square().mean().backward()
    assert all(p.grad.isfinite().all() for p in net.parameters())
