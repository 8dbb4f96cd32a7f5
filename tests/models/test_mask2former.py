"""Mask2Former as a whole: sizes, views, passes, masks, stochastic depth, parameter counts."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.checks import InputError
from rgbt.models.mask2former.network import semantic_logits
from rgbt.types import MaskPair
from tests.models import plain
from tests.models.golden import network
from tests.models.plain import count, generator, images

nano = partial(plain.nano, "mask2former")
ALL_VIEWS = ("rgbt", "rgb", "thermal")


def cells(count: int, h: int = 2, w: int = 3, seed: int = 1) -> MaskPair:
    g = generator(seed)
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
    """60 x 84 equals 64 x 96 with the missing pixels set to the mean, 1/2."""
    net, pair = nano().eval(), images(1, 60, 84)
    full = net(*(nn.functional.pad(image, (0, 12, 0, 4), value=0.5) for image in pair))
    small = net(*pair)
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


def gradients(net: nn.Module, loss: Tensor) -> dict[str, Tensor]:
    net.zero_grad()
    loss.backward()
    return {name: p.grad.clone() for name, p in net.named_parameters()}


@pytest.mark.parametrize(("predictions", "with_masks"), [(6, 4), (4, 4), (5, 1)])
def test_fewer_predictions_equal_the_first_of_all(predictions: int, with_masks: int) -> None:
    """The loss reads the masks of some, and the final class logits of the others, as CRM does."""
    net = nano().train()
    pair, hidden = images(4), cells(4)
    g = generator(4)
    weights = {
        "class_logits": torch.randn(4, predictions, 2, 5, 5, generator=g),
        "mask_logits": torch.randn(4, with_masks, 2, 5, 16, 24, generator=g),
    }

    def loss(aux: dict[str, Tensor]) -> Tensor:
        supervised = sum(
            (aux[name][:, :with_masks] * w[:, :with_masks]).sum() for name, w in weights.items()
        )
        others = slice(with_masks, predictions)
        final = aux["class_logits"][-1, others] * weights["class_logits"][-1, others]
        return supervised + final.sum()

    every = net(*pair, hidden, passes=2, views=ALL_VIEWS).aux
    wanted = {"num_predictions": predictions, "num_masks": with_masks}
    fewer = net(*pair, hidden, passes=2, views=ALL_VIEWS, **wanted).aux
    for name, number in (("class_logits", predictions), ("mask_logits", with_masks)):
        assert fewer[name].shape[1] == number
        assert torch.equal(fewer[name], every[name][:, :number])
    expected = gradients(net, loss(every))
    found = gradients(net, loss(fewer))
    for name, gradient in found.items():  # sums of other rows are rounded in another order
        tolerance = 1e-5 * float(expected[name].abs().max()) + 1e-5
        torch.testing.assert_close(gradient, expected[name], rtol=1e-5, atol=tolerance)


def test_the_finest_features_of_predictions_without_masks_need_no_gradient() -> None:
    net = nano().train()
    aux = net(*images(2), views=ALL_VIEWS, num_masks=1).aux
    aux["class_logits"][-1, 1:].sum().backward()
    pixel_decoder = net.sem_seg_head.pixel_decoder
    for parameter in (pixel_decoder.layer_1.weight, pixel_decoder.adapter_1.weight):
        assert parameter.grad is None
    assert pixel_decoder.input_proj[0][0].weight.grad.any()


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


def test_shared_mask_token_is_one_parameter_with_the_gradient_of_both() -> None:
    apart, shared = nano(), nano(mask_token="shared")
    assert count(apart) - count(shared) == 8  # embed_dim values
    branches = (shared.backbone.RGB_branch, shared.backbone.THR_branch)
    assert branches[0].mask_token is branches[1].mask_token
    # With the same values in both branches of the other network, its two gradients add up.
    apart.load_state_dict(shared.state_dict())
    masks = cells(2, 4, 6)
    for net in (apart, shared):
        net(*images(2), masks).aux["mask_logits"].square().sum().backward()
    separate = [
        branch.mask_token.grad for branch in (apart.backbone.RGB_branch, apart.backbone.THR_branch)
    ]
    assert all(each.any() for each in separate)
    torch.testing.assert_close(branches[0].mask_token.grad, separate[0] + separate[1])


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
    nn.init.normal_(attention.sampling_offsets.weight, generator=generator(3))
    rgb, thermal = images(4)
    aux = net(rgb, thermal, cells(4), passes=2, views=ALL_VIEWS).aux
    g = generator(2)
    sum((x * torch.randn(x.shape, generator=g)).sum() for x in aux.values()).backward()
    idle = [n for n, p in net.named_parameters() if p.grad is None or not p.grad.any()]
    assert idle == []
    assert all(p.grad.isfinite().all() for p in net.parameters())


def test_stochastic_depth_follows_the_generator_only() -> None:
    net = nano(drop_path_rate=0.6).train()
    state = torch.get_rng_state()

    def run(seed: int) -> Tensor:
        return net(*images(4), generator=generator(seed)).aux["class_logits"]

    first = run(0)
    assert torch.equal(first, run(0))
    assert not torch.equal(first, run(1))
    assert torch.equal(state, torch.get_rng_state())
    with pytest.raises(ValueError, match="generator"):
        net(*images(1))


def test_stochastic_depth_factors() -> None:
    """Five blocks at rate 0.4: keep probabilities 1, .9, .8, .7, .6; factors 0 or 1/p; mean 1."""
    net = nano(drop_path_rate=0.4).train()
    seen: list[Tensor] = []
    for stage in net.backbone.RGB_branch.layers:
        stage.register_forward_pre_hook(lambda _m, args: seen.append(args[1]))
    net.backbone.RGB_branch(torch.zeros(2000, 3, 32, 32), None, generator())
    factor = torch.cat(seen)
    assert factor.shape == (5, 2, 2000, 1, 1, 1)
    for block, keep in enumerate((1.0, 0.9, 0.8, 0.7, 0.6)):
        values = factor[block].flatten()
        assert torch.allclose(values[values > 0], torch.tensor(1 / keep))
        assert abs(float((values > 0).float().mean()) - keep) < 0.03


@pytest.mark.parametrize(
    "call",
    [
        {"passes": 2},
        {"views": ("rgb", "rgb")},
        {"views": ("infrared",)},
        {"num_predictions": 2},
        {"num_masks": 2},
        {"num_masks": 0},
        {"views": ALL_VIEWS, "num_predictions": 2, "num_masks": 3},
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


@pytest.mark.parametrize("fp32", [True, False])
def test_autocast_keeps_the_pixel_decoder_in_single_precision_on_request(fp32: bool) -> None:
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
    ("name", "start", "millions"),
    [("t", 0, 27.53), ("t", 2, 29.02), ("t", 4, 55.04), ("s", 4, 97.68), ("b", 4, 173.49)],
)
def test_shared_stages(name: str, start: int, millions: float) -> None:
    with torch.device("meta"):
        net = network(f"mask2former_swin_{name}", share_start=start)
    assert round(count(net.backbone) / 1e6, 2) == millions


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
