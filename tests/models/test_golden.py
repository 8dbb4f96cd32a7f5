"""Networks against tensors that were recorded from their releases, for weights filled by a rule.

It needs the reference material beside the checkout; skipped where that is missing. Confusion counts
on real pairs are compared in tests/test_weights_run.py, by the command.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from rgbt.models.critic import Critic
from rgbt.models.inputs import Images
from rgbt.models.mask2former.network import LEVELS
from rgbt.types import MaskPair
from tests.models import golden
from tests.models.golden import Golden, recorded

Tensors = dict[str, Tensor]


def check(record: Golden, found: Tensors, only: set[str] | None = None) -> None:
    """All of the record; near a tie of the two best classes, rounding decides between them."""
    golden.check_all(record, found, only=only)
    logits = found["logits"][0]
    best, second = logits.topk(2, 0).values
    is_clear = best - second > 2 * record.facts["outputs"]["logits"]["tol_abs"]
    assert is_clear.float().mean() > 0.999
    expected = torch.from_numpy(record.arrays["argmax"]).long()
    assert torch.equal(logits.argmax(0)[is_clear], expected[is_clear])


def check_inputs(record: Golden, images: Tensor) -> None:
    """Images as the release feeds them, recorded at some positions."""
    about = record.facts["outputs"]["network_input"]
    at = record.fill.sample_positions("network_input", images.numel(), about["count"])
    difference = images.flatten().numpy()[at] - record.arrays["network_input"]
    assert np.abs(difference).max() <= about["tol_abs"]


# ---- CRM: Mask2Former ----------------------------------------------------------------------------

HEADS = {"rgbt": "", "rgb": "rgb_head.", "thermal": "thermal_head."}


def modules_of_crm() -> dict[str, str]:
    """Name in the record -> module."""
    head = "sem_seg_head.pixel_decoder"
    paths = {
        "backbone": "backbone.norm_layers",
        "pyramid": head,
        "pixel_decoder.adapter_1": f"{head}.adapter_1",
    }
    for name, branch, block in (("rgb", "RGB", 0), ("thermal", "THR", 1)):
        paths[f"{name}.patch_embed"] = f"backbone.{branch}_branch.patch_embed.norm"
        for stage in range(4):
            at = f"backbone.{branch}_branch.layers.{stage}.blocks.{block}"
            paths[f"{name}.stage{stage}.block{block}"] = at
    for level in range(3):
        paths[f"pixel_decoder.input_proj.{level}"] = f"{head}.input_proj.{level}"
    for layer in (0, 2, 5):
        at = f"{head}.transformer.encoder.layers.{layer}"
        paths[f"pixel_decoder.encoder_layer.{layer}"] = at
    for layer in range(9):
        at = f"sem_seg_head.predictor.transformer_ffn_layers.{layer}"
        paths[f"decoder.layer.{layer}"] = at
    return paths


def arranged_as_crm(net: Any, seen: dict[str, Any], label: str) -> Tensors:
    """Outputs of the modules as recorded; those of the pixel decoder after its last convolution."""
    pyramid = seen["pyramid"]
    found = {
        "pixel_decoder.layer_1": pyramid.fine,
        "pixel_decoder.mask_features": net.sem_seg_head["pixel_decoder"].mask_features(
            pyramid.fine
        ),
    }
    for level, (tokens, hw) in enumerate(zip(pyramid.tokens, pyramid.levels, strict=True)):
        found[f"pixel_decoder.scale.{level}"] = tokens.transpose(1, 2).unflatten(2, hw)
    for name, value in seen.items():
        if name.endswith("patch_embed"):
            found[name] = value.permute(0, 3, 1, 2)
        elif ".stage" in name:
            found[name] = value.flatten(1, 2)
        elif name.startswith("decoder.layer"):
            found[name] = value.transpose(0, 1)
        elif name not in ("backbone", "pyramid"):
            found[name] = value
    levels = zip(LEVELS, seen["backbone"], strict=True)
    return found | {f"{label}.{level}": value for level, value in levels}


@pytest.mark.parametrize(("name", "size"), recorded(r"crm_swin_([tsb]).*", fast=[]))
@torch.no_grad()
def test_crm(name: str, size: str) -> None:
    record = golden.load(name)
    classes = record.classes("network.sem_seg_head.predictor.class_embed.bias") - 1
    net = golden.network(f"mask2former_swin_{size}", classes).eval()
    golden.fill_network(net, record, prefix="network.")
    hidden = torch.from_numpy(record.arrays["mask_pair"]).bool()[:, :, 0]
    seen = golden.hook(net, modules_of_crm())
    found: Tensors = {}
    logits = {}
    for prefix, masks in (("", None), ("masked.", MaskPair(hidden[:, 0], hidden[:, 1]))):
        for view, head in HEADS.items():
            out = net(*record.image, masks, views=(view,))
            classes_, mask_logits = out.aux["class_logits"][:, 0], out.aux["mask_logits"][:, 0]
            for layer in range(10):
                at = f"{prefix}{head}" + (f"aux.{layer}." if layer < 9 else "")
                found[f"{at}pred_logits"], found[f"{at}pred_masks"] = (
                    classes_[layer],
                    mask_logits[layer],
                )
            inner = arranged_as_crm(net, seen, "fused" if view == "rgbt" else view)
            whole = {key for key in inner if key.endswith(LEVELS)}
            found |= {prefix + ("" if key in whole else head) + key: x for key, x in inner.items()}
            logits[prefix + head] = classes_[-1]
            if not prefix and not head:
                found["sem_seg"] = out.logits[0]
    found["distill.sdc"] = (logits[""] - logits["masked."]).abs().mean()
    others = [(logits[""] - logits[f"masked.{x}_head."]).abs().mean() for x in ("rgb", "thermal")]
    found["distill.sdn"] = torch.stack(others).sum()
    golden.check_all(record, found)
    assert np.array_equal(found["sem_seg"].argmax(0).numpy(), record.arrays["argmax"])


# ---- CMX, the temporal release, CMNeXt -----------------------------------------------------------

STREAMS = {"rgb": "", "x": "extra_"}
CMNEXT = recorded(r"cmnext_(b\d).*", fast=["cmnext_b0"], folder="cmnext/")


def modules_of_cmx(net: nn.Module) -> dict[str, str]:
    """Name in the record -> module; two outputs of one module share the beginning of a name."""
    paths = {"decoder.linear_fuse": "decode_head.linear_fuse.2"}
    for stage in range(1, 5):
        last = len(net.get_submodule(f"backbone.block{stage}")) - 1  # type: ignore[arg-type]
        for stream, prefix in STREAMS.items():
            for name in ("patch_embed", "norm"):
                paths[f"{stream}.{name}{stage}"] = f"backbone.{prefix}{name}{stage}"
            paths[f"{stream}.block{stage}.last"] = f"backbone.{prefix}block{stage}.{last}"
        paths[f"rgb.block{stage}.0.attn"] = f"backbone.block{stage}.0.attn"
        paths[f"x.block{stage}.0.mlp"] = f"backbone.extra_block{stage}.0.mlp"
        rectify, fuse = f"backbone.FRMs.{stage - 1}", f"backbone.FFMs.{stage - 1}"
        paths |= {f"frm{stage}": rectify, f"ffm{stage}": fuse, f"ffm{stage}.cross": f"{fuse}.cross"}
        for weights in ("channel_weights", "spatial_weights"):
            paths[f"frm{stage}.{weights}"] = f"{rectify}.{weights}"
    return paths


def arranged_as_cmx(name: str, output: Any) -> Tensors:
    """An output of ours, (N, H, W, C), as it is recorded: tokens, or channels before places."""
    if isinstance(output, tuple):
        both = zip(STREAMS, output, strict=True)
        maps = name.startswith("frm")
        return {f"{name}.{s}": x.permute(0, 3, 1, 2) if maps else x for s, x in both}
    if name.endswith("channel_weights"):
        return {name: output.view(len(output), 2, -1, 1, 1).transpose(0, 1)}
    if name.endswith("spatial_weights"):
        return {name: output.permute(3, 0, 1, 2)[:, :, None]}
    if name.startswith("ffm"):
        return {name: output.permute(0, 3, 1, 2)}
    return {name: output if name.startswith("decoder") else output.flatten(1, 2)}


def arranged_as_cmnext(name: str, output: Any) -> Tensors:
    """Channels come before places in the thermal stream; inside a block they do here, too."""
    if re.fullmatch(r"x\.block\d\.0\.\w+", name):
        return {name: output}
    if name.startswith("x."):
        return {name: output.permute(0, 3, 1, 2)}
    return arranged_as_cmx(name, output)


@torch.inference_mode()
def outputs_of_streams(net: Any, record: Golden, *, cmnext: bool = False) -> Tensors:
    """Every recorded tensor of one forward, under the names of the record."""
    paths = modules_of_cmx(net)
    if cmnext:
        paths["decoder.logits_quarter"] = "decode_head.linear_pred"
        for stage in range(1, 5):
            block = f"backbone.extra_block{stage}.0"
            paths |= {f"x.block{stage}.0": block, f"x.block{stage}.0.attn": f"{block}.attn"}
            paths[f"x.block{stage}.0.channel"] = f"{block}.c_nets"
    seen = golden.hook(net, paths)
    found = {"logits": net(*record.image).logits}
    images = net.inputs(*record.image)
    found |= {"network_input_rgb": images.rgb, "network_input_x": images.thermal}
    for name, output in seen.items():
        found |= (arranged_as_cmnext if cmnext else arranged_as_cmx)(name, output)
    # The release makes these maps; ours multiplies their layer with the one that follows.
    for stage in range(1, 5):
        layer = net.decode_head.get_submodule(f"linear_c{stage}.proj")
        found[f"decoder.linear_c{stage}"] = layer(seen[f"ffm{stage}"].flatten(1, 2))
    return found


@pytest.mark.parametrize(("name", "size"), recorded(r"cmx_mit_(b\d).*", fast=["cmx_mit_b0"]))
def test_cmx(name: str, size: str) -> None:
    record = golden.load(name)
    classes = record.classes("decode_head.linear_pred.bias")
    as_trained, net = (
        golden.network(f"cmx_{size}", classes, inputs="cmx_released", **eps).eval()
        for eps in ({}, {"decoder_norm_eps_eval": 1e-5})
    )
    golden.fill_network(net, record)
    assert set(net.state_dict()) == set(record.facts["keys"])
    as_trained.load_state_dict(net.state_dict())
    with torch.inference_mode():
        logits = as_trained(*record.image).logits
    check(record, outputs_of_streams(net, record) | {"logits_decoder_eps_1e-3": logits})


@pytest.mark.parametrize(("name", "size"), recorded(r"temporal_cmx_(b\d).*", fast=[]))
def test_temporal(name: str, size: str) -> None:
    record = golden.load(name)
    classes = record.classes("decode_head.linear_pred.bias")
    net = golden.network(f"cmx_{size}", classes, inputs="temporal").eval()
    golden.fill_network(net, record, unused=("voting.",))
    found = outputs_of_streams(net, record)
    # Recorded as the four channels that the release is given, before it repeats the thermal one.
    check_inputs(
        record, torch.cat([found["network_input_rgb"], found["network_input_x"][:, :1]], 1)
    )
    check(record, found)


def released_name(entry: str) -> str:
    """The thermal patch embeddings and the decoder have the names of CMX here."""
    if found := re.fullmatch(r"backbone\.extra_patch_embed(\d)\.(proj|norm)\.(.*)", entry):
        layer = {"proj": "proj.module", "norm": "norm.ln_0"}[found[2]]
        return f"backbone.extra_downsample_layers.{int(found[1]) - 1}.{layer}.{found[3]}"
    return entry.replace("linear_fuse.0.", "linear_fuse.conv.").replace("fuse.1.", "fuse.bn.")


def cmnext(name: str, size: str) -> tuple[Any, Golden]:
    record = golden.load(name)
    net = golden.network(f"cmnext_{size}", record.classes("decode_head.linear_pred.bias")).eval()
    golden.fill_network(net, record, named=released_name)
    return net, record


@pytest.mark.parametrize(("name", "size"), CMNEXT)
def test_cmnext(name: str, size: str) -> None:
    net, record = cmnext(name, size)
    assert {released_name(key) for key in net.state_dict()} == set(record.facts["keys"])
    found = outputs_of_streams(net, record, cmnext=True)
    outputs = {key for key in record.facts["outputs"] if not key.startswith(("grad.", "obj"))}
    assert found.keys() | {"argmax"} == outputs
    check(record, found, outputs)


@pytest.mark.parametrize(("name", "size"), [c for c in CMNEXT if c.id != "cmnext_b2_90x122"])
def test_gradients_of_cmnext(name: str, size: str) -> None:
    """In float64, from the images as float32 makes them, as they were recorded."""
    net, record = cmnext(name, size)
    images = Images(*(x.double().requires_grad_() for x in net.inputs(*record.image)))
    net.double().inputs.register_forward_hook(lambda *_: images)
    logits = net(*record.image).logits.double()
    seed = record.facts["gradient"]["seed"]
    objective = (logits * torch.from_numpy(record.fill.normal(seed, tuple(logits.shape)))).sum()
    objective.backward()
    found = {f"grad.{released_name(key)}": p.grad for key, p in net.named_parameters()}
    both = zip(("rgb", "x"), images, strict=True)
    found |= {f"grad.network_input_{name}": image.grad for name, image in both}
    found["objective"] = objective
    wanted = {key for key in record.facts["outputs"] if key.startswith(("grad.", "objective"))}
    assert len(wanted) == 23
    golden.check_all(record, found, only=wanted, tolerance="tol_abs_float64")


# ---- HeatNet, RTFNet, MFNet ----------------------------------------------------------------------


@pytest.mark.parametrize(("name", "_"), recorded(r"(heatnet).*", fast=[]))
@torch.no_grad()
def test_heatnet(name: str, _: str) -> None:
    """And its discriminator."""
    prefix, judge, record = "trgb_segnet.", "critics.0.", golden.load(name)
    classes = record.classes(f"{prefix}final.0.bias")
    net = golden.network("heatnet", num_classes=classes).eval()
    golden.fill_network(net, record, prefix, unused=(judge,))
    critic = Critic(in_channels=classes, base_width=64, upsample=True, align_corners=False)
    golden.fill_network(critic, record, judge, unused=(prefix,))

    encoder = ("conv1", "conv1_2", "layer1", "layer1_2", "layer2", "layer2_2", "layer3", "layer4")
    inner = {name: f"feats.{name}" for name in encoder}
    inner |= {f"psp.stage{index}": f"psp.stages.{index}" for index in range(4)}
    seen = golden.hook(net, inner | {name: name for name in ("psp", "up_1", "up_2", "up_3")})
    layers = ("conv1", "conv2", "conv3", "conv4", "classifier")
    judged = golden.hook(critic, {f"critic.{name}": name for name in layers})

    output = net(*record.image)
    found = {"logits": output.logits, "critic_on_logits": critic(output.logits)}
    for name, value in output.aux.items():
        named = {"features": "layer4", "layer3": "layer3"}.get(name, f"{name}_concat")
        found[f"critic_tensor.{named}"] = value
    check(record, found | seen | judged)


@pytest.mark.parametrize(("name", "depth"), recorded(r"(?:rtfnet_(\d+)|mfnet).*", fast=["mfnet"]))
def test_rtfnet_and_mfnet(name: str, depth: str | None) -> None:
    record, inputs, outputs = golden.load(name), {}, {}
    if depth:
        net = golden.network(f"rtfnet_{depth}", record.classes("deconv5.1.bn1.bias")).eval()
        for stream in ("rgb", "thermal"):
            outputs[f"{stream}.conv1"] = f"encoder_{stream}_conv1"
            for stage in range(1, 5):
                outputs[f"{stream}.layer{stage}"] = f"encoder_{stream}_layer{stage}"
        for block in range(1, 6):
            outputs |= {f"deconv{block}.a": f"deconv{block}.0", f"deconv{block}": f"deconv{block}"}
        inputs = {"thermal.stem": "encoder_thermal_maxpool", "fusion0": "encoder_rgb_maxpool"}
        inputs |= {f"fusion{stage}": f"encoder_rgb_layer{stage + 1}" for stage in (1, 2, 3)}
        inputs["fusion4"] = "deconv1"
    else:
        net = golden.network("mfnet", record.classes("decode1.bn.bias")).eval()
        inner = set(record.facts["outputs"]) - {"network_input", "logits", "argmax"}
        inputs = {key: key.removeprefix("in.") for key in inner if key.startswith("in.")}
        outputs = {key: key for key in inner if key not in inputs}
    golden.fill_network(net, record)
    assert set(net.state_dict()) == set(record.facts["keys"])
    after, before = golden.hook(net, outputs), golden.hook(net, inputs, inputs=True)
    with torch.inference_mode():
        logits = net(*record.image).logits
        check_inputs(record, torch.cat(net.inputs(*record.image), 1))
    check(record, {**after, **before, "logits": logits})
