"""RTFNet: sizes, a second computation from the weights alone, settings, start, counts."""

from __future__ import annotations

import inspect
import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.models.inputs import Inputs
from rgbt.models.rtfnet import RTFNet, UpceptionA, UpceptionB
from tests.models.contract import (
    check_gradient_reaches_every_parameter,
    check_hidden_pixels_do_not_count,
    check_nothing_is_drawn,
)
from tests.models.golden import compose, network

DEPTHS = (18, 34, 50, 101, 152)


def unit(thermal_channels: int = 1) -> Inputs:
    return Inputs(
        rgb_order="rgb",
        rgb_mean=(0.0, 0.0, 0.0),
        rgb_std=(255.0, 255.0, 255.0),
        thermal_mean=(0.0,) * thermal_channels,
        thermal_std=(255.0,) * thermal_channels,
        thermal_scale="fixed",
    )


def nano(seed: int = 0, **changes: Any) -> RTFNet:
    values: dict[str, Any] = {
        "num_classes": 4,
        "depth": 18,
        "base_width": 4,
        "final_relu": True,
        "thermal_stem": "rgb_mean",
        "inputs": unit(),
    }
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return RTFNet(**{**values, **changes})


def randomised(net: Any, seed: int = 0) -> Any:
    """`net` in evaluation mode with statistics and affine parameters that are not 0 and 1."""
    g = torch.Generator().manual_seed(seed)
    for name, tensor in net.state_dict().items():
        if name.endswith("running_var"):
            tensor.copy_(0.5 + torch.rand(tensor.shape, generator=g))
        elif tensor.dim() == 1 and name.endswith("weight"):
            tensor.copy_(0.8 + 0.4 * torch.rand(tensor.shape, generator=g))
        elif tensor.dim() == 1:
            tensor.copy_(0.2 * torch.randn(tensor.shape, generator=g))
    return net.eval()


def images(count: int, height: int = 64, width: int = 96, seed: int = 0) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(seed)
    return (
        torch.rand(count, 3, height, width, generator=g),
        torch.rand(count, 1, height, width, generator=g),
    )


class Weights:
    """The network again, as arithmetic on a state dict."""

    def __init__(self, net: nn.Module) -> None:
        self.state = net.state_dict()

    def normed(self, name: str, x: Tensor) -> Tensor:
        mean, var, weight, bias = (
            self.state[f"{name}.{part}"].view(-1, 1, 1)
            for part in ("running_mean", "running_var", "weight", "bias")
        )
        return (x - mean) * weight / (var + 1e-5).sqrt() + bias

    def conv(self, name: str, norm: str, x: Tensor, stride: int = 1) -> Tensor:
        weight = self.state[f"{name}.weight"]
        x = F.conv2d(x, weight, stride=stride, padding=weight.shape[2] // 2)
        return self.normed(norm, x)

    def doubled(self, name: str, norm: str, x: Tensor) -> Tensor:
        """Transposed 2x2 convolution with stride 2: every pixel becomes its own 2x2 square."""
        squares = torch.einsum("nihw,iokl->nohkwl", x, self.state[f"{name}.weight"])
        return self.normed(norm, squares.flatten(4, 5).flatten(2, 3))

    def block(self, name: str, x: Tensor, stride: int) -> Tensor:
        count = 3 if f"{name}.conv3.weight" in self.state else 2
        y = x
        for number in range(1, count + 1):
            # torchvision: the stride sits in the 3x3 convolution, of which a basic block has two.
            strided = number == count - 1
            y = self.conv(f"{name}.conv{number}", f"{name}.bn{number}", y, stride if strided else 1)
            y = y.relu() if number < count else y
        if f"{name}.downsample.0.weight" in self.state:
            x = self.conv(f"{name}.downsample.0", f"{name}.downsample.1", x, stride)
        return (x + y).relu()

    def stage(self, name: str, x: Tensor, stride: int) -> Tensor:
        blocks = {key.split(".")[1] for key in self.state if key.startswith(f"{name}.")}
        for number in range(len(blocks)):
            x = self.block(f"{name}.{number}", x, stride if number == 0 else 1)
        return x

    def upception_a(self, name: str, x: Tensor) -> Tensor:
        y = self.conv(f"{name}.conv1", f"{name}.bn1", x).relu()
        y = self.conv(f"{name}.conv2", f"{name}.bn2", y).relu()
        return (self.conv(f"{name}.conv3", f"{name}.bn3", y) + x).relu()

    def upception_b(self, name: str, x: Tensor) -> Tensor:
        """Without the ReLU at its end."""
        y = self.conv(f"{name}.conv1", f"{name}.bn1", x).relu()
        y = self.conv(f"{name}.conv2", f"{name}.bn2", y).relu()
        shortcut = self.doubled(f"{name}.upsample.0", f"{name}.upsample.1", x)
        return self.doubled(f"{name}.conv3", f"{name}.bn3", y) + shortcut

    def logits(self, rgb: Tensor, thermal: Tensor) -> Tensor:
        """Without the ReLU at their end."""
        x, y = (
            self.conv(f"encoder_{m}_conv1", f"encoder_{m}_bn1", image, 2).relu()
            for m, image in (("rgb", rgb), ("thermal", thermal))
        )
        x, y = (F.max_pool2d(F.pad(z, (1, 1, 1, 1)), 3, 2) for z in (x + y, y))
        for number in range(1, 5):
            stride = 1 if number == 1 else 2
            y = self.stage(f"encoder_thermal_layer{number}", y, stride)
            x = self.stage(f"encoder_rgb_layer{number}", x, stride) + y
        for number in range(1, 6):
            x = self.upception_b(f"deconv{number}.1", self.upception_a(f"deconv{number}.0", x))
            x = x.relu() if number < 5 else x
        return x


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("size", [(64, 96), (60, 84)])
def test_shapes(size: tuple[int, int], training: bool) -> None:
    out = nano().train(training)(*images(2, *size))
    assert out.logits.shape == (2, 4, *size)
    assert out.aux == {}


@pytest.mark.parametrize("depth", [18, 50])
def test_values_from_the_weights_alone(depth: int) -> None:
    net = randomised(nano(depth=depth, final_relu=False))
    pair = images(2)
    expected = Weights(net).logits(*pair)
    assert expected.std() > 0.1
    torch.testing.assert_close(net(*pair).logits, expected, rtol=1e-4, atol=1e-4)


def test_upception_blocks_from_the_weights_alone() -> None:
    x = torch.randn(2, 6, 5, 7, generator=torch.Generator().manual_seed(1))
    first, second = randomised(UpceptionA(6)), randomised(UpceptionB(6, 3, relu=True))
    torch.testing.assert_close(
        first(x), Weights(nn.ModuleDict({"a": first})).upception_a("a", x), rtol=1e-5, atol=1e-5
    )
    expected = Weights(nn.ModuleDict({"b": second})).upception_b("b", x).relu()
    assert second(x).shape == (2, 3, 10, 14)
    torch.testing.assert_close(second(x), expected, rtol=1e-5, atol=1e-5)


def test_final_relu_cuts_the_same_logits_at_zero() -> None:
    with_relu, without = randomised(nano()), randomised(nano(final_relu=False))
    cut, raw = with_relu(*images(1)).logits, without(*images(1)).logits
    assert raw.min() < 0
    assert torch.equal(cut, raw.clamp(min=0))


def test_the_thermal_encoder_never_sees_the_rgb_image() -> None:
    net = randomised(nano())
    seen: list[Tensor] = []
    net.encoder_thermal_layer4.register_forward_hook(lambda _m, _i, out: seen.append(out))
    (rgb, thermal), (other, _) = images(1), images(1, seed=1)
    first, second = net(rgb, thermal).logits, net(other, thermal).logits
    assert torch.equal(*seen)
    assert not torch.allclose(first, second)


def test_padding_is_black() -> None:
    """60 x 84 equals the top left part of 64 x 96 that is black elsewhere."""
    net = randomised(nano(final_relu=False))
    rgb, thermal = images(1, 60, 84)
    full = net(F.pad(rgb, (0, 12, 0, 4)), F.pad(thermal, (0, 12, 0, 4))).logits
    torch.testing.assert_close(net(rgb, thermal).logits, full[..., :60, :84])


def test_hidden_pixels_do_not_count() -> None:
    check_hidden_pixels_do_not_count(randomised(nano(final_relu=False)), images(1))


def test_gradient_reaches_every_parameter() -> None:
    check_gradient_reaches_every_parameter(nano(final_relu=False).train(), images(2))


def test_nothing_is_drawn_while_training() -> None:
    check_nothing_is_drawn(nano().train(), images(2))


def test_three_thermal_channels() -> None:
    """The grey image three times, through a copy of the RGB stem."""
    net = nano(inputs=unit(3))
    assert torch.equal(net.encoder_thermal_conv1.weight, net.encoder_rgb_conv1.weight)
    assert net.eval()(*images(1)).logits.shape == (1, 4, 64, 96)


def test_thermal_stem_starts_as_the_mean_of_the_rgb_stem_or_anew() -> None:
    mean, anew = nano(), nano(thermal_stem="xavier")
    assert (mean.thermal_stem, anew.thermal_stem) == ("rgb_mean", "xavier")
    weight = mean.encoder_rgb_conv1.weight
    expected = (weight[:, 0] + weight[:, 1] + weight[:, 2]) / 3
    torch.testing.assert_close(mean.encoder_thermal_conv1.weight[:, 0], expected)
    # Xavier, uniform: bound sqrt(6 / (fan_in + fan_out)) = sqrt(6 / (49 * 1 + 49 * 4)).
    bound = math.sqrt(6 / 245)
    assert 0.95 * bound < anew.encoder_thermal_conv1.weight.abs().max().item() <= bound


def test_start_of_encoders_and_decoder() -> None:
    """Encoders: normal, variance 2 / fan_out; decoder: uniform within sqrt(6 / both fans)."""
    net = nano(base_width=32)
    weight = net.encoder_thermal_layer3[1].conv2.weight
    assert weight.std().item() == pytest.approx(math.sqrt(2 / (9 * 128)), rel=0.02)
    weight = net.encoder_rgb_layer2[0].downsample[0].weight
    assert weight.shape == (64, 32, 1, 1)
    assert weight.std().item() == pytest.approx(math.sqrt(2 / 64), rel=0.06)
    for weight, fans in (
        (net.deconv1[0].conv2.weight, 9 * (256 + 256)),
        (net.deconv1[1].conv1.weight, 256 + 128),
        (net.deconv1[1].upsample[0].weight, 4 * (256 + 128)),
    ):
        bound = math.sqrt(6 / fans)
        assert 0.99 * bound < weight.abs().max().item() <= bound
        assert weight.std().item() == pytest.approx(bound / math.sqrt(3), rel=0.02)
    for module in net.modules():
        if isinstance(module, nn.BatchNorm2d):
            assert module.weight.eq(1).all()
            assert module.bias.eq(0).all()


@pytest.mark.parametrize("views", [("rgb",), ("rgbt", "thermal")])
def test_other_views_are_refused(views: Any) -> None:
    with pytest.raises(InputError, match="RTFNet predicts from rgbt"):
        nano().eval()(*images(1), views=views)


def test_images_that_do_not_fit_each_other_raise() -> None:
    with pytest.raises(ValueError, match="thermal"):
        nano().eval()(images(2)[0], images(1)[1])


@pytest.mark.parametrize("name", ["tiny", *DEPTHS])
def test_yaml_names_every_argument(name: str | int) -> None:
    node = compose(f"model=rtfnet_{name}").model
    wanted = set(inspect.signature(RTFNet).parameters)
    assert set(node) - {"_target_", "weights", "fresh"} == wanted


@pytest.mark.parametrize(
    ("depth", "parameters", "tensors"),
    [
        (18, 30_995_525, 450),
        (34, 51_211_845, 642),
        (50, 185_238_501, 846),
        (152, 254_510_053, 2070),
    ],
)
def test_released_parameter_counts(depth: int, parameters: int, tensors: int) -> None:
    with torch.device("meta"):
        net = network(f"rtfnet_{depth}")
    assert count(net) == parameters
    assert len(net.state_dict()) == tensors


def test_parameters_of_depth_101_from_published_counts() -> None:
    """ResNet-101 without its classifier twice, one of them with a stem for a single channel."""
    with torch.device("meta"):
        net = network("rtfnet_101")
    decoder = sum(count(net.get_submodule(f"deconv{number}")) for number in range(1, 6))
    encoder = 44_549_160 - (2048 + 1) * 1000
    assert decoder == 138_228_709
    assert count(net) == decoder + 2 * encoder - 2 * 64 * 7 * 7


def test_state_dict_names() -> None:
    """A few of the release's, one of each kind, with their shapes."""
    with torch.device("meta"):
        state = network("rtfnet_50").state_dict()
    for name, shape in {
        "encoder_thermal_conv1.weight": (64, 1, 7, 7),
        "encoder_rgb_conv1.weight": (64, 3, 7, 7),
        "encoder_thermal_bn1.running_var": (64,),
        "encoder_rgb_layer1.0.downsample.0.weight": (256, 64, 1, 1),
        "encoder_thermal_layer4.2.conv3.weight": (2048, 512, 1, 1),
        "deconv1.0.conv1.weight": (2048, 2048, 1, 1),
        "deconv1.1.conv3.weight": (1024, 1024, 2, 2),
        "deconv5.1.upsample.0.weight": (128, 9, 2, 2),
        "deconv5.1.upsample.1.bias": (9,),
    }.items():
        assert tuple(state[name].shape) == shape, name
    parts = {name.split("_")[0] if "_" in name else name[:6] for name in state}
    assert {part[:6] for part in parts} == {"encode", "deconv"}


def test_tiny_stays_tiny_and_has_a_pretrained_part() -> None:
    net = network("rtfnet_tiny")
    assert count(net) < 2e6
    assert net.record.views == ("rgbt",)
    covered = {n for n, _ in net.named_parameters() if n.startswith(net.record.pretrained_parts)}
    others = {n for n, _ in net.named_parameters()} - covered
    assert covered
    assert all(name.startswith("deconv") for name in others)


def count(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())
