"""The vision transformers of DINOv2 and DINOv3 by a second computation; entries of their files."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.models.dinov2.encoder import Encoder, LoraProjection, resized_positions
from tests.models.golden import network
from tests.models.plain import count, normal, randomise

ROTARY: dict[str, Any] = {
    **{"position_grid": None, "position_resize": None, "rope_base": 100.0},
    **{"key_bias": False, "embed_dim": 24},
}


def encoder(**changes: Any) -> Encoder:
    """In the form of DINOv2."""
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


# ---- a second computation from the state dict ----------------------------------------------------


def turned(x: Tensor, hw: tuple[int, int], first: int, periods: Tensor) -> Tensor:
    """Queries or keys (T, D) of one head, rotated behind the first tokens, as complex numbers."""
    (h, w), channels = hw, x.shape[1]
    out = x.clone()
    for number in range(h * w):
        centre = (2 * (number // w + 0.5) / h - 1, 2 * (number % w + 0.5) / w - 1)
        for pair in range(channels // 2):
            axis, step = divmod(pair, channels // 4)
            angle = 2 * math.pi * centre[axis] / float(periods[step])
            token = x[first + number]
            value = complex(token[pair], token[pair + channels // 2])
            value *= complex(math.cos(angle), math.sin(angle))
            out[first + number, pair] = value.real
            out[first + number, pair + channels // 2] = value.imag
    return out


def second(
    state: dict[str, Tensor], image: Tensor, depth: int, positions: Tensor | None, eps: float
) -> Tensor:
    """Normalised patch tokens (h w, d) of one image after block `depth`, three heads.

    `positions` (1, 1 + h w, d); None: they are rotary, and keys have no bias.
    """

    def linear(name: str, x: Tensor) -> Tensor:
        return x @ state[f"{name}.weight"].flatten(1).T + state[f"{name}.bias"]

    def normed(name: str, x: Tensor) -> Tensor:
        deviation = (x.var(-1, unbiased=False, keepdim=True) + eps).sqrt()
        x = (x - x.mean(-1, keepdim=True)) / deviation
        return x * state[f"{name}.weight"] + state[f"{name}.bias"]

    patch = state["patch_embed.proj.weight"].shape[-1]
    cut = image.unfold(1, patch, patch).unfold(2, patch, patch)  # 3, h, w, p, p
    hw = cut.shape[1], cut.shape[2]
    x = linear("patch_embed.proj", cut.permute(1, 2, 0, 3, 4).reshape(hw[0] * hw[1], -1))
    x = torch.cat([state["cls_token"][0], x]) + (0 if positions is None else positions[0])
    registers = state.get("register_tokens", torch.zeros(1, 0, x.shape[1]))[0]
    x, first = torch.cat([x[:1], registers, x[1:]]), 1 + len(registers)
    for block in range(depth):
        at = f"blocks.{block}"
        qkv = linear(f"{at}.attn.qkv", normed(f"{at}.norm1", x))
        q, k, v = qkv.chunk(3, 1)
        if positions is None:
            k = k - state[f"{at}.attn.qkv.bias"].chunk(3)[1]
        parts = []
        for head in torch.arange(x.shape[1]).chunk(3):
            query, key = q[:, head], k[:, head]
            if positions is None:
                periods = state["rope_embed.periods"]
                query, key = (turned(each, hw, first, periods) for each in (query, key))
            parts.append((query @ key.T / len(head) ** 0.5).softmax(1) @ v[:, head])
        x = x + state[f"{at}.ls1.gamma"] * linear(f"{at}.attn.proj", torch.cat(parts, 1))
        y = normed(f"{at}.norm2", x)
        if f"{at}.mlp.w1.weight" in state:
            gate = linear(f"{at}.mlp.w1", y)
            gated = gate / (1 + torch.exp(-gate)) * linear(f"{at}.mlp.w2", y)
            y = linear(f"{at}.mlp.w3", gated)
        else:
            hidden = linear(f"{at}.mlp.fc1", y)
            y = linear(f"{at}.mlp.fc2", hidden * 0.5 * (1 + torch.erf(hidden / 2**0.5)))
        x = x + state[f"{at}.ls2.gamma"] * y
    return normed("norm", x)[first:]


@pytest.mark.parametrize(
    ("changes", "hw"),
    [
        ({"num_registers": 0}, (5, 5)),
        ({"norm_eps": 0.1}, (5, 5)),
        ({"position_resize": "factor"}, (3, 7)),
        ({"position_resize": "size"}, (3, 7)),
        *((ROTARY | {"mlp": mlp, "norm_eps": 0.1}, (2, 4)) for mlp in ("gelu", "swiglu")),
    ],
)
@torch.no_grad()
def test_tokens_equal_a_second_computation(changes: dict[str, Any], hw: tuple[int, int]) -> None:
    net, image = encoder(**changes), normal(2, 3, 4 * hw[0], 4 * hw[1])
    positions = None
    if "rope_base" not in changes:
        positions = bicubic(net.pos_embed, *hw, antialiased=net.position_resize == "size")
    for depth, found in zip((2, 3), net(image, layers=(2, 3)), strict=True):
        assert found.shape == (2, net.norm.weight.numel(), *hw)
        for number, own in enumerate(found.flatten(2).transpose(1, 2)):
            eps = changes.get("norm_eps", 1e-6)
            expected = second(net.state_dict(), image[number], depth, positions, eps)
            torch.testing.assert_close(own, expected, rtol=1e-4, atol=1e-5)


# ---- positions -----------------------------------------------------------------------------------


def cubic(t: float, a: float) -> float:
    """Keys' cubic kernel; PyTorch has a = -0.75, and -0.5 with antialiasing."""
    t = abs(t)
    if t < 1:
        return (a + 2) * t**3 - (a + 3) * t**2 + 1
    return a * (t**3 - 5 * t**2 + 8 * t - 4) if t < 2 else 0.0


def axis(size: int, grid: int, *, antialiased: bool) -> Tensor:
    """(size, grid): how much each old position counts for a new one."""
    if size == grid:
        return torch.eye(size)
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


@pytest.mark.parametrize("hw", [(3, 7), (8, 10)])
@pytest.mark.parametrize("form", ["factor", "size"])
def test_positions_are_resized_in_both_published_forms(hw: tuple[int, int], form: Any) -> None:
    positions = normal(1, 26, 4)
    assert resized_positions(positions, (5, 5), form) is positions
    found = resized_positions(positions, hw, form)
    expected = bicubic(positions, *hw, antialiased=form == "size")
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


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
def test_updates_equal_a_changed_projection(parts: Any) -> None:
    """W + alpha / rank B A in the rows of q, k or v; the same bits while B is 0."""
    net, image = encoder(), normal(1, 3, 20, 20)
    lora = nn.ModuleList(LoraProjection(12, rank=2, alpha=3.0, parts=parts) for _ in range(3))
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


# ---- initial weights -----------------------------------------------------------------------------


def test_a_is_drawn_as_in_the_release_of_lora() -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        lora = LoraProjection(300, rank=40, alpha=1.0, parts=("q",))
    assert float(lora.down["q"].detach().abs().max()) <= 300**-0.5
    assert float(lora.down["q"].detach().std()) == pytest.approx((3 * 300) ** -0.5, rel=0.02)
    assert not lora.up["q"].any()


@pytest.mark.parametrize(("yaml", "deviation"), [("dinov2_tiny", 1e-6), ("dinov3_tiny", 0.02)])
def test_initial_weights_are_drawn_as_in_the_release(yaml: str, deviation: float) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        net = network(yaml).backbone.encoder
    tokens = torch.cat([net.cls_token.detach(), net.register_tokens.detach()], 1)
    assert float(tokens.std()) == pytest.approx(deviation, rel=0.15)
    assert not net.mask_token.any()
    assert all(bool((block.ls1.gamma == 1).all()) for block in net.blocks)
    drawn = [net.blocks[0].attn.qkv.weight]
    if yaml == "dinov2_tiny":
        drawn.append(net.pos_embed)
    for weight in drawn:
        assert float(weight.detach().std()) == pytest.approx(0.02, rel=0.1)
    assert not net.blocks[0].attn.qkv.bias.any()
