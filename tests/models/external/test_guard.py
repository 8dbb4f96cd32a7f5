"""Constructors neither download nor read weights, and what was replaced is put back."""

from __future__ import annotations

import socket
import sys
from pathlib import Path

import pytest
import torch
from torch import nn

from rgbt.checks import InputError
from rgbt.models.external.guard import NoWeights, without_weights
from tests.models.external.standins import STACKED, external, images, write_checkout

LOADS = """
        import torch.hub, torch.utils.model_zoo
        bound("https://nowhere.invalid/a.pth")
        self.conv.load_state_dict(torch.utils.model_zoo.load_url("https://nowhere.invalid/b.pth"))
        found = torch.load("D:/weights/mit_b3.pth")
        found["state_dict"].pop("head.weight")
        self.load_state_dict({k: v for k, v in found["model"].items() if k in self.state_dict()})
        own = self.state_dict()
        own["conv.weight"] = torch.zeros_like(own["conv.weight"])
        self.load_state_dict(own)
"""


def replaced() -> tuple[object, ...]:
    return (
        *(torch.load, torch.serialization.load, torch.hub.load_state_dict_from_url),
        *(nn.Module.load_state_dict, socket.getaddrinfo, socket.socket.connect),
        *(torch.Tensor.cuda, nn.Module.cuda),
    )


def test_constructors_that_load_get_nothing(tmp_path: Path) -> None:
    code = "from torch.hub import load_state_dict_from_url as bound\n" + STACKED.replace(
        "self.conv = nn.Conv2d(channels, n_class, 1)\n",
        f"self.conv = nn.Conv2d(channels, n_class, 1)\n{LOADS}",
    )
    before = replaced()
    net = external(write_checkout(tmp_path, {"model/net.py": code}))
    assert replaced() == before
    assert "connect" not in vars(socket.socket)
    # Tensors that the constructor has itself are loaded as ever.
    assert not net.network.conv.weight.any()
    bias = net.eval()(*images()).logits[0, :, 0, 0]
    torch.testing.assert_close(bias, net.network.conv.bias)


def test_constructors_that_download_otherwise_are_refused(tmp_path: Path) -> None:
    code = STACKED.replace(
        "super().__init__()",
        "super().__init__()\n        import urllib.request\n"
        "        urllib.request.urlopen('http://nowhere.invalid/weights.pth')",
    )
    before = replaced()
    with pytest.raises(InputError, match="tries to download from nowhere.invalid") as info:
        external(write_checkout(tmp_path, {"model/net.py": code}))
    assert "(model/net.py, line" in str(info.value)
    assert replaced() == before


def test_functions_that_a_module_bound_inside_are_put_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "binds_inside.py").write_text("from torch import load\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    load = torch.load
    with without_weights():
        import binds_inside  # type: ignore[import-not-found]

        assert binds_inside.load is not load
        assert isinstance(torch.load("no such file"), NoWeights)
    assert binds_inside.load is load is torch.load
    del sys.modules["binds_inside"]


def test_no_weights_answers_every_key() -> None:
    nothing = NoWeights()
    assert nothing["a"]["b"] == {} == nothing.get("a") == nothing.pop("x") == nothing.state_dict()
    assert "a" not in nothing
    assert not dict(nothing)
