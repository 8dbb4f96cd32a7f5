"""MFNet: sizes, a second computation from the weights alone, settings, counts."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.config.compose import conf_dir
from rgbt.models.inputs import Inputs
from rgbt.models.mfnet import MFNet, doubled
from tests.models.contract import (
    check_gradient_reaches_every_parameter,
    check_hidden_pixels_do_not_count,
    check_nothing_is_drawn,
)
from tests.models.golden import network


def unit(thermal_channels: int = 1) -> Inputs:
    return Inputs(
        rgb_order="rgb",
        rgb_mean=(0.0, 0.0, 0.0),
        rgb_std=(255.0, 255.0, 255.0),
        thermal_mean=(0.0,) * thermal_channels,
        thermal_std=(255.0,) * thermal_channels,
        thermal_scale="fixed",
    )


def nano(**changes: Any) -> MFNet:
    """A small network whose normalisations have statistics that are not 0 and 1."""
    values: dict[str, Any] = {
        "num_classes": 3,
        "rgb_widths": (2, 3, 4, 6),
        "thermal_widths": (3, 2, 3, 4),
        "decoder_width": 5,
        "final_activation": True,
        "inputs": unit(),
    }
    with torch.random.fork_rng():
        torch.manual_seed(0)
        net = MFNet(**{**values, **changes})
        for module in net.modules():
            if isinstance(module, nn.BatchNorm2d):
                nn.init.uniform_(module.running_var, 0.2, 0.5)
                nn.init.uniform_(module.weight, 0.8, 1.2)
                nn.init.normal_(module.running_mean, std=0.1)
                nn.init.normal_(module.bias, std=0.3)
    return net.eval()


def images(count: int, height: int = 32, width: int = 48, seed: int = 0) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(seed)
    return (
        torch.rand(count, 3, height, width, generator=g),
        torch.rand(count, 1, height, width, generator=g),
    )


class Weights:
    """The network again in NumPy and double precision, one image at a time."""

    def __init__(self, net: nn.Module) -> None:
        self.state = {name: value.double().numpy() for name, value in net.state_dict().items()}

    def unit(self, name: str, x: np.ndarray, dilation: int = 1, slope: float = 0.2) -> np.ndarray:
        w, bias = self.state[f"{name}.conv.weight"], self.state[f"{name}.conv.bias"]
        height, width = x.shape[1:]
        padded = np.pad(x, ((0, 0), (dilation, dilation), (dilation, dilation)))
        y = np.zeros((len(w), height, width)) + bias[:, None, None]
        for row in range(3):
            for column in range(3):
                top, left = row * dilation, column * dilation
                part = padded[:, top : top + height, left : left + width]
                y += np.einsum("oc,chw->ohw", w[:, :, row, column], part)
        mean, var, weight, shift = (
            self.state[f"{name}.bn.{part}"][:, None, None]
            for part in ("running_mean", "running_var", "weight", "bias")
        )
        y = (y - mean) / np.sqrt(var + 1e-5) * weight + shift
        return np.where(y >= 0, y, slope * y)

    def mini_inception(self, name: str, x: np.ndarray) -> np.ndarray:
        for level in (1, 2, 3):
            left = self.unit(f"{name}.conv{level}_left", x)
            right = self.unit(f"{name}.conv{level}_right", x, dilation=2)
            x = np.concatenate([left, right])
        return x

    def encoder(self, suffix: str, x: np.ndarray) -> list[np.ndarray]:
        """Features at strides 2, 4, 8 and 16."""
        x = pooled(self.unit(f"conv1_{suffix}", x))
        features = []
        for level in (2, 3):
            x = self.unit(f"conv{level}_1_{suffix}", x)
            x = self.unit(f"conv{level}_2_{suffix}", x)
            features.append(x)
            x = pooled(x)
        features.append(self.mini_inception(f"conv4_{suffix}", x))
        features.append(self.mini_inception(f"conv5_{suffix}", pooled(features[-1])))
        return features

    def logits(self, rgb: np.ndarray, thermal: np.ndarray) -> np.ndarray:
        half, quarter, eighth, x = (
            np.concatenate(pair)
            for pair in zip(self.encoder("rgb", rgb), self.encoder("inf", thermal))
        )
        for name, added in (("decode4", eighth), ("decode3", quarter), ("decode2", half)):
            x = self.unit(name, enlarged(x) + added)
        return self.unit("decode1", enlarged(x))


def pooled(x: np.ndarray) -> np.ndarray:
    corners = [x[:, row::2, column::2] for row in (0, 1) for column in (0, 1)]
    return np.max(corners, axis=0)


def enlarged(x: np.ndarray) -> np.ndarray:
    return x.repeat(2, axis=1).repeat(2, axis=2)


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("size", [(32, 48), (30, 41)])
def test_shapes(size: tuple[int, int], training: bool) -> None:
    out = nano().train(training)(*images(2, *size))
    assert out.logits.shape == (2, 3, *size)
    assert out.aux == {}


def test_values_from_the_weights_alone() -> None:
    net = nano()
    rgb, thermal = images(2)
    found = net(rgb, thermal).logits.detach().numpy()
    for index in range(2):
        expected = Weights(net).logits(rgb[index].double().numpy(), thermal[index].double().numpy())
        assert expected.std() > 0.1
        np.testing.assert_allclose(found[index], expected, rtol=1e-4, atol=1e-5)


def test_doubled_by_hand() -> None:
    x = torch.tensor([[[[1.0, 2.0], [3.0, 4.0]]]])
    expected = [[1, 1, 2, 2], [1, 1, 2, 2], [3, 3, 4, 4], [3, 3, 4, 4]]
    assert doubled(x)[0, 0].tolist() == expected


def test_final_activation_bends_the_same_logits() -> None:
    """Negative ones are a fifth of what they were; the class of every pixel stays."""
    with_it, without = nano()(*images(1)).logits, nano(final_activation=False)(*images(1)).logits
    assert without.min() < 0
    torch.testing.assert_close(with_it, torch.where(without >= 0, without, without * 0.2))
    assert torch.equal(with_it.argmax(1), without.argmax(1))


def test_padding_is_black() -> None:
    """30 x 41 equals the top left part of 32 x 48 that is black elsewhere."""
    net = nano()
    rgb, thermal = images(1, 30, 41)
    full = net(F.pad(rgb, (0, 7, 0, 2)), F.pad(thermal, (0, 7, 0, 2))).logits
    torch.testing.assert_close(net(rgb, thermal).logits, full[..., :30, :41])


def test_hidden_pixels_do_not_count() -> None:
    check_hidden_pixels_do_not_count(nano(), images(1, 64, 96))


def test_gradient_reaches_every_parameter() -> None:
    """A bias before a normalisation has none but rounding, so that it is checked in evaluation."""
    check_gradient_reaches_every_parameter(nano(), images(2))


def test_nothing_is_drawn_while_training() -> None:
    check_nothing_is_drawn(nano().train(), images(2))


def test_three_thermal_channels() -> None:
    net = nano(inputs=unit(3))
    assert net.get_submodule("conv1_inf").conv.weight.shape == (3, 3, 3, 3)
    assert net(*images(1)).logits.shape == (1, 3, 32, 48)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"rgb_widths": (2, 3, 4, 5)}, "rgb_widths"),
        ({"thermal_widths": (0, 2, 3, 4)}, "thermal_widths"),
        ({"decoder_width": 0}, "decoder_width"),
    ],
)
def test_widths_that_do_not_fit_name_the_key(change: dict[str, Any], key: str) -> None:
    with pytest.raises(InputError, match=key):
        nano(**change)


@pytest.mark.parametrize("views", [("thermal",), ("rgbt", "rgb")])
def test_other_views_are_refused(views: Any) -> None:
    with pytest.raises(InputError, match="MFNet predicts from rgbt"):
        nano()(*images(1), views=views)


def test_images_that_do_not_fit_each_other_raise() -> None:
    with pytest.raises(ValueError, match="thermal"):
        nano()(images(1)[0], images(1, 32, 32)[1])


@pytest.mark.parametrize("name", ["mfnet", "mfnet_tiny"])
def test_yaml_names_every_argument(name: str) -> None:
    node = OmegaConf.load(conf_dir() / "model" / f"{name}.yaml")
    wanted = set(inspect.signature(MFNet).parameters) - {"inputs"}
    assert set(node) - {"defaults", "_target_"} == wanted


def test_released_parameter_count_and_names() -> None:
    """736,275 parameters; shapes as the release's weights have them."""
    net = network("mfnet")
    state = net.state_dict()
    assert sum(p.numel() for p in net.parameters()) == 736_275
    assert len([name for name in state if not name.endswith("num_batches_tracked")]) == 228
    wide = {"conv1_rgb": (16, 3), "conv2_1_rgb": (48, 16), "conv1_inf": (16, 1)}
    wide |= {f"{name}_rgb": (48, 48) for name in ("conv2_2", "conv3_1", "conv3_2")}
    wide |= {f"{name}_inf": (16, 16) for name in ("conv2_1", "conv2_2", "conv3_1", "conv3_2")}
    for side in ("left", "right"):
        for level in (1, 2, 3):
            wide[f"conv4_rgb.conv{level}_{side}"] = (48, 48 if level == 1 else 96)
            wide[f"conv4_inf.conv{level}_{side}"] = (18, 16 if level == 1 else 36)
            wide[f"conv5_rgb.conv{level}_{side}"] = (48, 96)
            wide[f"conv5_inf.conv{level}_{side}"] = (18, 36)
    wide |= {"decode4": (64, 132), "decode3": (64, 64), "decode2": (32, 64), "decode1": (9, 32)}
    shapes = {name: tuple(value.shape) for name, value in state.items() if value.dim() == 4}
    assert shapes == {f"{name}.conv.weight": (*sizes, 3, 3) for name, sizes in wide.items()}


def test_tiny_stays_tiny_and_nothing_is_pretrained() -> None:
    net = network("mfnet_tiny")
    assert sum(p.numel() for p in net.parameters()) < 2e5
    assert net.record.views == ("rgbt",)
    assert net.record.pretrained_parts == ()
