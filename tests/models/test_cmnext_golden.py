"""CMNeXt against tensors and gradients recorded from the release (DELIVER), with two modalities.

It needs the reference material beside the checkout; skipped where that is missing.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.checkpoints.cmnext import released_name
from rgbt.models.cmnext import CMNeXt, PoolingGate
from rgbt.models.inputs import Images
from tests.models import golden
from tests.models.test_cmx_golden import arranged as arranged_as_in_cmx
from tests.models.test_cmx_golden import places as places_of_cmx

FAST = ("cmnext_b0",)
RECORDS = golden.recorded(r"cmnext_(b\d).*", fast=FAST, folder="cmnext/")
WITH_GRADIENTS = [each for each in RECORDS if each.id != "cmnext_b2_90x122"]


def filled(name: str, size: str) -> tuple[CMNeXt, golden.Golden]:
    recorded = golden.load(name)
    classes = recorded.classes("decode_head.linear_pred.bias")
    net: CMNeXt = golden.network(f"cmnext_{size}", classes).eval()
    golden.fill_network(net, recorded, named=released_name)
    return net, recorded


def places(net: CMNeXt) -> dict[str, str]:
    """Name in the record -> module."""
    paths = places_of_cmx(net) | {"decoder.logits_quarter": "decode_head.linear_pred"}
    for stage in range(1, 5):
        block = f"backbone.extra_block{stage}.0"
        paths |= {f"x.block{stage}.0": block, f"x.block{stage}.0.attn": f"{block}.attn"}
        paths[f"x.block{stage}.0.channel"] = f"{block}.c_nets"
    return paths


def arranged(name: str, output: Any) -> dict[str, Tensor]:
    """An output of ours as it is recorded: channels before places in the thermal stream."""
    if re.fullmatch(r"x\.block\d\.0\.\w+", name):  # inside a block they are arranged so here, too
        return {name: output}
    if name.startswith("x."):
        return {name: output.permute(0, 3, 1, 2)}
    return arranged_as_in_cmx(name, output)


def record(net: CMNeXt, rgb: Tensor, thermal: Tensor) -> dict[str, Tensor]:
    """Every recorded tensor of one forward, under the names of the record."""
    seen = golden.hook(net, places(net))
    with torch.inference_mode():
        logits = net(rgb, thermal).logits
        assert logits is not None
        images = net.inputs(rgb, thermal)
        found = {"logits": logits, "argmax": logits[0].argmax(0)}
        found |= {"network_input_rgb": images.rgb, "network_input_x": images.thermal}
        for name, output in seen.items():
            found |= arranged(name, output)
        # The release makes these maps; ours multiplies their layer with the one that follows.
        for stage in range(1, 5):
            layer = net.decode_head.get_submodule(f"linear_c{stage}.proj")
            found[f"decoder.linear_c{stage}"] = layer(seen[f"ffm{stage}"].flatten(1, 2))
    return found


@pytest.mark.parametrize(("name", "size"), RECORDS)
def test_every_tensor_equals_the_release(name: str, size: str) -> None:
    net, recorded = filled(name, size)
    released = {released_name(key) for key in net.state_dict()}
    assert released == set(recorded.facts["keys"])
    found = record(net, *recorded.image)
    outputs = {key for key in recorded.facts["outputs"] if not key.startswith(("grad.", "obj"))}
    assert found.keys() == outputs
    golden.check_all(recorded, found, only=outputs)
    # Where the two best classes are closer than the tolerance, rounding decides between them.
    best, second = found["logits"][0].topk(2, 0).values
    is_clear = best - second > 2 * recorded.facts["outputs"]["logits"]["tol_abs"]
    assert is_clear.float().mean() > 0.999
    expected = torch.from_numpy(recorded.arrays["argmax"]).long()
    assert torch.equal(found["argmax"][is_clear], expected[is_clear])


@pytest.mark.parametrize(("name", "size"), WITH_GRADIENTS)
def test_every_gradient_equals_the_release(name: str, size: str) -> None:
    """In float64, from the images as float32 makes them, as they were recorded."""
    net, recorded = filled(name, size)
    images = Images(*(x.double().requires_grad_() for x in net.inputs(*recorded.image)))
    net.double().inputs.register_forward_hook(lambda *_: images)
    logits = net(*recorded.image).logits
    assert logits is not None
    seed = recorded.facts["gradient"]["seed"]
    weights = torch.from_numpy(recorded.fill.normal(seed, tuple(logits.shape)))
    objective = (logits.double() * weights).sum()
    objective.backward()
    found = {f"grad.{released_name(key)}": p.grad for key, p in net.named_parameters()}
    found |= {
        "grad.network_input_rgb": images.rgb.grad,
        "grad.network_input_x": images.thermal.grad,
    }
    found["objective"] = objective
    wanted = {key for key in recorded.facts["outputs"] if key.startswith(("grad.", "objective"))}
    assert len(wanted) == 23
    golden.check_all(recorded, found, only=wanted, tolerance="tol_abs_float64")


def windows_of_nine(net: CMNeXt) -> None:
    for module in net.modules():
        if isinstance(module, PoolingGate):
            module.windows = (3, 7, 9)


def another_eps(kind: type[nn.Module], where: str, eps: float) -> Callable[[CMNeXt], None]:
    def change(net: CMNeXt) -> None:
        for name, module in net.named_modules():
            if isinstance(module, kind) and re.match(where, name):
                module.eps = eps  # type: ignore[assignment]

    return change


def thermal_as_rgb(net: CMNeXt) -> None:
    net.inputs.thermal_mean, net.inputs.thermal_std = net.inputs.rgb_mean, net.inputs.rgb_std


def largest_map_first(net: CMNeXt) -> None:
    weight = net.decode_head.get_parameter("linear_fuse.0.weight")
    weight.data = torch.cat(weight.data.chunk(4, 1)[::-1], 1)


MISTAKES: dict[str, Callable[[CMNeXt], None]] = {
    "pooling windows": windows_of_nine,
    "eps of the RGB stream": another_eps(nn.LayerNorm, r"backbone\.(patch|block|norm)", 1e-6),
    "eps of the thermal maps": another_eps(nn.LayerNorm, r"backbone\.extra_", 1e-5),
    "eps of the thermal blocks": another_eps(nn.BatchNorm2d, r"backbone\.extra_", 1e-3),
    "thermal inputs": thermal_as_rgb,
    "order of the decoder": largest_map_first,
}


@golden.requires_golden
def test_common_mistakes_are_seen() -> None:
    """Each of them moves a recorded tensor by more than its tolerance."""
    for mistake, change in MISTAKES.items():
        net, recorded = filled("cmnext/cmnext_b0", "b0")
        change(net)
        found = record(net, *recorded.image)
        worst = max(golden.deviation(recorded, key, found[key]) for key in found if key != "argmax")
        assert worst > 1, mistake
