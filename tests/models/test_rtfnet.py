"""RTFNet: values from the weights alone, its streams, its start."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.rtfnet import RTFNet
from tests.models.plain import Plain, half, images, nano, randomise


def logits_of(net: RTFNet, rgb: Tensor, thermal: Tensor) -> Tensor:
    """Without the ReLU at their end."""
    plain = Plain(net.state_dict())
    x, y = (
        plain.normed(f"encoder_{m}_conv1", f"encoder_{m}_bn1", 2 * image - 1, stride=2).relu()
        for m, image in (("rgb", rgb), ("thermal", thermal))
    )
    x, y = (F.max_pool2d(F.pad(z, (1, 1, 1, 1)), 3, 2) for z in (x + y, y))
    # torchvision: the stride sits in the 3x3 convolution, of which a basic block has two.
    basic = "encoder_rgb_layer1.0.conv3.weight" not in plain.state
    for number in range(1, 5):
        stride = min(number, 2)
        strides = (stride, 1) if basic else (1, stride)
        y = plain.stage(f"encoder_thermal_layer{number}", y, strides=strides)
        x = plain.stage(f"encoder_rgb_layer{number}", x, strides=strides) + y
    for number in range(1, 6):
        for at in (f"deconv{number}.0", f"deconv{number}.1"):
            z = plain.normed(f"{at}.conv1", f"{at}.bn1", x).relu()
            z = plain.normed(f"{at}.conv2", f"{at}.bn2", z).relu()
            if at.endswith(".0"):
                x = (plain.normed(f"{at}.conv3", f"{at}.bn3", z) + x).relu()
            else:
                shortcut = plain.doubled(f"{at}.upsample.0", f"{at}.upsample.1", x)
                x = plain.doubled(f"{at}.conv3", f"{at}.bn3", z) + shortcut
        x = x.relu() if number < 5 else x
    return x


@pytest.mark.parametrize("depth", [18, 50])
def test_values_from_the_weights_alone(depth: int) -> None:
    net, pair = nano("rtfnet", depth=depth).eval(), images(2)
    randomise(net)
    expected = logits_of(net, *pair)
    assert expected.std() > 0.1
    torch.testing.assert_close(net(*pair).logits, expected, rtol=1e-4, atol=1e-4)


def test_final_relu_cuts_the_same_logits_at_zero() -> None:
    cut, raw = nano("rtfnet", final_relu=True).eval(), nano("rtfnet").eval()
    raw.load_state_dict(randomise(cut))
    expected = raw(*images(1)).logits
    assert expected.min() < 0
    assert torch.equal(cut(*images(1)).logits, expected.clamp(min=0))


def test_thermal_encoder_never_sees_the_rgb_image() -> None:
    net = nano("rtfnet").eval()
    seen: list[Tensor] = []
    net.encoder_thermal_layer4.register_forward_hook(lambda _m, _i, out: seen.append(out))
    (rgb, thermal), (other, _) = images(1), images(1, seed=1)
    first, second = net(rgb, thermal).logits, net(other, thermal).logits
    assert torch.equal(*seen)
    assert not torch.allclose(first, second)


def test_thermal_stem_starts_as_the_mean_of_the_rgb_stem_or_anew() -> None:
    mean, anew = nano("rtfnet"), nano("rtfnet", thermal_stem="xavier")
    weight = mean.encoder_rgb_conv1.weight
    expected = (weight[:, 0] + weight[:, 1] + weight[:, 2]) / 3
    torch.testing.assert_close(mean.encoder_thermal_conv1.weight[:, 0], expected)
    # Xavier, uniform: bound sqrt(6 / (fan_in + fan_out)) = sqrt(6 / (49 * 1 + 49 * 4)).
    bound = math.sqrt(6 / 245)
    assert 0.95 * bound < anew.encoder_thermal_conv1.weight.abs().max().item() <= bound
    assert list(anew.record.drawn_anew) == ["encoder_thermal_conv1."]
    three = nano("rtfnet", inputs=half(3))
    assert torch.equal(three.encoder_thermal_conv1.weight, three.encoder_rgb_conv1.weight)


def test_start_of_encoders_and_decoder() -> None:
    """Encoders: normal, variance 2 / fan_out; decoder: uniform within sqrt(6 / both fans)."""
    net = nano("rtfnet", base_width=32)
    weight = net.encoder_thermal_layer3[1].conv2.weight
    assert weight.std().item() == pytest.approx(math.sqrt(2 / (9 * 128)), rel=0.02)
    weight = net.encoder_rgb_layer2[0].downsample[0].weight
    assert weight.std().item() == pytest.approx(math.sqrt(2 / 64), rel=0.06)
    for weight, fans in (
        (net.deconv1[0].conv2.weight, 9 * (256 + 256)),
        (net.deconv1[1].conv1.weight, 256 + 128),
        (net.deconv1[1].upsample[0].weight, 4 * (256 + 128)),
    ):
        bound = math.sqrt(6 / fans)
        assert 0.99 * bound < weight.abs().max().item() <= bound
        assert weight.std().item() == pytest.approx(bound / math.sqrt(3), rel=0.02)
    norms = [module for module in net.modules() if isinstance(module, nn.BatchNorm2d)]
    assert all(m.weight.eq(1).all() and m.bias.eq(0).all() for m in norms)


def test_pretrained_parts_are_the_encoders() -> None:
    net = nano("rtfnet")
    names = [name for name, _ in net.named_parameters()]
    others = [name for name in names if not name.startswith(net.record.pretrained_parts)]
    assert len(names) > len(others) > 0
    assert all(name.startswith("deconv") for name in others)
