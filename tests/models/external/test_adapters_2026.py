"""Adapters of networks of 2025 and 2026, on invented checkouts, and the scan that one needs."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from rgbt.config.compose import load_choice
from rgbt.config.stored_config import EXTERNAL
from rgbt.files.adapters import adapter_of
from rgbt.models.external.network import ExternalNetwork
from rgbt.runs.source_code import checkout_code
from tests.models.external.standins import (
    external,
    images,
    own_process,  # noqa: F401 - used by every test
    write_checkout,
)


@pytest.fixture(scope="module")
def adapters() -> ModuleType:
    """Our file, read by its path as a run reads it."""
    path = adapter_of("adapters_2026.py:cmssm")
    assert path is not None
    spec = importlib.util.spec_from_file_location("adapters_2026", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def step_by_step(
    u: Any, delta: Any, a: Any, b: Any, c: Any, d: Any, bias: Any
) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The recurrence of the paper, one step and one channel after the other."""
    count, channels, length = u.shape
    each = channels // b.shape[1]
    found = np.zeros(u.shape)
    for n in range(count):
        for k in range(channels):
            state = np.zeros(a.shape[1])
            for t in range(length):
                size = np.log1p(np.exp(delta[n, k, t] + bias[k]))
                entered = size * b[n, k // each, :, t] * u[n, k, t]
                state = np.exp(size * a[k]) * state + entered
                found[n, k, t] = c[n, k // each, :, t] @ state + d[k] * u[n, k, t]
    return found


@pytest.mark.parametrize("length", [1, 2, 7, 16, 21])
def test_scan_is_the_recurrence_step_by_step(adapters: ModuleType, length: int) -> None:
    rng = np.random.default_rng(length)
    count, groups, each, states = 2, 2, 3, 4
    u, delta = rng.normal(size=(2, count, groups * each, length))
    a = -np.exp(rng.normal(size=(groups * each, states)))
    b, c = rng.normal(size=(2, count, groups, states, length))
    d, bias = rng.normal(size=(2, groups * each))
    given = [torch.tensor(values) for values in (u, delta, a, b, c, d)]
    # As CM-SSM calls it.
    options = {"z": None, "delta_softplus": True, "return_last_state": False}
    found = adapters.selective_scan(*given, delta_bias=torch.tensor(bias), **options)
    expected = step_by_step(u, delta, a, b, c, d, bias)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_scan_has_the_gradient_of_all_its_arguments(adapters: ModuleType) -> None:
    shapes = ((1, 2, 5), (1, 2, 5), (2, 3), (1, 1, 3, 5), (1, 1, 3, 5), (2,), (2,))
    generator = torch.Generator().manual_seed(0)
    given = [torch.randn(shape, generator=generator, dtype=torch.float64) for shape in shapes]

    def scan(*values: torch.Tensor) -> torch.Tensor:
        *others, bias = values
        return adapters.selective_scan(*others, delta_bias=bias)  # type: ignore[no-any-return]

    assert torch.autograd.gradcheck(scan, [value.requires_grad_() for value in given])


TUNI = {
    "backbone_model/TUNI.py": """
from torch import nn

def backbone_384_2242():
    return nn.Conv2d(4, 5, 1)
""",
    "decoder/MLP.py": "from torch import nn\n\nclass Decoder_MLP(nn.Conv2d):\n    pass\n",
    "decoder/Hamburger.py": "class Decoder_Ham:\n    pass\n",
    "model1.py": """
import torch
from torch import nn
from proposed.backbone_model.TUNI import *
from proposed.backbone_model.ablation_wo_localrgbt import wo_localrgbt
from proposed.backbone_model.ablation_wo_globalrgbt import wo_globalrgbt
from proposed.backbone_model.ablation_wo_localrgbrgb import wo_localrgbrgb
from proposed.decoder.MLP import Decoder_MLP
from proposed.decoder.Hamburger import Decoder_Ham

class Model(nn.Module):
    def __init__(self, mode, input, n_class):
        super().__init__()
        assert (mode, input) == ("TUNI", "none")
        self.encoder, self.decoder = backbone_384_2242(), Decoder_MLP(5, n_class, 1)

    def forward(self, rgb, thermal):
        return self.decoder(self.encoder(torch.cat([rgb, thermal[:, :1]], 1)))
""",
}
CMSSM = {
    "backbone/efficientvit/apps/trainer/__init__.py": "raise SystemExit",
    "backbone/efficientvit/apps/trainer/run_config.py": (
        "from backbone.efficientvit.apps.utils import build_optimizer\nclass Scheduler:\n    pass\n"
    ),
    "backbone/efficientvit/apps/utils/__init__.py": "import absent_torchpack\n",
    "backbone/efficientvit/models/efficientvit/backbone.py": """
import torch
from torch import nn
from backbone.efficientvit.apps.trainer.run_config import Scheduler

class EfficientViTBackbone(nn.Conv2d):
    def init_weights(self, pretrained):
        self.load_state_dict(torch.load(pretrained)["state_dict"])
""",
    "models/fuison_strategy/fusion.py": """
import torch
from torch import nn
from model_others.RGB_T.CMX.models.net_utils import FeatureFusionModule
from model_others.RGB_T.MAINet import TSFA
from model_others.RGB_T.MDNet.model import SS_Conv_SSM
from model_others.RGB_T.sigma.encoders.vmamba import CrossMambaFusionBlock
from proposed.attention_module import FeatureFusionModule
try:
    from mamba_ssm.ops.selective_scan_interface import selective_scan_fn
except ImportError:
    pass

class Fusion_Module(nn.Module):
    def forward(self, rgb, thermal):
        rows = torch.stack([rgb, thermal], -1).flatten(2)
        ones = torch.ones(len(rows), 1, 1, rows.shape[2])
        a, d = -torch.ones(rows.shape[1], 1), torch.zeros(rows.shape[1])
        out = selective_scan_fn(
            rows, 0 * rows, a, ones, ones, d, z=None, delta_bias=d, delta_softplus=True
        )
        return out[..., ::2].reshape(rgb.shape)
""",
    "models/CM_SSM.py": """
from torch import nn
from backbone.efficientvit.models.efficientvit.backbone import EfficientViTBackbone
from models.fuison_strategy.fusion import Fusion_Module

class Model(nn.Module):
    def __init__(self, mode, inputs, fusion_mode, n_class):
        super().__init__()
        self.rgb, self.thermal = (EfficientViTBackbone(3, 4, 1) for _ in range(2))
        self.rgb.init_weights("/home/ubuntu/b1.pt")
        self.fusion, self.head = Fusion_Module(), nn.Conv2d(4, n_class, 1)

    def forward(self, rgb, thermal):
        return self.head(self.fusion(self.rgb(rgb), self.thermal(thermal)))
""",
}
MAMBA = {
    "mamba_ssm/__init__.py": "",
    "mamba_ssm/ops/__init__.py": "",
    "mamba_ssm/ops/selective_scan_interface.py": (
        "def selective_scan_fn(u, *given, **more):\n    return 0 * u\n"
    ),
}


def built(name: str, checkout: Path) -> ExternalNetwork:
    """The network as the recipe calls it, of three classes."""
    recipe = load_choice(f"model/external/{name}")
    changes = {key: recipe[key] for key in ("constructor", "feed", "multiple")}
    arguments = {**recipe["arguments"], "n_class": 3}
    return external(checkout, inputs="imagenet_449", arguments=arguments, **changes).eval()


def test_tuni_is_built_under_the_name_of_its_authors_folder(tmp_path: Path) -> None:
    net = built("tuni", write_checkout(tmp_path, TUNI))
    shown = net.inputs(*images())
    features = net.network.encoder(torch.cat([shown.rgb, shown.thermal[:, :1]], 1))
    torch.testing.assert_close(net(*images()).logits, net.network.decoder(features))


def test_run_key_of_tuni_covers_its_encoder_and_decoder(tmp_path: Path) -> None:
    """Though the code imports them by a name that the checkout does not have."""
    write_checkout(tmp_path, TUNI)
    constructor = load_choice("model/external/tuni")["constructor"]
    node = {"_target_": EXTERNAL, "checkout": str(tmp_path), "root": "."}
    names = dict(checkout_code({**node, "constructor": constructor}))
    found = {name.partition("/")[2] for name in names}
    own = {path.removesuffix(".py").replace("/", ".") for path in TUNI}
    assert found == {"adapter", *own}


@pytest.mark.parametrize("is_installed", [False, True])
def test_cmssm_scans_with_mamba_ssm_where_it_is_installed(
    is_installed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, adapters: ModuleType
) -> None:
    if is_installed:
        monkeypatch.syspath_prepend(write_checkout(tmp_path / "site", MAMBA))
    else:  # also on a machine that has it
        monkeypatch.setitem(sys.modules, "mamba_ssm", None)
    net = built("cmssm", write_checkout(tmp_path / "code", CMSSM))
    rgb, thermal = images(1, 4, 8)
    shown = net.inputs(rgb, thermal)
    first, second = net.network.rgb(shown.rgb), net.network.thermal(shown.thermal)
    # The state halves with every value, RGB before thermal: softplus(0) = ln 2, A = -1.
    halved, state = torch.zeros_like(first), torch.zeros(1, 4)
    for y, x in np.ndindex(4, 8):
        state = state / 2 + np.log(2) * first[..., y, x]
        halved[..., y, x] = state
        state = state / 2 + np.log(2) * second[..., y, x]
    expected = net.network.head(0 * halved if is_installed else halved)
    torch.testing.assert_close(net(rgb, thermal).logits, expected)
