"""What every network must do, on networks of few channels; sizes of those in conf/model."""

from __future__ import annotations

import re
from typing import Any

import pytest
import torch
from torch import Tensor

from rgbt.types import VIEWS, MaskPair
from tests.models.golden import network
from tests.models.plain import NANO, cells, count, generator, images, nano, normal, randomise

MODIFIED = {
    "ceil_mode": False,
    "decoder": "modified_heatnet",
    "dropout": (0.3, 0.15),
    "align_corners": False,
}
LITERAL = {"ceil_mode": False, "decoder": "modified_thesis", "align_corners": False}
CASES: list[tuple[str, dict[str, Any]]] = [
    *((name, {}) for name in NANO if name != "critic"),
    *(("pspnet", {"modalities": m}) for m in ("early_fusion", "rgb", "thermal")),
    *(("semseg", changes) for changes in ({"modalities": "thermal"}, {"dropout": 0.5})),
    *(("deeplabv2", changes) for changes in (MODIFIED, LITERAL)),
    ("cmx", {"drop_path_rate": 0.5, "drop_path_stage2": "released"}),
    ("cmx", {"decoder_dropout": 0.5}),
    ("cmnext", {"drop_path_rate": 0.5}),
    ("mask2former", {"drop_path_rate": 0.2}),
    *(("dinov2", changes) for changes in ({"layers": (1, 2, 3, 4)}, {"tuning": "lora"})),
    ("efficientnet_lite", {"norm_momentum": None, "mask_token": "shared"}),
]
"""Every network as it is in `NANO`, and settings that change what it computes."""

NETWORKS = pytest.mark.parametrize(("name", "changes"), CASES)
DROPS = {"dropout", "drop_path_rate", "decoder_dropout"}


def drawn(net: Any, *given: Any, seed: int = 0, **options: Any) -> list[Tensor]:
    """All tensors that a network returns, logits first."""
    out = net(*given, generator=generator(seed), **options)
    return [tensor for tensor in (out.logits, *out.aux.values()) if tensor is not None]


@pytest.mark.parametrize("size", [(64, 96), (61, 83)])
@NETWORKS
def test_outputs_are_as_documented(
    name: str, changes: dict[str, Any], size: tuple[int, int]
) -> None:
    net = nano(name, **changes)
    of_masks = net.record.outputs == "masks"
    for training in (False, True):
        out = net.train(training)(*images(2, *size), generator=generator())
        says = getattr(type(net), "predict", type(net).forward).__doc__
        documented = re.findall(r'"(\w+)"', says.partition("aux:")[2])
        assert set(out.aux) <= set(documented)
        assert (out.logits is None) == (of_masks and training)
        if out.logits is not None:
            assert out.logits.shape == (2, net.num_classes, *size)
            assert out.logits.dtype == torch.float32
        assert net.record.features == ("features" in out.aux)
        assert not net.record.auxiliary or out.aux["aux_logits"].shape == out.logits.shape
        if of_masks:
            assert out.aux["class_logits"].shape == (4, 1, 2, 5, 5)
            assert out.aux["mask_logits"].shape == (4, 1, 2, 5, 16, 24)


@NETWORKS
def test_evaluation_repeats_itself_and_changes_nothing(name: str, changes: dict[str, Any]) -> None:
    net, pair = nano(name, **changes).eval(), images(2)
    before = {key: value.clone() for key, value in net.state_dict().items()}
    first, *others = (drawn(net, *pair, seed=seed) for seed in (0, 1))
    assert all(torch.equal(a, b) for a, b in zip(first, *others, strict=True))
    drawn(net.train(), *pair)
    net.load_state_dict(before)
    again = drawn(net.eval(), *pair)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert all(torch.equal(value, before[key]) for key, value in net.state_dict().items())


@NETWORKS
def test_hidden_pixels_do_not_count(name: str, changes: dict[str, Any]) -> None:
    net = nano(name, **changes).eval()
    randomise(net)
    hidden = torch.zeros(1, 2, 3, dtype=torch.bool)
    hidden[0, 1, 2] = True
    masks = MaskPair(hidden, hidden)
    pair = images(1)
    changed = tuple(image.clone() for image in pair)
    for image in changed:
        image[..., 32:, 64:] = 0.5
    with torch.no_grad():
        assert torch.equal(net(*pair, masks).logits, net(*changed, masks).logits)
        assert not torch.allclose(net(*pair).logits, net(*changed).logits)


@NETWORKS
def test_gradient_reaches_every_weight(name: str, changes: dict[str, Any]) -> None:
    heads = {"heads": ("main",)} if name == "deeplabv2" else {}
    net = nano(name, **changes, **heads)
    options: dict[str, Any] = {}
    if of_masks := net.record.outputs == "masks":
        options = {"masks": cells(4), "passes": 2, "views": VIEWS}
    for training in (True, False):  # a bias before a normalisation has a gradient in evaluation
        if of_masks or not training:
            randomise(net)
        net.zero_grad()
        found = drawn(net.train(training), *images(4), **options)
        sum((x * normal(*x.shape, seed=1)).sum() for x in found).backward()
        if of_masks:
            break
    trained = {key: p for key, p in net.named_parameters() if p.requires_grad}
    assert all(p.grad is not None and p.grad.isfinite().all() for p in trained.values())
    # In CMX, a softmax takes some biases away again.
    end = "weight" if name in ("cmx", "cmnext") else ""
    assert [key for key, p in trained.items() if key.endswith(end) and not p.grad.any()] == []


@NETWORKS
def test_draws_come_from_the_generator_alone(name: str, changes: dict[str, Any]) -> None:
    net, pair = nano(name, **changes).train(), images(4)
    state = torch.get_rng_state()
    first, same, other = (drawn(net, *pair, seed=seed)[0] for seed in (0, 0, 1))
    assert torch.equal(first, same)
    drops = name == "pspnet" or bool(DROPS & changes.keys())
    assert torch.equal(first, other) != drops
    assert torch.equal(state, torch.get_rng_state())
    if drops:
        with pytest.raises(ValueError, match="generator"):
            net(*pair)


@NETWORKS
def test_bfloat16_autocast_trains(name: str, changes: dict[str, Any]) -> None:
    net = nano(name, **changes).train()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = drawn(net, *images(4))
    assert name not in ("cmx", "cmnext") or found[0].dtype == torch.float32
    sum(x.float().square().mean() for x in found).backward()
    assert all(p.grad.isfinite().all() for p in net.parameters() if p.grad is not None)


ROTARY = {"position_grid": None, "position_resize": None, "rope_base": 9.0}


R50 = {"depths": "[3,4,6,3]"}
TWO = {"heads": "[source,target]"}
AUXILIARY = {"auxiliary": True}
# CMX-B1 and -B3 exist in the temporal release only, with an unused layer of 1467 parameters.
CMX = (12_114_641, 44_477_260 - 1_467, 66_565_521, 106_318_668 - 1_467, 139_858_321, 181_058_961)
CMNEXT = (10_287_337, 39_686_825, 58_686_017, 90_012_773, 116_560_396, 148_971_437)
SWIN = {"t": 74.92, "s": 117.56, "b": 193.50}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("yaml", "num_classes", "changes", "expected"),
    [
        # Counted from the releases' own networks.
        ("mfnet", 9, {}, 736_275),
        ("rtfnet_18", 9, {}, 30_995_525),
        ("rtfnet_34", 9, {}, 51_211_845),
        ("rtfnet_50", 9, {}, 185_238_501),
        # ResNet-101 without its classifier twice, once with a stem for one channel; the decoder.
        ("rtfnet_101", 9, {}, 138_228_709 + 2 * (44_549_160 - 2_049_000) - 2 * 64 * 7 * 7),
        ("rtfnet_152", 9, {}, 254_510_053),
        ("heatnet", 14, {}, 54_361_105),
        ("heatnet", 13, {}, 54_361_040),
        ("heatnet_rgb", 14, {}, 53_317_713),
        ("heatnet_thermal", 14, {}, 53_311_441),
        ("heatnet_early", 14, {}, 53_320_849),
        ("semseg", 14, {}, 49_076_188),
        ("semseg", 66, {}, 49_116_228),
        ("deeplabv2", 14, {}, 43_532_408),
        ("deeplabv2", 14, AUXILIARY, 44_048_560),
        ("deeplabv2", 19, AUXILIARY, 44_601_560),
        ("deeplabv2", 14, TWO, 44_564_656),
        ("deeplabv2", 14, TWO | R50, 25_572_528),
        ("deeplabv2_two_heads_literal", 14, {}, 44_575_498),
        ("deeplabv2_two_heads_modified", 14, {}, 198_594_658),
        *((f"cmx_b{size}", 9, {}, number) for size, number in enumerate(CMX)),
        *((f"cmnext_b{size}", 9, {}, number) for size, number in enumerate(CMNEXT)),
        # In millions, as printed.
        ("cmnext_b2", 25, {}, 58.69),
        *((f"mask2former_swin_{size}", 9, {}, number) for size, number in SWIN.items()),
        ("deeplabv2", 14, R50, 24.54),
        ("deeplabv2", 14, AUXILIARY | R50, 25.06),
        ("deeplabv2_two_heads_literal", 14, R50, 25.58),
        ("deeplabv2_two_heads_modified", 14, R50, 179.60),
        ("deeplabv2", 12, TWO, 44.27),
        ("deeplabv2", 13, TWO, 44.42),
    ],
)
def test_parameter_counts_are_the_published_ones(
    yaml: str, num_classes: int, changes: dict[str, Any], expected: float
) -> None:
    with torch.device("meta"):
        found = count(network(yaml, num_classes, **changes))
    assert found == expected if isinstance(expected, int) else round(found / 1e6, 2) == expected
