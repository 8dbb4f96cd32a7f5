"""Mask2Former against tensors recorded from the released CRM network.

Needs the reference material beside the checkout (outputs of the release for weights that are
filled by a stated rule); skipped where it is missing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from rgbt.models.mask2former.model import Mask2Former
from rgbt.models.mask2former.network import LEVELS
from rgbt.types import MaskPair
from tests.models.golden import check_all, fill_network, load, network, recorded

HEADS = {"rgbt": "", "rgb": "rgb_head.", "thermal": "thermal_head."}


def record(net: Mask2Former) -> dict[str, Tensor]:
    """Outputs of inner modules under the names of the reference, refilled by each forward."""
    seen: dict[str, Tensor] = {}
    decoder = net.sem_seg_head.pixel_decoder
    watched = {
        "rgb.patch_embed": (net.backbone.RGB_branch.patch_embed, "map"),
        "thermal.patch_embed": (net.backbone.THR_branch.patch_embed, "map"),
        "pixel_decoder.adapter_1": (decoder.adapter_1, "same"),
    }
    for stage in range(4):
        rgb, thermal = (
            b.layers[stage].blocks for b in (net.backbone.RGB_branch, net.backbone.THR_branch)
        )
        watched[f"rgb.stage{stage}.block0"] = (rgb[0], "tokens")
        watched[f"thermal.stage{stage}.block1"] = (thermal[1], "tokens")
    for level in range(3):
        watched[f"pixel_decoder.input_proj.{level}"] = (decoder.input_proj[level], "same")
    for layer in (0, 2, 5):
        module = decoder.transformer.encoder["layers"][layer]
        watched[f"pixel_decoder.encoder_layer.{layer}"] = (module, "same")
    for layer, ffn in enumerate(net.sem_seg_head.predictor.transformer_ffn_layers):
        watched[f"decoder.layer.{layer}"] = (ffn, "queries")
    arrange = {
        "same": lambda x: x,
        "map": lambda x: x.permute(0, 3, 1, 2),
        "tokens": lambda x: x.flatten(1, 2),
        "queries": lambda x: x.transpose(0, 1),
    }
    for name, (module, kind) in watched.items():
        module.register_forward_hook(
            lambda _m, _i, out, name=name, kind=kind: seen.update({name: arrange[kind](out)})
        )
    net.backbone.register_forward_hook(
        lambda _m, args, out: seen.update(
            zip((*LEVELS, "network_input"), (*out, torch.cat(args[0], 1)), strict=True)
        )
    )
    decoder.register_forward_hook(lambda _m, _i, out: seen.update(pyramid(net, out)))
    return seen


def pyramid(net: Mask2Former, out: Any) -> dict[str, Tensor]:
    """What the pixel decoder returned, with its last convolution applied."""
    named = {
        "pixel_decoder.layer_1": out.fine,
        "pixel_decoder.mask_features": net.sem_seg_head.pixel_decoder.mask_features(out.fine),
    }
    for level, (tokens, hw) in enumerate(zip(out.tokens, out.levels, strict=True)):
        named[f"pixel_decoder.scale.{level}"] = tokens.transpose(1, 2).unflatten(2, hw)
    return named


def all_outputs(
    net: Mask2Former, image: tuple[Tensor, Tensor], hidden: MaskPair
) -> dict[str, Tensor]:
    """Every tensor of one clean and one masked forward of each view."""
    seen = record(net)
    found: dict[str, Tensor] = {}
    logits = {}
    for prefix, masks in (("", None), ("masked.", hidden)):
        for view, head in HEADS.items():
            out = net(*image, masks, views=(view,))
            classes, mask_logits = out.aux["class_logits"][:, 0], out.aux["mask_logits"][:, 0]
            for layer in range(10):
                name = f"aux.{layer}." if layer < 9 else ""
                found[f"{prefix}{head}{name}pred_logits"] = classes[layer]
                found[f"{prefix}{head}{name}pred_masks"] = mask_logits[layer]
            label = "fused" if view == "rgbt" else view
            found |= {f"{prefix}{label}.{level}": seen.pop(level) for level in LEVELS}
            found |= {f"{prefix}{head}{name}": value for name, value in seen.items()}
            logits[prefix + head] = classes[-1]
            if not prefix and not head:
                assert out.logits is not None
                found["sem_seg"] = out.logits[0]
    found["distill.sdc"] = (logits[""] - logits["masked."]).abs().mean()
    found["distill.sdn"] = sum(
        (
            (logits[""] - logits[f"masked.{head}"]).abs().mean()
            for head in ("rgb_head.", "thermal_head.")
        ),
        start=torch.zeros(()),
    )
    return found


@pytest.mark.parametrize(("name", "size"), recorded(r"crm_swin_([tsb]).*", fast=["crm_swin_t"]))
def test_every_recorded_tensor(name: str, size: str) -> None:
    golden = load(name)
    classes = golden.classes("network.sem_seg_head.predictor.class_embed.bias") - 1
    net = network(f"mask2former_swin_{size}", classes).eval()
    fill_network(net, golden, prefix="network.")
    hidden = torch.from_numpy(golden.arrays["mask_pair"]).bool()[:, :, 0]
    with torch.no_grad():
        found = all_outputs(net, golden.image, MaskPair(hidden[:, 0], hidden[:, 1]))
    check_all(golden, found)
    assert np.array_equal(found["sem_seg"].argmax(0).numpy(), golden.arrays["argmax"])
