"""Small checkouts of invented authors, one for each form of network."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

from rgbt.config.compose import compose
from rgbt.models.external import network
from rgbt.models.external.network import ExternalNetwork
from rgbt.models.inputs import Inputs

HEAD = """
import torch
from torch import nn

class Base(nn.Module):
    def __init__(self, n_class, channels=4):
        super().__init__()
        self.conv = nn.Conv2d(channels, n_class, 1)
"""

STACKED = f"""{HEAD}
class Net(Base):
    def forward(self, x):
        return self.conv(x)
"""

PAIR = f"""{HEAD}
class Net(Base):
    def forward(self, rgb, thermal):
        both = torch.cat([rgb, thermal[:, :1]], 1)
        return self.conv(both), -self.conv(both)
"""


# Where modules of the checkouts here, and what stands in for others, begin.
ROOTS = (
    *("model", "toolbox", "absent"),
    *("model1", "backbone_model", "decoder", "proposed"),
    *("models", "backbone", "model_others", "mamba_ssm"),
)


def forget() -> None:
    """Leave the checkout of this process, as another process would."""
    network._held.clear()
    for name in list(sys.modules):
        if name.split(".")[0] in ROOTS:
            del sys.modules[name]


@pytest.fixture(autouse=True)
def own_process() -> Iterator[None]:
    """A test may use a checkout whatever other tests used."""
    path = list(sys.path)
    forget()
    yield
    forget()
    sys.path[:] = path


def write_checkout(folder: Path, files: Mapping[str, str]) -> Path:
    """A checkout with these files."""
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


def external(checkout: Path, *, inputs: str = "unit", **changes: Any) -> ExternalNetwork:
    """The network of a checkout of three classes, with the defaults of the file."""
    node = compose([f"model/inputs={inputs}", "model=mfnet_tiny"]).model.inputs
    kinds = {key: value for key, value in node.items() if key != "_target_"}
    plain = {
        "num_classes": 3,
        "checkout": str(checkout),
        "root": ".",
        "constructor": "model.net:Net",
        "arguments": {"n_class": 3},
        "namespaces": {},
        "feed": "stacked",
        "multiple": 1,
        "size_hw": None,
        "scores": ((),),
        "train_scores": None,
        "auxiliary": None,
        "resize": False,
        "one_by_one": False,
        "weights_prefix": "",
    }
    return ExternalNetwork(**{**plain, **changes}, inputs=Inputs(**kinds))


def images(count: int = 2, height: int = 8, width: int = 12) -> tuple[torch.Tensor, torch.Tensor]:
    """RGB and thermal of seeded noise."""
    generator = torch.Generator().manual_seed(0)
    both = torch.rand(count, 4, height, width, generator=generator)
    return both[:, :3], both[:, 3:]
