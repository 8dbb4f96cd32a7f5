"""Networks with Mask2Former's head: views, passes, masks, precision, shared stages, parts."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.mask2former.head import (
    centre_grid,
    shrink,
    sine_code,
)
from rgbt.models.mask2former.network import Fusion, semantic_logits
from rgbt.models.swin import PatchMerging, relative_index, shift_mask
from rgbt.types import VIEWS, MaskPair
from tests.models import plain
from tests.models.plain import cells, count, images, normal

nano = partial(plain.nano, "mask2former")
BOTH = pytest.mark.parametrize("name", ["mask2former", "dinov2"])


@pytest.mark.parametrize("training", [False, True])
@BOTH
@torch.no_grad()
def test_batched_views_and_passes_equal_single_calls(name: str, training: bool) -> None:
    rgb, thermal = images(2)
    hidden, nothing = cells(2), MaskPair(*(torch.zeros(2, 2, 3).bool() for _ in range(2)))
    both = MaskPair(*(torch.cat(pair) for pair in zip(nothing, hidden, strict=True)))
    together, apart = plain.nano(name).train(training), plain.nano(name).train(training)
    pair = rgb.repeat(2, 1, 1, 1), thermal.repeat(2, 1, 1, 1)
    out = together(*pair, both, passes=2, views=VIEWS)
    assert out.aux["class_logits"].shape[:3] == (4, 6, 2)

    # Pass by pass, within it view by view. The clean call comes first: batch statistics add up.
    for number, masks in enumerate((None, hidden)):
        for offset, view in enumerate(VIEWS):
            net = apart if view == "rgbt" else plain.nano(name).train(training)
            single = net(rgb, thermal, masks, views=(view,))
            for key in ("class_logits", "mask_logits"):
                found, expected = out.aux[key][:, 3 * number + offset], single.aux[key][:, 0]
                torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
    for mine, theirs in zip(together.buffers(), apart.buffers(), strict=True):
        torch.testing.assert_close(mine, theirs)
    assert together.backbone.norm_layers["res2"].num_batches_tracked == (2 if training else 0)


@pytest.mark.parametrize(("fusion", "order"), [("max", (-1, 0, 1)), ("add", (-1, 1, 0))])
def test_fusion_by_hand(fusion: Any, order: tuple[int, ...]) -> None:
    """Maxima 2, 3, 4 and sums 3, 5, 4: a deviation of sqrt(2 / 3) around the mean."""
    layer = Fusion((1, 1, 1, 1), fusion).train()
    rgb, thermal = torch.tensor([1.0, 3.0, 0.0]), torch.tensor([2.0, 2.0, 4.0])
    maps = {"rgb": [rgb.view(1, 1, 1, 3)] * 4, "thermal": [thermal.view(1, 1, 1, 3)] * 4}
    fused = torch.tensor(order) * 1.5**0.5
    for level in layer(maps, VIEWS, 1, 3):
        expected = torch.stack([fused, rgb, thermal]).view(3, 1, 1, 3)
        torch.testing.assert_close(level, expected, rtol=0, atol=1e-4)


def gradients(net: nn.Module, loss: Tensor) -> dict[str, Tensor]:
    net.zero_grad()
    loss.backward()
    return {name: p.grad.clone() for name, p in net.named_parameters()}


@pytest.mark.parametrize(("predictions", "with_masks"), [(6, 4), (4, 4), (5, 1)])
def test_fewer_predictions_equal_the_first_of_all(predictions: int, with_masks: int) -> None:
    """The loss reads the masks of some, and the final class logits of the others, as CRM does."""
    net, pair, hidden = nano().train(), images(4), cells(4)
    weights = {
        "class_logits": normal(4, predictions, 2, 5, 5, seed=4),
        "mask_logits": normal(4, with_masks, 2, 5, 16, 24, seed=5),
    }

    def loss(aux: dict[str, Tensor]) -> Tensor:
        first, others = slice(with_masks), slice(with_masks, predictions)
        supervised = sum((aux[name][:, first] * w[:, first]).sum() for name, w in weights.items())
        final = aux["class_logits"][-1, others] * weights["class_logits"][-1, others]
        return supervised + final.sum()

    every = net(*pair, hidden, passes=2, views=VIEWS).aux
    wanted = {"num_predictions": predictions, "num_masks": with_masks}
    fewer = net(*pair, hidden, passes=2, views=VIEWS, **wanted).aux
    for name, number in (("class_logits", predictions), ("mask_logits", with_masks)):
        assert fewer[name].shape[1] == number
        assert torch.equal(fewer[name], every[name][:, :number])
    expected = gradients(net, loss(every))
    for name, gradient in gradients(net, loss(fewer)).items():  # other rounding of the sums
        tolerance = 1e-5 * float(expected[name].abs().max()) + 1e-5
        torch.testing.assert_close(gradient, expected[name], rtol=1e-5, atol=tolerance)


def test_finest_features_need_no_gradient_without_masks() -> None:
    net = nano().train()
    aux = net(*images(2), views=VIEWS, num_masks=1).aux
    aux["class_logits"][-1, 1:].sum().backward()
    pixel_decoder = net.sem_seg_head["pixel_decoder"]
    for parameter in (pixel_decoder.layer_1.weight, pixel_decoder.adapter_1.weight):
        assert parameter.grad is None
    assert pixel_decoder.input_proj[0][0].weight.grad.any()


def test_mask_token_replaces_exactly_the_hidden_tokens() -> None:
    net = nano().eval()
    seen: dict[str, Tensor] = {}
    for name in ("RGB_branch", "THR_branch"):
        branch = net.backbone.get_submodule(name)
        branch.patch_embed["norm"].register_forward_hook(
            lambda _m, _i, out, name=name: seen.update({f"{name}.embed": out})
        )
        branch.layers[0].register_forward_pre_hook(
            lambda _m, args, name=name: seen.update({name: args[0]})
        )
    masks = cells(2, 4, 6)
    net(*images(2), masks)
    for name, mask in zip(("RGB_branch", "THR_branch"), masks, strict=True):
        hidden = mask.repeat_interleave(4, 1).repeat_interleave(4, 2)
        token = net.backbone.get_submodule(name).mask_token.flatten()
        expected = torch.where(hidden[..., None], token, seen[f"{name}.embed"])
        assert torch.equal(seen[name], expected)


def test_shared_mask_token_has_the_gradient_of_both_uses() -> None:
    apart, shared = nano(), nano(mask_token="shared")
    assert count(apart) - count(shared) == 8  # embed_dim values
    branches = (shared.backbone.RGB_branch, shared.backbone.THR_branch)
    assert branches[0].mask_token is branches[1].mask_token
    # With the same values in both branches of the other network, its two gradients add up.
    apart.load_state_dict(shared.state_dict())
    for net in (apart, shared):
        net(*images(2), cells(2, 4, 6)).aux["mask_logits"].square().sum().backward()
    first, second = (
        branch.mask_token.grad for branch in (apart.backbone.RGB_branch, apart.backbone.THR_branch)
    )
    assert first.any()
    assert second.any()
    torch.testing.assert_close(branches[0].mask_token.grad, first + second)


def test_calls_that_do_not_fit_raise() -> None:
    net, calls = nano().eval(), [{"passes": 2}, {"views": ("rgb", "rgb")}, {"masks": cells(2)}]
    calls += [{"num_predictions": 2}, {"num_masks": 2}, {"num_masks": 0}]
    for call in calls:
        with pytest.raises(ValueError, match=r"predictions|modality|masks"):
            net(*images(3), **call)


@pytest.mark.parametrize("fp32", [True, False])
def test_autocast_keeps_pixel_decoder_in_single_precision_on_request(fp32: bool) -> None:
    net = nano(pixel_decoder_fp32=fp32).train()
    seen: list[torch.dtype] = []
    net.sem_seg_head["pixel_decoder"].layer_1.register_forward_hook(
        lambda _m, _i, out: seen.append(out.dtype)
    )
    with torch.autocast("cpu", dtype=torch.bfloat16):
        aux = net(*images(2), cells(2), views=VIEWS).aux
    assert (seen[0] == torch.float32) == fp32
    sum(x.float().square().mean() for x in aux.values()).backward()
    assert all(p.grad.isfinite().all() for p in net.parameters())


def test_weights_survive_evaluation_in_inference_mode() -> None:
    """Tables kept from an evaluation in inference mode may enter a training graph later."""
    net = nano()
    with torch.inference_mode():
        net.eval()(*images(1, 96, 64))
    net.train()(*images(2, 96, 64)).aux["mask_logits"].sum().backward()
    assert net.sem_seg_head["pixel_decoder"].mask_features.weight.grad.any()


def test_semantic_logits_by_hand() -> None:
    """One query, constant mask logit log 3 (probability 3/4), classes log(1, 2, 1): 3/16, 3/8."""
    classes = torch.tensor([[[1.0, 2.0, 1.0]]]).log()
    masks = torch.full((1, 1, 2, 2), 3.0).log()
    scores = semantic_logits(classes, masks, (5, 6), (8, 8))
    assert scores.shape == (1, 2, 5, 6)
    torch.testing.assert_close(scores[0, 0], torch.full((5, 6), 3 / 16))
    torch.testing.assert_close(scores[0, 1], torch.full((5, 6), 3 / 8))


# ---- parts ---------------------------------------------------------------------------------------

CPU = torch.device("cpu")


def test_relative_index_by_hand() -> None:
    # Tokens (0,0) (0,1) (1,0) (1,1); (dy + 1) * 3 + (dx + 1).
    expected = [[4, 3, 1, 0], [5, 4, 2, 1], [7, 6, 4, 3], [8, 7, 5, 4]]
    assert relative_index(2).tolist() == expected


def test_shift_mask_by_hand() -> None:
    """4 x 4 tokens, windows of 2, rolled by 1: the last row and column came from the front."""
    mask = shift_mask((4, 4), 2, 1, CPU)
    assert mask.shape == (4, 1, 4, 4)
    blocked = mask[:, 0] < 0
    assert not blocked[0].any()
    columns_apart = torch.tensor([[0, 1, 0, 1], [1, 0, 1, 0], [0, 1, 0, 1], [1, 0, 1, 0]]).bool()
    rows_apart = torch.tensor([[0, 0, 1, 1], [0, 0, 1, 1], [1, 1, 0, 0], [1, 1, 0, 0]]).bool()
    assert torch.equal(blocked[1], columns_apart)
    assert torch.equal(blocked[2], rows_apart)
    assert torch.equal(blocked[3], columns_apart | rows_apart)


def test_patch_merging_order() -> None:
    """Four neighbours in the order (0,0) (1,0) (0,1) (1,1); an odd side is padded with zeros."""
    merge = PatchMerging(1)
    merge.norm = nn.Identity()
    merge.reduction = nn.Identity()
    x = torch.tensor([[1.0, 2, 3], [4, 5, 6]]).view(1, 2, 3, 1)
    assert merge(x).view(2, 4).tolist() == [[1, 4, 2, 5], [3, 6, 0, 0]]


def test_sine_code_equals_its_formula() -> None:
    code = sine_code((2, 3), 8, CPU).view(2, 3, 8)
    for y in range(2):
        for x in range(3):
            expected = []
            for position, size in ((y, 2), (x, 3)):
                angle = 2 * math.pi * (position + 1) / (size + 1e-6)
                for slower in (angle, angle / 10000 ** (2 / 4)):
                    expected += [math.sin(slower), math.cos(slower)]
            torch.testing.assert_close(code[y, x], torch.tensor(expected), rtol=1e-5, atol=1e-5)


def test_centre_grid_by_hand() -> None:
    centre, scale = centre_grid(((1, 2),), CPU)
    assert centre.tolist() == [[-0.5, 0.5], [0.0, 0.0]]
    assert scale.flatten().tolist() == [1.0, 2.0]


@pytest.mark.parametrize("factor", [2, 4, 8])
def test_shrink_equals_bilinear_interpolation(factor: int) -> None:
    x, size = normal(2, 3, 16, 24), (16 // factor, 24 // factor)
    expected = F.interpolate(x, size=size, mode="bilinear", align_corners=False)
    torch.testing.assert_close(shrink(x, factor), expected)
