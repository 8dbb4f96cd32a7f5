"""PSPNet of semseg: sizes as published, a second computation, what is seen and drawn."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from rgbt.models.semseg import SemsegPSPNet
from tests.models.plain import Plain, count, half, images, nano, randomise


def published(num_classes: int) -> SemsegPSPNet:
    with torch.device("meta"):
        return SemsegPSPNet(
            **{"num_classes": num_classes, "depths": (3, 4, 6, 3), "base_width": 64},
            **{"modalities": "rgb", "dropout": 0.1, "inputs": half(3)},
        )


def test_parameters_are_those_of_semseg() -> None:
    """With 66 classes: 46,739,458 without and 49,116,228 with the auxiliary head."""
    net = published(66)
    assert count(net) == 49_116_228
    assert count(net) - count(net.aux) == 46_739_458
    assert count(published(14)) == 49_076_188


def reference(net: SemsegPSPNet, image: Tensor) -> dict[str, Tensor]:
    """Written out; sides of 8 n + 1 pixels."""
    plain = Plain(net.state_dict())
    x = plain.normed("layer0.0", "layer0.1", 2 * image - 1, stride=2).clamp(min=0)
    x = plain.normed("layer0.3", "layer0.4", x).clamp(min=0)
    x = plain.normed("layer0.6", "layer0.7", x).clamp(min=0)
    x = plain.stage("layer1", F.max_pool2d(x, 3, 2, 1))
    x = plain.stage("layer2", x, strides=(1, 2))
    layer3 = plain.stage("layer3", x, dilations=(2, 2))
    x = plain.stage("layer4", layer3, dilations=(4, 4))
    joined = [x]
    for index, bins in enumerate((1, 2, 3, 6)):
        name = f"ppm.features.{index}"
        small = plain.normed(f"{name}.1", f"{name}.2", F.adaptive_avg_pool2d(x, bins))
        size = x.shape[2:]
        joined.append(F.interpolate(small.clamp(min=0), size, mode="bilinear", align_corners=True))

    def scores(head: str, features: Tensor) -> Tensor:
        narrow = plain.normed(f"{head}.0", f"{head}.1", features).clamp(min=0)
        found = plain.conv(f"{head}.4", narrow)
        eightfold = tuple(8 * (side - 1) + 1 for side in found.shape[2:])
        return F.interpolate(found, eightfold, mode="bilinear", align_corners=True)

    return {"logits": scores("cls", torch.cat(joined, 1)), "aux_logits": scores("aux", layer3)}


@pytest.mark.parametrize("modalities", ["rgb", "thermal"])
def test_values_equal_a_second_computation(modalities: str) -> None:
    net = nano("semseg", modalities=modalities).eval()
    randomise(net)
    rgb, thermal = images(2, 65, 89)
    image = rgb if modalities == "rgb" else thermal.expand(-1, 3, -1, -1)
    with torch.no_grad():
        output, expected = net(rgb, thermal), reference(net, image)
    torch.testing.assert_close(output.logits, expected["logits"], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(
        output.aux["aux_logits"], expected["aux_logits"], rtol=1e-4, atol=1e-5
    )


def test_modalities_decide_what_is_seen() -> None:
    rgb, thermal = images(1, 33, 41)
    for modalities in ("rgb", "thermal"):
        net = nano("semseg", modalities=modalities).eval()
        randomise(net)
        assert net.record.views == (modalities,)
        with torch.no_grad():
            before = net(rgb, thermal).logits
            assert torch.equal(before, net(1 - rgb, thermal).logits) == (modalities == "thermal")
            assert torch.equal(before, net(rgb, 1 - thermal).logits) == (modalities == "rgb")


def test_new_modules_have_the_larger_rate() -> None:
    """semseg trains layer0 to layer4 at 0.01, and pooling and heads at 0.1."""
    net = nano("semseg")
    named = {name.split(".")[0]: name.startswith(net.record.pretrained_parts) for name, _ in
             net.named_parameters()}  # fmt: skip
    assert named == {
        **dict.fromkeys(("layer0", "layer1", "layer2", "layer3", "layer4"), True),
        **dict.fromkeys(("ppm", "cls", "aux"), False),
    }


def test_backbone_is_drawn_by_fan_out() -> None:
    """N(0, sqrt(2 / (9 C_out)))."""
    net = nano("semseg", base_width=64, depths=(1, 1, 1, 1))
    drawn = net.layer4[0].conv2.weight
    assert drawn.std().item() == pytest.approx((2 / (9 * 512)) ** 0.5, rel=0.01)
