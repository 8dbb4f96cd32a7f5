"""MFNet: values from the weights alone, its last activation, padding."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from rgbt.models.mfnet import MFNet, doubled
from tests.models.plain import Plain, half, images, nano, randomise


def logits_of(net: MFNet, rgb: Tensor, thermal: Tensor) -> Tensor:
    plain = Plain(net.state_dict())

    def unit(name: str, x: Tensor, dilation: int = 1) -> Tensor:
        y = plain.normed(f"{name}.conv", f"{name}.bn", x, dilation=dilation)
        return torch.where(y > 0, y, 0.2 * y)

    def inception(name: str, x: Tensor) -> Tensor:
        for level in (1, 2, 3):
            left = unit(f"{name}.conv{level}_left", x)
            x = torch.cat([left, unit(f"{name}.conv{level}_right", x, dilation=2)], 1)
        return x

    def encoder(end: str, x: Tensor) -> list[Tensor]:
        """Features at strides 2, 4, 8 and 16."""
        x, found = F.max_pool2d(unit(f"conv1_{end}", x), 2), []
        for level in (2, 3):
            x = unit(f"conv{level}_2_{end}", unit(f"conv{level}_1_{end}", x))
            found.append(x)
            x = F.max_pool2d(x, 2)
        found.append(inception(f"conv4_{end}", x))
        return [*found, inception(f"conv5_{end}", F.max_pool2d(found[-1], 2))]

    def enlarged(x: Tensor) -> Tensor:
        return x.repeat_interleave(2, 2).repeat_interleave(2, 3)

    pairs = zip(encoder("rgb", 2 * rgb - 1), encoder("inf", 2 * thermal - 1))
    half_, quarter, eighth, x = (torch.cat(pair, 1) for pair in pairs)
    for name, added in (("decode4", eighth), ("decode3", quarter), ("decode2", half_)):
        x = unit(name, enlarged(x) + added)
    return unit("decode1", enlarged(x))


def test_values_from_the_weights_alone() -> None:
    net, pair = nano("mfnet").eval(), images(2)
    randomise(net)
    expected = logits_of(net, *pair)
    assert expected.std() > 0.05
    torch.testing.assert_close(net(*pair).logits, expected, rtol=1e-4, atol=1e-5)


def test_doubled_by_hand() -> None:
    x = torch.tensor([[[[1.0, 2.0], [3.0, 4.0]]]])
    expected = [[1, 1, 2, 2], [1, 1, 2, 2], [3, 3, 4, 4], [3, 3, 4, 4]]
    assert doubled(x)[0, 0].tolist() == expected


def test_final_activation_bends_the_same_logits() -> None:
    """Negative ones are a fifth of what they were."""
    bent, raw = nano("mfnet").eval(), nano("mfnet", final_activation=False).eval()
    raw.load_state_dict(randomise(bent))
    with_it, without = bent(*images(1)).logits, raw(*images(1)).logits
    assert without.min() < 0
    torch.testing.assert_close(with_it, torch.where(without >= 0, without, without * 0.2))


def test_padding_is_the_mean() -> None:
    """60 x 83 equals the top left part of 64 x 96 that is the mean, 1/2, elsewhere."""
    net = nano("mfnet").eval()
    rgb, thermal = images(1, 60, 83)
    padded = (F.pad(image, (0, 13, 0, 4), value=0.5) for image in (rgb, thermal))
    torch.testing.assert_close(net(rgb, thermal).logits, net(*padded).logits[..., :60, :83])


def test_three_thermal_channels() -> None:
    net = nano("mfnet", inputs=half(3))
    assert net.get_submodule("conv1_inf").conv.weight.shape == (3, 3, 3, 3)
    assert net(*images(1)).logits.shape == (1, 3, 64, 96)
    assert (net.record.views, net.record.pretrained_parts) == (("rgbt",), ())
