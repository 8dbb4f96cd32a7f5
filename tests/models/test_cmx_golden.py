"""CMX against tensors recorded from the CMX and the temporal release, and small values of FRM, FFM.

The first part needs the reference material beside the checkout; skipped where it is missing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from rgbt.config.component import build
from rgbt.models.cmx.fusion import Fusion, Rectification
from rgbt.models.cmx.model import CMX
from tests.models import golden

AS_CMX_EVALUATES = ("model/inputs=cmx_released", "model.decoder_norm_eps_eval=1e-5")
AS_CMX_TRAINS = ("model/inputs=cmx_released",)
AS_TEMPORAL = ("model/inputs=temporal",)
STREAMS = {"rgb": "", "x": "extra_"}


def network(model: str, classes: int, *overrides: str) -> CMX:
    """The network as a user asks for it on the command line, for evaluation."""
    net: CMX = build(golden.compose(model, f"model.num_classes={classes}", *overrides).model)
    return net.eval()


def classes_of(recorded: golden.Golden) -> int:
    return recorded.classes("decode_head.linear_pred.bias")


def places(net: nn.Module) -> dict[str, str]:
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


def arranged(name: str, output: Any) -> dict[str, Tensor]:
    """An output of ours, (N, H, W, C), as it is recorded: tokens, or channels before places."""
    if isinstance(output, tuple):
        both = zip(STREAMS, output, strict=True)
        maps = name.startswith("frm")
        return {f"{name}.{s}": x.permute(0, 3, 1, 2) if maps else x for s, x in both}
    if name.endswith("_weights"):
        return {name: output.permute(0, 1, 4, 2, 3)}
    if name.startswith("ffm"):
        return {name: output.permute(0, 3, 1, 2)}
    return {name: output if name.startswith("decoder") else output.flatten(1, 2)}


def record(net: CMX, rgb: Tensor, thermal: Tensor) -> dict[str, Tensor]:
    """Every recorded tensor of one forward, under the names of the record."""
    seen = golden.hook(net, places(net))
    with torch.inference_mode():
        logits = net(rgb, thermal).logits
        assert logits is not None
        found = {"logits": logits}
        images = net.inputs(rgb, thermal)
        found |= {"network_input_rgb": images.rgb, "network_input_x": images.thermal}
        for name, output in seen.items():
            found |= arranged(name, output)
        # The release makes these maps; ours multiplies their layer with the one that follows.
        for stage in range(1, 5):
            layer = net.decode_head.get_submodule(f"linear_c{stage}.proj")
            found[f"decoder.linear_c{stage}"] = layer(seen[f"ffm{stage}"].flatten(1, 2))
    return found


def check(recorded: golden.Golden, found: dict[str, Tensor]) -> None:
    golden.check_all(recorded, found)
    assert len(found) + 1 == len(recorded.facts["outputs"]), "all of the record, the class map too"
    assert np.array_equal(found["logits"][0].argmax(0).numpy(), recorded.arrays["argmax"])


@pytest.mark.parametrize(("name", "size"), golden.recorded(r"cmx_mit_(b\d).*", fast=["cmx_mit_b0"]))
def test_cmx_release(name: str, size: str) -> None:
    recorded = golden.load(name)
    classes = classes_of(recorded)
    net = network(f"model=cmx_{size}", classes, *AS_CMX_EVALUATES)
    golden.fill_network(net, recorded)
    assert set(net.state_dict()) == set(recorded.facts["keys"])
    found = record(net, *recorded.image)

    as_trained = network(f"model=cmx_{size}", classes, *AS_CMX_TRAINS)
    as_trained.load_state_dict(net.state_dict())
    with torch.inference_mode():
        logits = as_trained(*recorded.image).logits
    assert logits is not None
    check(recorded, found | {"logits_decoder_eps_1e-3": logits})


@pytest.mark.parametrize(
    ("name", "size"), golden.recorded(r"temporal_cmx_(b\d).*", fast=["temporal_cmx_b2"])
)
def test_temporal_release(name: str, size: str) -> None:
    recorded = golden.load(name)
    net = network(f"model=cmx_{size}", classes_of(recorded), *AS_TEMPORAL)
    golden.fill_network(net, recorded, unused=("voting.",))
    found = record(net, *recorded.image)

    # Recorded as the four channels that the release is given, before it repeats the thermal one.
    fed = torch.cat([found.pop("network_input_rgb"), found.pop("network_input_x")[:, :1]], 1)
    about = recorded.facts["outputs"]["network_input"]
    at = recorded.fill.sample_positions("network_input", fed.numel(), about["count"])
    difference = fed.flatten().numpy()[at] - recorded.arrays["network_input"]
    assert np.abs(difference).max() <= about["tol_abs"]
    check(recorded, found | {"network_input": fed})


def waves(module: nn.Module, order: str) -> nn.Module:
    """The k-th named parameter filled with 0.1 sin(0.37 i + k) over its flat index i."""
    for k, name in enumerate(order.split()):
        parameter = module.get_parameter(name)
        i = torch.arange(parameter.numel(), dtype=torch.float64)
        parameter.data = (0.1 * torch.sin(0.37 * i + k)).view(parameter.shape).float()
    assert len(order.split()) == len(list(module.parameters()))
    return module.eval()


def pair() -> tuple[Tensor, Tensor]:
    """sin(n / 2) and cos(0.3 n) over the flat index of (1, 4, 2, 3), channels last."""
    n = torch.arange(24.0).view(1, 4, 2, 3)
    return torch.sin(0.5 * n).permute(0, 2, 3, 1), torch.cos(0.3 * n).permute(0, 2, 3, 1)


def weights_and_biases(*names: str) -> str:
    return " ".join(f"{name}.weight {name}.bias" for name in names)


FRM = weights_and_biases(
    *(f"{kind}_weights.mlp.{number}" for kind in ("channel", "spatial") for number in (0, 2))
)
FFM = " ".join(
    [
        weights_and_biases("cross.channel_proj1", "cross.channel_proj2"),
        "cross.cross_attn.kv1.weight cross.cross_attn.kv2.weight",
        weights_and_biases("cross.end_proj1", "cross.end_proj2", "cross.norm1", "cross.norm2"),
        "channel_emb.residual.weight",
        weights_and_biases(*(f"channel_emb.channel_embed.{number}" for number in (0, 1, 3, 4))),
        weights_and_biases("channel_emb.norm"),
    ]
)


def test_rectification_equals_values_computed_with_the_release() -> None:
    with torch.no_grad():
        out1, out2 = waves(Rectification(4), FRM)(*pair())
    first = out1.permute(0, 3, 1, 2).flatten()[:6]
    expected = torch.tensor([0.503615, 0.960244, 1.256737, 1.310256, 1.091672, 0.634088])
    torch.testing.assert_close(first, expected, rtol=0, atol=1e-6)
    sums = torch.stack([out1.sum(), out2.sum()])
    torch.testing.assert_close(sums, torch.tensor([2.031333, 3.106600]), rtol=0, atol=5e-6)


def test_fusion_equals_values_computed_with_the_release() -> None:
    with torch.no_grad():
        out = waves(Fusion(4, heads=2), FFM)(*pair()).permute(0, 3, 1, 2)
    expected = torch.tensor([-0.087767, -0.087639, -0.087443, -0.087349, -0.087309, -0.087297])
    torch.testing.assert_close(out.flatten()[:6], expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(out.sum(), torch.tensor(-1.095838), rtol=0, atol=5e-6)
