"""The vision transformer of DINOv2: names and sizes of its files, and a second computation."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.checks import InputError
from rgbt.models.dinov2.encoder import Encoder, LoraProjection, resized_positions

from tests.models.golden import network
from tests.models.plain import count, normal, randomise


def encoder(**changes: Any) -> Encoder:
    sizes = {"patch": 4, "embed_dim": 12, "depth": 3, "num_heads": 3, "mlp_ratio": 4.0}
    positions = {"num_registers": 2, "position_grid": 5, "position_resize": "size"}
    form = {"rope_base": None, "norm_eps": 1e-6, "key_bias": True, "mlp": "gelu"}
    net = Encoder(**{**sizes, **positions, **form, **changes}).eval()
    randomise(net)
    return net


def published_shapes(width: int, registers: int) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a published file of S or B."""
    d = width
    shapes: dict[str, tuple[int, ...]] = {
        **{"cls_token": (1, 1, d), "pos_embed": (1, 1 + 37 * 37, d), "mask_token": (1, d)},
        **({"register_tokens": (1, registers, d)} if registers else {}),
        **{"patch_embed.proj.weight": (d, 3, 14, 14), "patch_embed.proj.bias": (d,)},
        **{"norm.weight": (d,), "norm.bias": (d,)},
    }
    for block in range(12):
        linear = {"attn.qkv": (3 * d, d), "attn.proj": (d, d), "mlp.fc1": (4 * d, d)}
        for name, (rows, columns) in (linear | {"mlp.fc2": (d, 4 * d)}).items():
            shapes[f"blocks.{block}.{name}.weight"] = (rows, columns)
            shapes[f"blocks.{block}.{name}.bias"] = (rows,)
        vectors = ("norm1.weight", "norm1.bias", "norm2.weight", "norm2.bias")
        shapes |= {f"blocks.{block}.{n}": (d,) for n in (*vectors, "ls1.gamma", "ls2.gamma")}
    return shapes


@pytest.mark.parametrize(
    ("yaml", "width", "registers", "entries", "values"),
    [
        ("dinov2_vits14", 384, 0, 175, 22_056_576),
        ("dinov2_vits14_reg", 384, 4, 176, 22_058_112),
        ("dinov2_vitb14", 768, 0, 175, 86_580_480),
        ("dinov2_vitb14_reg", 768, 4, 176, 86_583_552),
    ],
)
def test_the_encoder_has_the_entries_of_the_published_file(
    yaml: str, width: int, registers: int, entries: int, values: int
) -> None:
    with torch.device("meta"):
        net = network(yaml).backbone.encoder
    state = {name: tuple(value.shape) for name, value in net.state_dict().items()}
    assert state == published_shapes(width, registers)
    assert (len(state), count(net)) == (entries, values)


def test_the_tiny_network_stays_tiny() -> None:
    with torch.device("meta"):
        assert count(network("dinov2_tiny")) < 1e6


# ---- a second computation from the state dict, with torch's attention ----------------------------


def second(
    state: dict[str, Tensor], image: Tensor, layer: int, positions: Tensor, heads: int = 3
) -> Tensor:
    """Normalised patch tokens after block `layer`, (N, h w, d); `positions` (1, 1 + h w, d)."""
    patch, width = state["patch_embed.proj.weight"].shape[-1], state["cls_token"].shape[-1]
    cut = image.unfold(2, patch, patch).unfold(3, patch, patch)  # N, 3, h, w, p, p
    cut = cut.permute(0, 2, 3, 1, 4, 5).flatten(3).flatten(1, 2)
    weight = state["patch_embed.proj.weight"].flatten(1)
    x = cut @ weight.T + state["patch_embed.proj.bias"]
    x = torch.cat([state["cls_token"].expand(len(x), -1, -1), x], 1) + positions
    registers = state.get("register_tokens", torch.zeros(1, 0, width))
    x = torch.cat([x[:, :1], registers.expand(len(x), -1, -1), x[:, 1:]], 1)
    for block in range(layer):
        own = {
            name.removeprefix(f"blocks.{block}."): value
            for name, value in state.items()
            if name.startswith(f"blocks.{block}.")
        }
        attention = nn.MultiheadAttention(width, heads, batch_first=True)
        attention.load_state_dict(
            {
                "in_proj_weight": own["attn.qkv.weight"],
                "in_proj_bias": own["attn.qkv.bias"],
                "out_proj.weight": own["attn.proj.weight"],
                "out_proj.bias": own["attn.proj.bias"],
            }
        )
        y = normed(x, own["norm1.weight"], own["norm1.bias"])
        x = x + own["ls1.gamma"] * attention(y, y, y, need_weights=True)[0]
        y = normed(x, own["norm2.weight"], own["norm2.bias"])
        y = y @ own["mlp.fc1.weight"].T + own["mlp.fc1.bias"]
        y = y * 0.5 * (1 + torch.erf(y / 2**0.5))
        x = x + own["ls2.gamma"] * (y @ own["mlp.fc2.weight"].T + own["mlp.fc2.bias"])
    x = normed(x, state["norm.weight"], state["norm.bias"])
    return x[:, 1 + registers.shape[1] :]


def normed(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    variance = x.var(-1, unbiased=False, keepdim=True)
    return (x - x.mean(-1, keepdim=True)) / (variance + 1e-6).sqrt() * weight + bias


@pytest.mark.parametrize("registers", [0, 2])
@torch.no_grad()
def test_tokens_equal_a_second_computation(registers: int) -> None:
    net = encoder(num_registers=registers)
    image = normal(2, 3, 20, 20)
    maps = net(image, layers=(2, 3))
    for layer, found in zip((2, 3), maps, strict=True):
        expected = second(net.state_dict(), image, layer, net.pos_embed)
        assert found.shape == (2, 12, 5, 5)
        torch.testing.assert_close(found.flatten(2).transpose(1, 2), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("position_resize", ["factor", "size"])
@torch.no_grad()
def test_tokens_of_another_size_equal_a_second_computation(position_resize: str) -> None:
    net = encoder(position_resize=position_resize)
    image = normal(1, 3, 12, 28)
    positions = bicubic(net.pos_embed, 3, 7, antialiased=position_resize == "size")
    expected = second(net.state_dict(), image, 3, positions)
    (found,) = net(image, layers=(3,))
    torch.testing.assert_close(found.flatten(2).transpose(1, 2), expected, rtol=1e-4, atol=1e-5)


# ---- positions -----------------------------------------------------------------------------------


def cubic(t: float, a: float) -> float:
    """Keys' cubic kernel; PyTorch has a = -0.75, and -0.5 with antialiasing."""
    t = abs(t)
    if t < 1:
        return (a + 2) * t**3 - (a + 3) * t**2 + 1
    return a * (t**3 - 5 * t**2 + 8 * t - 4) if t < 2 else 0.0


def axis(size: int, grid: int, *, antialiased: bool) -> Tensor:
    """(size, grid): how much each old position counts for a new one."""
    weights = torch.zeros(size, grid)
    # The published files without registers: a factor of (size + 0.1) / grid.
    step = grid / size if antialiased else grid / (size + 0.1)
    for new in range(size):
        centre = (new + 0.5) * step
        if antialiased:
            width = max(step, 1.0)
            old = torch.arange(grid)
            row = torch.tensor([cubic((float(o) + 0.5 - centre) / width, -0.5) for o in old])
            weights[new] = row / row.sum()
            continue
        first = int(torch.floor(torch.tensor(centre - 0.5)))
        for old in range(first - 1, first + 3):
            weights[new, min(max(old, 0), grid - 1)] += cubic(centre - 0.5 - old, -0.75)
    return weights


def bicubic(positions: Tensor, h: int, w: int, *, antialiased: bool) -> Tensor:
    grid = positions[0, 1:].unflatten(0, (5, 5))
    rows, columns = (axis(side, 5, antialiased=antialiased) for side in (h, w))
    patches = torch.einsum("yo,xp,opd->yxd", rows, columns, grid)
    return torch.cat([positions[:, :1], patches.flatten(0, 1)[None]], 1)


@pytest.mark.parametrize("hw", [(3, 7), (8, 10), (5, 6)])
@pytest.mark.parametrize("form", ["factor", "size"])
def test_positions_are_resized_in_both_published_forms(hw: tuple[int, int], form: str) -> None:
    positions = normal(1, 26, 4)
    found = resized_positions(positions, hw, form)  # type: ignore[arg-type]
    expected = bicubic(positions, *hw, antialiased=form == "size")
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_positions_of_the_own_size_are_unchanged() -> None:
    positions = normal(1, 26, 4)
    assert resized_positions(positions, (5, 5), "size") is positions
    assert resized_positions(positions, (5, 5), "factor") is positions


# ---- hidden patches, thermal vector, updates -----------------------------------------------------


@torch.no_grad()
def test_hidden_patches_do_not_count_and_show_the_mask_token() -> None:
    net = encoder()
    hidden = torch.zeros(1, 5, 5, dtype=torch.bool)
    hidden[0, 1, 3] = True
    first = normal(1, 3, 20, 20)
    other = first.clone()
    other[..., 4:8, 12:16] = 5.0
    assert torch.equal(net(first, hidden, layers=(3,))[0], net(other, hidden, layers=(3,))[0])
    plain = net(first, hidden, layers=(3,))[0]
    net.mask_token.add_(1.0)
    assert not torch.equal(net(first, hidden, layers=(3,))[0], plain)
    assert torch.equal(net(first, layers=(3,))[0], net(first, hidden & False, layers=(3,))[0])


@torch.no_grad()
def test_an_added_vector_equals_another_bias_of_the_patches() -> None:
    net, image, added = encoder(), normal(1, 3, 20, 20), normal(12, seed=3)
    (found,) = net(image, layers=(3,), added=added)
    net.patch_embed["proj"].bias.add_(added)
    torch.testing.assert_close(found, net(image, layers=(3,))[0])


@pytest.mark.parametrize("parts", [("q", "v"), ("q", "k", "v"), ("k",)])
@torch.no_grad()
def test_updates_equal_a_changed_projection(parts: tuple[str, ...]) -> None:
    """W + alpha / rank B A in the rows of q, k or v; the same bits while B is 0."""
    net, image = encoder(), normal(1, 3, 20, 20)
    lora = LoraBlocks(3, 12, rank=2, alpha=3.0, parts=parts)  # type: ignore[arg-type]
    assert torch.equal(net(image, layers=(3,), lora=lora)[0], net(image, layers=(3,))[0])
    for number, update in enumerate(lora):
        for part in parts:
            update.up[part].copy_(normal(12, 2, seed=number))
            start = 12 * "qkv".index(part)
            change = 3.0 / 2 * update.up[part] @ update.down[part]
            net.blocks[number].attn.qkv.weight[start : start + 12] += change
    expected = net(image, layers=(3,))[0]
    net.load_state_dict(encoder().state_dict())
    found = net(image, layers=(3,), lora=lora)[0]
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_a_is_drawn_as_in_the_release_of_lora() -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        lora = LoraBlocks(1, 300, rank=40, alpha=1.0, parts=("q",))[0]
    assert float(lora.down["q"].detach().abs().max()) <= 300**-0.5
    assert float(lora.down["q"].detach().std()) == pytest.approx((3 * 300) ** -0.5, rel=0.02)
    assert not lora.up["q"].any()


def test_heads_that_do_not_divide_the_width_are_named() -> None:
    with pytest.raises(InputError, match=r"model\.num_heads = 5 must divide"):
        encoder(num_heads=5)


def test_initial_positions_are_drawn_and_the_mask_token_is_0() -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        net = network("dinov2_tiny").backbone.encoder
    assert float(net.pos_embed.detach().std()) == pytest.approx(0.02, rel=0.1)
    assert not net.mask_token.any()
    assert all(bool((block.ls1.gamma == 1).all()) for block in net.blocks)
    linear = net.blocks[0].attn.qkv
    assert float(linear.weight.detach().std()) == pytest.approx(0.02, rel=0.1)
    assert not linear.bias.any()
    assert 0 < float(net.cls_token.detach().abs().max()) < 1e-5
