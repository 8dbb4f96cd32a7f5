"""What every network must do, on networks of few channels; sizes of those in conf/model."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from rgbt.checks import InputError
from rgbt.types import MaskPair
from tests.models.golden import alone, network
from tests.models.plain import count, generator, half, images, nano, normal, randomise

MODIFIED = {
    **{"ceil_mode": False, "decoder": "modified_heatnet"},
    **{"dropout": (0.3, 0.15), "align_corners": False},
}
LITERAL = {"ceil_mode": False, "decoder": "modified_thesis", "align_corners": False}
CASES: list[tuple[str, dict[str, Any]]] = [
    ("mfnet", {}),
    ("rtfnet", {}),
    *(("pspnet", {"modalities": m}) for m in ("late_fusion", "early_fusion", "rgb", "thermal")),
    *(("semseg", changes) for changes in ({"modalities": "thermal"}, {"dropout": 0.5})),
    *(("deeplabv2", changes) for changes in ({}, MODIFIED, LITERAL)),
    ("cmx", {}),
    ("cmx", {"drop_path_rate": 0.5, "drop_path_stage2": "released"}),
    ("cmx", {"decoder_dropout": 0.5}),
    *(("cmnext", changes) for changes in ({}, {"drop_path_rate": 0.5})),
]
NETWORKS = pytest.mark.parametrize(("name", "changes"), CASES)
DROPS = ("dropout", "drop_path_rate", "decoder_dropout")


@pytest.mark.parametrize("size", [(64, 96), (61, 83)])
@NETWORKS
def test_forward_returns_scores_of_every_pixel(
    name: str, changes: dict[str, Any], size: tuple[int, int]
) -> None:
    net = nano(name, **changes)
    for training in (False, True):
        out = net.train(training)(*images(2, *size), generator=generator())
        assert out.logits.shape == (2, net.num_classes, *size)
        assert out.logits.dtype == torch.float32
        assert net.record.features == ("features" in out.aux)
        assert not net.record.auxiliary or out.aux["aux_logits"].shape == out.logits.shape


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
    for training in (True, False):  # a bias before a normalisation has a gradient in evaluation
        if not training:
            randomise(net)
        net.zero_grad()
        out = net.train(training)(*images(4), generator=generator())
        scores = torch.cat([out.logits, *([out.aux["aux_logits"]] if out.aux.get("aux_logits")
                                          is not None else [])])  # fmt: skip
        (scores * normal(*scores.shape, seed=1)).sum().backward()
        assert all(p.grad is not None and p.grad.isfinite().all() for p in net.parameters())
    # In CMX, a softmax takes some biases away again.
    end = "weight" if name in ("cmx", "cmnext") else ""
    idle = [n for n, p in net.named_parameters() if n.endswith(end) and not p.grad.any()]
    assert idle == []


@NETWORKS
def test_draws_come_from_the_generator_alone(name: str, changes: dict[str, Any]) -> None:
    net, pair = nano(name, **changes).train(), images(4)
    rates = [getattr(net, "dropout", (0.0,)), changes.get("drop_path_rate"), changes]
    drops = any(rates[0]) or bool(rates[1]) or "decoder_dropout" in changes or "dropout" in changes
    state = torch.get_rng_state()

    def logits(seed: int) -> Tensor:
        return net(*pair, generator=generator(seed)).logits

    assert torch.equal(logits(0), logits(0))
    assert torch.equal(logits(0), logits(1)) != drops
    assert torch.equal(state, torch.get_rng_state())
    if drops:
        with pytest.raises(ValueError, match="generator"):
            net(*pair)


@NETWORKS
def test_views_and_images_that_do_not_fit_are_refused(name: str, changes: dict[str, Any]) -> None:
    net, (rgb, thermal) = nano(name, **changes).eval(), images(2)
    first, *_ = net.record.views
    assert torch.equal(net(rgb, thermal).logits, net(rgb, thermal, views=(first,)).logits)
    for views in ((first, "rgb"), ("infrared",), ({"rgbt": "rgb"}.get(first, "rgbt"),)):
        with pytest.raises(InputError, match="predicts from"):
            net(rgb, thermal, views=views)
    with pytest.raises(ValueError, match="thermal"):
        net(rgb, thermal[:1])


@pytest.mark.parametrize(
    ("name", "changes", "word"),
    [
        ("mfnet", {"rgb_widths": (2, 3, 4, 5)}, "rgb_widths"),
        ("mfnet", {"thermal_widths": (2, 3, 4, 5)}, "thermal_widths"),
        ("deeplabv2", {"decoder": "modified_thesis"}, "model.ceil_mode=false"),
        ("deeplabv2", {"heads": ("day", "day")}, "model.heads"),
        ("deeplabv2", {"heads": ("day.one",)}, "model.heads"),
        ("deeplabv2", {"heads": ("train",)}, "model.heads"),
        ("deeplabv2", {"rates": (2, 2)}, "model.rates"),
        ("deeplabv2", {"summed_rates": (2, 3)}, "model.summed_rates"),
        ("deeplabv2", {"summed_rates": (2, 2)}, "model.summed_rates"),
        ("deeplabv2", {"dropout": (0.3, 0.15)}, "model.dropout"),
        ("deeplabv2", {"inputs": half(1)}, "model/inputs=half_three"),
        ("semseg", {"inputs": half(1)}, "model/inputs=cmx"),
        ("cmx", {"num_heads": (3, 1, 1, 1)}, "num_heads"),
        ("cmx", {"mlp_ratio": 0.01}, "mlp_ratio"),
        ("cmnext", {"num_heads": (3, 1, 1, 1)}, "num_heads"),
        ("cmnext", {"mlp_ratio": 0.01}, "model.mlp_ratio"),
        ("cmnext", {"thermal_mlp_ratios": (1.0, 1.0, 0.01, 1.0)}, "model.thermal_mlp_ratios"),
        ("mask2former", {"hidden_dim": 48}, "hidden_dim"),
        ("mask2former", {"num_heads": (3, 1, 1, 1)}, "num_heads"),
        ("critic", {"align_corners": True}, "critic.align_corners"),
    ],
)
def test_settings_that_do_not_fit_name_the_key(
    name: str, changes: dict[str, Any], word: str
) -> None:
    with pytest.raises(InputError, match=word):
        nano(name, **changes)


R50 = {"depths": "[3,4,6,3]"}
TWO = {"heads": "[source,target]"}
AUXILIARY = {"auxiliary": True}


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
        ("deeplabv2", 14, {}, 43_532_408),
        ("deeplabv2", 14, AUXILIARY, 44_048_560),
        ("deeplabv2", 19, AUXILIARY, 44_601_560),
        ("deeplabv2", 14, TWO, 44_564_656),
        ("deeplabv2", 14, TWO | R50, 25_572_528),
        ("deeplabv2_two_heads_literal", 14, {}, 44_575_498),
        ("deeplabv2_two_heads_modified", 14, {}, 198_594_658),
        ("cmx_b0", 9, {}, 12_114_641),
        # B1 and B3 exist in the temporal release only, with an unused layer of 1467 parameters.
        ("cmx_b1", 9, {}, 44_477_260 - 1_467),
        ("cmx_b2", 9, {}, 66_565_521),
        ("cmx_b3", 9, {}, 106_318_668 - 1_467),
        ("cmx_b4", 9, {}, 139_858_321),
        ("cmx_b5", 9, {}, 181_058_961),
        # B0, B1 and B3 are commented out in the release.
        ("cmnext_b0", 9, {}, 10_287_337),
        ("cmnext_b1", 9, {}, 39_686_825),
        ("cmnext_b2", 9, {}, 58_686_017),
        ("cmnext_b3", 9, {}, 90_012_773),
        ("cmnext_b4", 9, {}, 116_560_396),
        ("cmnext_b5", 9, {}, 148_971_437),
        # In millions, as printed.
        ("cmnext_b2", 25, {}, 58.69),
        ("mask2former_swin_t", 9, {}, 74.92),
        ("mask2former_swin_s", 9, {}, 117.56),
        ("mask2former_swin_b", 9, {}, 193.50),
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


@pytest.mark.parametrize(
    ("name", "most"), [("mfnet", 2e5), ("rtfnet", 2e6), ("cmx", 1e6), ("cmnext", 1e6)]
)
def test_tiny_networks_stay_tiny(name: str, most: float) -> None:
    with torch.device("meta"):
        assert count(network(f"{name}_tiny")) < most


@pytest.mark.parametrize(
    ("yaml", "entries"),
    [
        ("mfnet", 228 + 38),
        ("rtfnet_18", 450),
        ("rtfnet_152", 2070),
        ("cmx_b0", 525),
        ("cmx_b4", 1837),
        ("cmnext_b2", 896),
        ("cmnext_b4", 1971),
        # Released: 693 entries; 24 index tables and the class weights are not kept here.
        ("mask2former_swin_t", 693 - 24 - 1),
    ],
)
def test_state_dicts_have_as_many_entries_as_released(yaml: str, entries: int) -> None:
    with torch.device("meta"):
        assert len(network(yaml).state_dict()) == entries


@pytest.mark.parametrize(
    ("yaml", "shapes"),
    [
        ("mfnet", {"conv1_inf.conv.weight": (16, 1, 3, 3), "decode1.conv.bias": (9,)}),
        (
            "rtfnet_50",
            {
                "encoder_thermal_layer4.2.conv3.weight": (2048, 512, 1, 1),
                "deconv5.1.upsample.0.weight": (128, 9, 2, 2),
            },
        ),
        (
            "cmx_b0",
            {
                "backbone.extra_block4.1.attn.kv.weight": (512, 256),
                "backbone.FRMs.3.spatial_weights.mlp.0.weight": (256, 512, 1, 1),
                "backbone.FFMs.1.cross.cross_attn.kv2.weight": (128, 64),
                "decode_head.linear_c4.proj.weight": (512, 256),
            },
        ),
    ],
)
def test_released_names_and_shapes(yaml: str, shapes: dict[str, tuple[int, ...]]) -> None:
    """One of each kind; the golden records compare all of them."""
    with torch.device("meta"):
        state = network(yaml).state_dict()
    assert {name: tuple(state[name].shape) for name in shapes} == shapes


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("deeplabv2", ["model.auxiliary=true"]),
        ("deeplabv2_two_heads_modified", []),
        ("heatnet", ["model.modalities=rgb"]),
    ],
)
def test_tiny_networks_differ_in_sizes_and_dropout_alone(name: str, changes: list[str]) -> None:
    small, large = (alone(f"model/{each}", *changes).model for each in (f"{name}_tiny", name))
    sizes = {"depths", "base_width", "decoder_width", "rates", "summed_rates", "dropout"}
    assert [k for k in large if k not in ("num_classes", *sizes) and small[k] != large[k]] == []
