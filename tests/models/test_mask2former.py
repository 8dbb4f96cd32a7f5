"""Mask2Former as a whole: sizes, views, passes, masks, stochastic depth, parameter counts."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.checks import InputError
from rgbt.models.inputs import Inputs
from rgbt.models.mask2former.model import Mask2Former, semantic_logits
from rgbt.types import MaskPair
from tests.models.golden import network

ALL_VIEWS = ("rgbt", "rgb", "thermal")
NANO = {
    "num_classes": 4,
    "embed_dim": 8,
    "depths": (1, 1, 2, 1),
    "num_heads": (1, 1, 2, 2),
    "window_size": 3,
    "mlp_ratio": 2.0,
    "drop_path_rate": 0.0,
    "share_start": 4,
    "fusion": "max",
    "hidden_dim": 32,
    "num_queries": 5,
    "encoder_layers": 1,
    "encoder_ffn_dim": 16,
    "decoder_layers": 3,
    "decoder_ffn_dim": 16,
    "attention_heads": 2,
    "pixel_decoder_fp32": True,
}
MEAN = (123.675, 116.28, 103.53, 127.0)
STD = (58.395, 57.12, 57.375, 60.0)


def nano(**changes: Any) -> Mask2Former:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        inputs = Inputs(
            rgb_order="rgb",
            rgb_mean=MEAN[:3],
            rgb_std=STD[:3],
            thermal_mean=MEAN[3:],
            thermal_std=STD[3:],
            thermal_scale="fixed",
        )
        return Mask2Former(**{**NANO, "inputs": inputs, **changes})


def images(count: int, height: int = 64, width: int = 96, seed: int = 0) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(seed)
    return (
        torch.rand(count, 3, height, width, generator=g),
        torch.rand(count, 1, height, width, generator=g),
    )


def cells(count: int, h: int = 2, w: int = 3, seed: int = 1) -> MaskPair:
    g = torch.Generator().manual_seed(seed)
    return MaskPair(*(torch.rand(count, h, w, generator=g) < 0.5 for _ in range(2)))


@pytest.mark.parametrize("size", [(64, 96), (60, 84)])
def test_shapes(size: tuple[int, int]) -> None:
    out = nano().eval()(*images(2, *size))
    assert out.logits is not None
    assert out.logits.shape == (2, 4, *size)
    assert out.aux["class_logits"].shape == (4, 1, 2, 5, 5)
    assert out.aux["mask_logits"].shape == (4, 1, 2, 5, 16, 24)


def test_logits_only_for_one_prediction_in_evaluation() -> None:
    net = nano()
    assert net.train()(*images(2)).logits is None
    assert net.eval()(*images(2), views=("rgb", "thermal")).logits is None
    assert net(*images(2), passes=2).logits is None


def test_padding_is_the_mean_colour() -> None:
    """60 x 84 equals 64 x 96 with the missing pixels set to the mean."""
    net = nano().eval()
    rgb, thermal = images(1, 60, 84)
    mean = torch.tensor(MEAN).view(4, 1, 1) / 255
    full_rgb, full_thermal = mean[:3].repeat(1, 1, 64, 96), mean[3:].repeat(1, 1, 64, 96)
    full_rgb[..., :60, :84], full_thermal[..., :60, :84] = rgb, thermal
    small, full = net(rgb, thermal), net(full_rgb, full_thermal)
    torch.testing.assert_close(small.aux["mask_logits"], full.aux["mask_logits"])
    torch.testing.assert_close(small.logits, full.logits[..., :60, :84])


@pytest.mark.parametrize("training", [False, True])
def test_batched_views_and_passes_equal_single_calls(training: bool) -> None:
    rgb, thermal = images(2)
    hidden = cells(2)
    nothing = MaskPair(torch.zeros(2, 2, 3).bool(), torch.zeros(2, 2, 3).bool())
    together, apart = nano().train(training), nano().train(training)
    both = MaskPair(
        torch.cat([nothing.rgb, hidden.rgb]), torch.cat([nothing.thermal, hidden.thermal])
    )
    out = together(
        rgb.repeat(2, 1, 1, 1), thermal.repeat(2, 1, 1, 1), both, passes=2, views=ALL_VIEWS
    )
    assert out.aux["class_logits"].shape[:3] == (4, 6, 2)

    # Pass by pass, within it view by view. The clean call comes first: batch statistics add up.
    for number, masks in enumerate((None, hidden)):
        for offset, view in enumerate(ALL_VIEWS):
            net = apart if view == "rgbt" else nano().train(training)
            single = net(rgb, thermal, masks, views=(view,))
            for name in ("class_logits", "mask_logits"):
                torch.testing.assert_close(
                    out.aux[name][:, 3 * number + offset],
                    single.aux[name][:, 0],
                    rtol=1e-4,
                    atol=1e-4,
                )
    for mine, theirs in zip(together.buffers(), apart.buffers(), strict=True):
        torch.testing.assert_close(mine, theirs)
    assert together.backbone.norm_layers["res2"].num_batches_tracked == (2 if training else 0)


def test_mask_token_replaces_exactly_the_hidden_tokens() -> None:
    net = nano().eval()
    seen: dict[str, Tensor] = {}
    for name in ("RGB_branch", "THR_branch"):
        branch = net.backbone.get_submodule(name)
        branch.patch_embed.register_forward_hook(
            lambda _m, _i, out, name=name: seen.update({f"{name}.embed": out})
        )
        branch.layers[0].register_forward_pre_hook(
            lambda _m, args, name=name: seen.update({name: args[0]})
        )
    masks = cells(2, 4, 6)
    net(*images(2), masks)
    for name, mask in zip(("RGB_branch", "THR_branch"), masks, strict=True):
        token = net.backbone.get_submodule(name).mask_token.flatten()
        for row in range(16):
            for column in range(24):
                hidden = mask[:, row // 4, column // 4, None]
                expected = torch.where(hidden, token, seen[f"{name}.embed"][:, row, column])
                assert torch.equal(seen[name][:, row, column], expected)


@pytest.mark.parametrize(("view", "idle"), [("rgb", "THR_branch"), ("thermal", "RGB_branch")])
def test_single_modality_does_not_run_the_other_branch(view: str, idle: str) -> None:
    net = nano().eval()

    def fail(*_: object) -> None:
        raise AssertionError(f"{idle} ran")

    net.backbone.get_submodule(idle).register_forward_pre_hook(fail)
    assert net(*images(1), views=(view,)).logits is not None
    with pytest.raises(AssertionError, match="ran"):
        net(*images(1))


def test_gradient_reaches_every_parameter() -> None:
    net = nano().train()
    # At initialisation the sampling offsets ignore their input, hence the position code too.
    attention = net.sem_seg_head.pixel_decoder.transformer.encoder["layers"][0].self_attn
    nn.init.normal_(attention.sampling_offsets.weight, generator=torch.Generator().manual_seed(3))
    rgb, thermal = images(4)
    aux = net(rgb, thermal, cells(4), passes=2, views=ALL_VIEWS).aux
    g = torch.Generator().manual_seed(2)
    sum((x * torch.randn(x.shape, generator=g)).sum() for x in aux.values()).backward()
    idle = [n for n, p in net.named_parameters() if p.grad is None or not p.grad.any()]
    assert idle == []
    assert all(p.grad.isfinite().all() for p in net.parameters())


def test_stochastic_depth_follows_the_generator_only() -> None:
    net = nano(drop_path_rate=0.6).train()
    state = torch.get_rng_state()

    def run(seed: int) -> Tensor:
        return net(*images(4), generator=torch.Generator().manual_seed(seed)).aux["class_logits"]

    first = run(0)
    assert torch.equal(first, run(0))
    assert not torch.equal(first, run(1))
    assert torch.equal(state, torch.get_rng_state())


def test_stochastic_depth_factors() -> None:
    """Five blocks at rate 0.4: keep probabilities 1, .9, .8, .7, .6; factors 0 or 1/p; mean 1."""
    branch = nano(drop_path_rate=0.4).backbone.RGB_branch
    factor = branch._draw_keep(torch.zeros(20000, 1), torch.Generator().manual_seed(0))
    assert factor.shape == (5, 2, 20000, 1, 1, 1)
    for block, keep in enumerate((1.0, 0.9, 0.8, 0.7, 0.6)):
        values = factor[block].flatten()
        assert torch.allclose(values[values > 0], torch.tensor(1 / keep))
        assert abs(float((values > 0).float().mean()) - keep) < 0.01


def test_training_without_generator_raises() -> None:
    with pytest.raises(ValueError, match="generator"):
        nano(drop_path_rate=0.1).train()(*images(1))
    assert nano(drop_path_rate=0.1).eval()(*images(1)).logits is not None


def test_without_a_view_the_fused_features_are_decoded() -> None:
    net = nano().eval()
    torch.testing.assert_close(net(*images(1)).logits, net(*images(1), views=("rgbt",)).logits)


@pytest.mark.parametrize(
    "call",
    [
        {"passes": 2},
        {"views": ("rgb", "rgb")},
        {"views": ("infrared",)},
        {"masks": cells(2)},
    ],
)
def test_inputs_that_do_not_fit_raise(call: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r".+"):
        nano().eval()(*images(3), **call)


@pytest.mark.parametrize("grid", [(3, 3), (2, 2), (32, 48), (5, 7)])
def test_cells_that_do_not_divide_are_named(grid: tuple[int, int]) -> None:
    with pytest.raises(InputError, match=r"patch size .*64 x 96|64 x 96.*patch size"):
        nano().eval()(*images(1), cells(1, *grid))


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"hidden_dim": 48}, "hidden_dim"),
        ({"num_heads": (3, 1, 1, 1)}, "num_heads"),
    ],
)
def test_sizes_that_do_not_fit_name_the_key(change: dict[str, Any], key: str) -> None:
    with pytest.raises(InputError, match=key):
        nano(**change)


def test_add_fusion_differs_from_max() -> None:
    added, largest = nano(fusion="add").eval(), nano().eval()
    assert not torch.allclose(added(*images(1)).logits, largest(*images(1)).logits)


@pytest.mark.parametrize("fp32", [True, False])
def test_autocast_keeps_the_pixel_decoder_in_single_precision_if_asked(fp32: bool) -> None:
    net = nano(pixel_decoder_fp32=fp32).train()
    seen: list[torch.dtype] = []
    net.sem_seg_head.pixel_decoder.layer_1.register_forward_hook(
        lambda _m, _i, out: seen.append(out.dtype)
    )
    with torch.autocast("cpu", dtype=torch.bfloat16):
        aux = net(*images(2), cells(2), views=ALL_VIEWS).aux
    assert (seen[0] == torch.float32) == fp32
    sum(x.float().square().mean() for x in aux.values()).backward()
    assert all(p.grad.isfinite().all() for p in net.parameters())


def test_weights_survive_evaluation_in_inference_mode() -> None:
    """Tables kept from an evaluation in inference mode may enter a training graph later."""
    net = nano()
    with torch.inference_mode():
        net.eval()(*images(1, 96, 64))
    net.train()(*images(2, 96, 64)).aux["mask_logits"].sum().backward()
    trained = net.sem_seg_head.pixel_decoder.mask_features.weight.grad
    assert trained is not None
    assert trained.abs().sum() > 0


def test_semantic_logits_by_hand() -> None:
    """One query, constant mask logit log 3 (probability 3/4), classes log(1, 2, 1): 3/16, 3/8."""
    classes = torch.tensor([[[1.0, 2.0, 1.0]]]).log()
    masks = torch.full((1, 1, 2, 2), 3.0).log()
    scores = semantic_logits(classes, masks, (5, 6), (8, 8))
    assert scores.shape == (1, 2, 5, 6)
    torch.testing.assert_close(scores[0, 0], torch.full((5, 6), 3 / 16))
    torch.testing.assert_close(scores[0, 1], torch.full((5, 6), 3 / 8))


@pytest.mark.parametrize(
    ("name", "millions", "backbone"),
    [("swin_t", 74.92, 55.04), ("swin_s", 117.56, 97.68), ("swin_b", 193.50, 173.49)],
)
def test_published_parameter_counts(name: str, millions: float, backbone: float) -> None:
    with torch.device("meta"):
        net = network(f"mask2former_{name}")
    assert round(count(net) / 1e6, 2) == millions
    assert round(count(net.backbone) / 1e6, 2) == backbone


@pytest.mark.parametrize(("start", "millions"), [(0, 27.53), (2, 29.02), (4, 55.04)])
def test_shared_stages(start: int, millions: float) -> None:
    with torch.device("meta"):
        net = network("mask2former_swin_t", share_start=start)
    assert round(count(net.backbone) / 1e6, 2) == millions
    # Released: 693 entries at any value; 24 index tables and the class weights are not kept here.
    assert len(net.state_dict()) == 693 - 24 - 1


def test_optimiser_groups_follow_from_types_and_names() -> None:
    """Sizes of the released groups for Swin-T: (learning rate, weight decay) -> numbers."""
    with torch.device("meta"):
        net = network("mask2former_swin_t")
    undecayed = (nn.LayerNorm, nn.BatchNorm2d, nn.GroupNorm, nn.Embedding)
    groups: dict[tuple[float, float], list[int]] = {}
    for module_name, module in net.named_modules():
        for name, parameter in module.named_parameters(recurse=False):
            rate = 1e-5 if module_name.startswith("backbone") else 1e-4
            free = isinstance(module, undecayed) or name == "relative_position_bias_table"
            groups.setdefault((rate, 0.0 if free else 0.05), []).append(parameter.numel())
    found = {key: (round(sum(sizes) / 1e6, 3), len(sizes)) for key, sizes in groups.items()}
    assert found[1e-5, 0.05] == (pytest.approx(54.94, abs=0.005), 204)
    assert found[1e-5, 0.0] == (pytest.approx(0.102, abs=0.0005), 160)
    assert found[1e-4, 0.05] == (pytest.approx(19.81, abs=0.005), 199)
    assert found[1e-4, 0.0] == (pytest.approx(0.075, abs=0.0005), 93)


def count(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())
