"""Networks of few channels, and a second, plain computation from their weights to compare with."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.cmnext import CMNeXt
from rgbt.models.cmx.model import CMX
from rgbt.models.critic import Critic
from rgbt.models.deeplabv2 import DeepLabV2
from rgbt.models.dinov2.model import DinoMask2Former
from rgbt.models.efficientnet_lite import LiteCMX, LiteMask2Former
from rgbt.models.inputs import Inputs
from rgbt.models.mask2former.model import Mask2Former
from rgbt.models.mfnet import MFNet
from rgbt.models.pspnet import PSPNet
from rgbt.models.rtfnet import RTFNet
from rgbt.models.semseg import SemsegPSPNet
from rgbt.types import MaskPair

HEAD = {"hidden_dim": 32, "num_queries": 5, "encoder_layers": 1, "encoder_ffn_dim": 16,
        "decoder_layers": 3, "decoder_ffn_dim": 16, "attention_heads": 2,
        "pixel_decoder_fp32": True}  # fmt: skip
NANO: dict[str, tuple[Any, dict[str, Any]]] = {
    "mfnet": (MFNet, {"num_classes": 3, "rgb_widths": (2, 3, 4, 6), "thermal_widths": (3, 2, 3, 4),
                      "decoder_width": 5, "final_activation": True}),
    "rtfnet": (RTFNet, {"num_classes": 4, "depth": 18, "base_width": 4, "final_relu": False,
                        "thermal_stem": "rgb_mean"}),
    "pspnet": (PSPNet, {"num_classes": 4, "depths": (1, 2, 3, 2), "base_width": 4,
                        "decoder_width": 5, "modalities": "late_fusion", "dropout": (0.3, 0.15),
                        "align_corners": False}),
    "semseg": (SemsegPSPNet, {"num_classes": 3, "depths": (1, 2, 2, 2), "base_width": 4,
                              "modalities": "rgb", "dropout": 0.0}),
    "deeplabv2": (DeepLabV2, {"num_classes": 3, "depths": (1, 2, 2, 2), "base_width": 2,
                              "ceil_mode": True, "train_norm": "all", "heads": ("source", "target"),
                              "auxiliary": True, "decoder": "basic", "rates": (2, 4, 6, 8),
                              "summed_rates": (2, 4, 6, 8), "dropout": (0.0, 0.0),
                              "align_corners": True}),
    "cmx": (CMX, {"num_classes": 4, "embed_dims": (8, 8, 12, 16), "depths": (1, 2, 1, 1),
                  "num_heads": (1, 2, 3, 4), "sr_ratios": (8, 4, 2, 1), "mlp_ratio": 2.0,
                  "decoder_dim": 16, "drop_path_rate": 0.0, "drop_path_stage2": "ramp",
                  "decoder_dropout": 0.0, "decoder_norm_eps": 1e-3,
                  "decoder_norm_eps_eval": None}),
    "cmnext": (CMNeXt, {"num_classes": 4, "embed_dims": (8, 8, 12, 16), "depths": (1, 2, 1, 1),
                        "num_heads": (1, 2, 3, 4), "sr_ratios": (8, 4, 2, 1), "mlp_ratio": 2.0,
                        "thermal_mlp_ratios": (3.0, 3.0, 2.0, 2.0), "pool_windows": (3, 7, 11),
                        "layer_scale": 0.01, "decoder_dim": 16, "drop_path_rate": 0.0,
                        "decoder_dropout": 0.0, "decoder_norm_eps": 1e-5}),
    "mask2former": (Mask2Former, {"num_classes": 4, "embed_dim": 8, "depths": (1, 1, 2, 1),
                                  "num_heads": (1, 1, 2, 2), "window_size": 3, "mlp_ratio": 2.0,
                                  "drop_path_rate": 0.0, "share_start": 4, "fusion": "max",
                                  **HEAD}),
    "dinov2": (DinoMask2Former, {"num_classes": 4, "patch": 4, "embed_dim": 8, "depth": 4,
                                 "num_heads": 2, "mlp_ratio": 2.0, "num_registers": 2,
                                 "position_grid": 5, "position_resize": "size", "token_px": 8,
                                 "layers": (4,), "tuning": "full", "lora_rank": 2,
                                 "lora_alpha": 4.0, "lora_parts": ("q", "v"),
                                 "lora_per_modality": True, "thermal_embedding": True,
                                 "fusion": "max", **HEAD}),
    "efficientnet_lite": (LiteMask2Former, {"num_classes": 4, "width": 0.2, "depth": 0.5,
                                            "norm_momentum": 0.1, "frozen_stages": 0,
                                            "fusion": "max", "mask_token": "branch", **HEAD}),
    "lite_cmx": (LiteCMX, {"num_classes": 4, "width": 0.2, "depth": 0.5, "norm_momentum": 0.1,
                           "frozen_stages": 0, "num_heads": (1, 1, 2, 2), "decoder_dim": 8,
                           "decoder_dropout": 0.0}),
    "critic": (Critic, {"in_channels": 2, "base_width": 2, "upsample": False,
                        "align_corners": False}),
}  # fmt: skip

THREE_THERMAL = (
    *("deeplabv2", "cmx", "cmnext", "semseg", "dinov2"),
    *("efficientnet_lite", "lite_cmx"),
)
"""Networks whose thermal input has three channels."""


def nano(name: str, seed: int = 0, **changes: Any) -> Any:
    """A small network whose first weights depend on the seed alone."""
    kind, settings = NANO[name]
    given = {} if name == "critic" else {"inputs": half(3 if name in THREE_THERMAL else 1)}
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return kind(**{**settings, **given, **changes})


def half(thermal_channels: int) -> Inputs:
    """0..1 to -1..1."""
    values = (127.5, 127.5, 127.5)
    return Inputs(
        rgb_order="rgb",
        rgb_mean=values,
        rgb_std=values,
        thermal_scale="fixed",
        thermal_mean=values[:thermal_channels],
        thermal_std=values[:thermal_channels],
    )


def images(count: int, height: int = 64, width: int = 96, seed: int = 0) -> tuple[Tensor, Tensor]:
    g = generator(seed)
    rgb = torch.rand(count, 3, height, width, generator=g)
    return rgb, torch.rand(count, 1, height, width, generator=g)


def cells(count: int, h: int = 2, w: int = 3, seed: int = 1) -> MaskPair:
    """About half of the cells are hidden."""
    g = generator(seed)
    return MaskPair(*(torch.rand(count, h, w, generator=g) < 0.5 for _ in range(2)))


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=generator(seed))


def count(net: nn.Module) -> int:
    return sum(parameter.numel() for parameter in net.parameters())


def randomise(net: nn.Module) -> dict[str, Tensor]:
    """Every weight, bias and statistic drawn, so that none can be forgotten; the state dict."""
    g = generator(7)
    for name, value in net.state_dict().items():
        drawn = torch.randn(value.shape, generator=g) if value.is_floating_point() else None
        if drawn is None:
            continue
        if value.dim() > 1:
            drawn = drawn / math.sqrt(value[0].numel())
        elif name.endswith("running_var"):
            drawn = 1 + 0.1 * drawn.abs()
        else:
            drawn = name.endswith("weight") + 0.1 * drawn
        value.copy_(drawn)
    return net.state_dict()


class Plain:
    """Layers of a network in evaluation mode by the names of their weights."""

    def __init__(self, state: dict[str, Tensor]) -> None:
        self.state = state

    def conv(self, name: str, x: Tensor, *, stride: int = 1, dilation: int = 1) -> Tensor:
        """ "Same" padding for odd kernels."""
        weight = self.state[f"{name}.weight"]
        padding = dilation * (weight.shape[-1] // 2)
        bias = self.state.get(f"{name}.bias")
        return F.conv2d(x, weight, bias, stride, padding, dilation)

    def norm(self, name: str, x: Tensor) -> Tensor:
        weight, bias, mean, var = (
            self.state[f"{name}.{part}"].view(-1, 1, 1)
            for part in ("weight", "bias", "running_mean", "running_var")
        )
        return (x - mean) / torch.sqrt(var + 1e-5) * weight + bias

    def normed(self, conv: str, norm: str, x: Tensor, **options: int) -> Tensor:
        return self.norm(norm, self.conv(conv, x, **options))

    def stage(
        self,
        name: str,
        x: Tensor,
        *,
        strides: tuple[int, int] = (1, 1),
        dilations: tuple[int, int] = (1, 1),
    ) -> Tensor:
        """Residual blocks `name`.0, .1, ...

        strides: of the first block's first two convolutions; its shortcut takes both.
        dilations: of the first block's second convolution and of the others'.
        """
        block = 0
        while f"{name}.{block}.conv1.weight" in self.state:
            at = f"{name}.{block}"
            first, second = strides if block == 0 else (1, 1)
            y = self.normed(f"{at}.conv1", f"{at}.bn1", x, stride=first).clamp(min=0)
            given = {"stride": second, "dilation": dilations[min(block, 1)]}
            y = self.normed(f"{at}.conv2", f"{at}.bn2", y, **given)
            if f"{at}.conv3.weight" in self.state:
                y = self.normed(f"{at}.conv3", f"{at}.bn3", y.clamp(min=0))
            if f"{at}.downsample.0.weight" in self.state:
                down = (f"{at}.downsample.0", f"{at}.downsample.1")
                x = self.normed(*down, x, stride=first * second)
            x = (x + y).clamp(min=0)
            block += 1
        return x

    def up(self, name: str, x: Tensor, *, align_corners: bool) -> Tensor:
        """Twice the size, convolution, normalisation, one slope for what is negative."""
        size = (2 * x.shape[2], 2 * x.shape[3])
        x = F.interpolate(x, size=size, mode="bilinear", align_corners=align_corners)
        x = self.normed(f"{name}.conv.0", f"{name}.conv.1", x)
        return torch.where(x > 0, x, self.state[f"{name}.conv.2.weight"] * x)
