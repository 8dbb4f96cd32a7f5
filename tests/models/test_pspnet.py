"""HeatNet's PSPNet: what is seen, a second computation, weights as drawn."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.pspnet import PSPNet
from tests.models.plain import Plain, images, nano, randomise

VIEW_OF = {"late_fusion": "rgbt", "early_fusion": "rgbt", "rgb": "rgb", "thermal": "thermal"}


@pytest.mark.parametrize("modalities", VIEW_OF)
def test_modalities_decide_what_is_seen_and_returned(modalities: str) -> None:
    net = nano("pspnet", modalities=modalities).eval()
    randomise(net)
    assert net.record.views == (VIEW_OF[modalities],)
    assert net.record.pretrained_parts == ("feats.",)
    branches = 2 if modalities == "late_fusion" else 1
    # After two branches the third stage keeps its width and has no projection.
    assert isinstance(net.feats.layer3[0].downsample, nn.Identity) == (branches == 2)
    rgb, thermal = images(1, 61, 83)
    with torch.no_grad():
        before = net(rgb, thermal)
        sees_rgb = not torch.equal(before.logits, net(1 - rgb, thermal).logits)
        sees_thermal = not torch.equal(before.logits, net(rgb, 1 - thermal).logits)
    assert (sees_rgb, sees_thermal) == (modalities != "thermal", modalities != "rgb")
    assert {name: tuple(x.shape[1:]) for name, x in before.aux.items()} == {
        "features": (128, 8, 11),
        "layer3": (64, 8, 11),
        "layer2": (32 * branches, 8, 11),
        "layer1": (16 * branches, 16, 22),
        "stem": (4 * branches, 16, 22),
    }


def reference(net: PSPNet, rgb: Tensor, thermal: Tensor) -> dict[str, Tensor]:
    """Late fusion at sides that are multiples of 8, written out."""
    plain, corners = Plain(net.state_dict()), net.psp.align_corners

    def enlarged(x: Tensor, size: tuple[int, ...]) -> Tensor:
        return F.interpolate(x, size=size, mode="bilinear", align_corners=corners)

    found: dict[str, list[Tensor]] = {"stem": [], "layer1": [], "layer2": []}
    for end, image in (("", 2 * rgb - 1), ("_2", 2 * thermal - 1)):
        x = plain.normed(f"feats.conv1{end}", f"feats.bn1{end}", image, stride=2)
        x = F.max_pool2d(x.clamp(min=0), 3, 2, 1)
        found["stem"].append(x)
        x = plain.stage(f"feats.layer1{end}", x)
        found["layer1"].append(x)
        found["layer2"].append(plain.stage(f"feats.layer2{end}", x, strides=(1, 2)))
    maps = {name: torch.cat(parts, 1) for name, parts in found.items()}
    maps["layer3"] = plain.stage("feats.layer3", maps["layer2"], dilations=(1, 2))
    maps["features"] = x = plain.stage("feats.layer4", maps["layer3"], dilations=(1, 4))

    pooled = [F.adaptive_avg_pool2d(x, bins) for bins in (1, 2, 3, 6)]
    small = [plain.conv(f"psp.stages.{index}.1", y) for index, y in enumerate(pooled)]
    joined = torch.cat([*(enlarged(y, x.shape[2:]) for y in small), x], 1)
    x = plain.conv("psp.bottleneck", joined).clamp(min=0)
    for name in ("up_1", "up_2", "up_3"):
        x = plain.up(name, x, align_corners=corners)
    return {**maps, "logits": plain.conv("final.0", x)}


@pytest.mark.parametrize("align_corners", [False, True])
def test_values_equal_a_second_computation(align_corners: bool) -> None:
    net = nano("pspnet", align_corners=align_corners).eval()
    randomise(net)
    rgb, thermal = images(2, 64, 88)
    with torch.no_grad():
        output, expected = net(rgb, thermal), reference(net, rgb, thermal)
    found = {**output.aux, "logits": output.logits}
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=1e-4, atol=1e-5, msg=name)


def test_weights_are_drawn_as_released() -> None:
    net = nano("pspnet", base_width=16)
    drawn = torch.cat([m.weight.flatten() for m in net.modules() if isinstance(m, nn.Conv2d)])
    norms = [m for m in net.modules() if isinstance(m, nn.BatchNorm2d)]
    scales = torch.cat([m.weight for m in norms])
    assert drawn.mean().item() == pytest.approx(0, abs=1e-4)
    assert drawn.std().item() == pytest.approx(0.02, rel=0.01)
    assert scales.mean().item() == pytest.approx(1, abs=2e-3)
    assert scales.std().item() == pytest.approx(0.02, rel=0.1)
    assert all((m.bias == 0).all() for m in norms)
    # torch's own: uniform within one over the root of the fan-in
    assert net.psp.bottleneck.bias.abs().max().item() == pytest.approx(2560**-0.5, rel=0.02)
    assert [net.get_parameter(f"up_{i}.conv.2.weight").item() for i in (1, 2, 3)] == [0.25] * 3
