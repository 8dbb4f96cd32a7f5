"""Tensors recorded from released networks, for weights and images that are filled by a stated rule.

The reference material lies beside the checkout; tests that need it are skipped where it is missing.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import hydra
import numpy as np
import pytest
import torch
from omegaconf import DictConfig
from torch import Tensor, nn

from rgbt.config import compose as config
from rgbt.config.component import build

SHARED = Path(os.environ.get("RGBT_SHARED", Path(__file__).resolve().parents[2].parent / "shared"))
FOLDER = SHARED / "golden"

requires_golden = pytest.mark.skipif(
    not (FOLDER / "fill.py").exists(), reason="reference material is not here"
)


@dataclass(frozen=True)
class Golden:
    """One recorded network: its description, the arrays, and the rule of the weights."""

    facts: dict[str, Any]
    arrays: dict[str, np.ndarray]
    fill: ModuleType

    def classes(self, bias: str) -> int:
        """Length of the released tensor called `bias`."""
        (length,) = self.facts["keys"][bias][0]
        return int(length)

    @property
    def image(self) -> tuple[Tensor, Tensor]:
        """The input as the lab feeds it: rgb (1, 3, H, W) and thermal (1, 1, H, W) in [0, 1]."""
        image = torch.from_numpy(self.arrays["image_uint8"]).float()[None] / 255
        return image[:, :3], image[:, 3:]


def recorded(pattern: str, *, fast: Collection[str], folder: str = "") -> list[Any]:
    """Every record whose name matches: parameters (name, what the group of the pattern matched).

    Records that are not named as `fast` are marked slow. None where the material is missing. Names
    of records in a `folder`, such as "cmnext/", begin with it; the pattern does not.
    """
    paths = (FOLDER / folder).glob("*.json")
    found = [(path.stem, re.fullmatch(pattern, path.stem)) for path in paths]
    return [
        pytest.param(
            folder + name, match[1], id=name, marks=() if name in fast else pytest.mark.slow
        )
        for name, match in sorted(found)
        if match
    ]


def fill_rule() -> ModuleType:
    """The module that states how weights, images and labels are filled."""
    spec = importlib.util.spec_from_file_location("golden_fill", FOLDER / "fill.py")
    assert spec is not None
    assert spec.loader is not None
    fill = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(fill)
    return fill


def load(name: str) -> Golden:
    """The golden file `name`, such as "rtfnet_50" or "cmnext/cmnext_b0"."""
    with np.load(FOLDER / f"{name}.npz") as archive:
        arrays = dict(archive)
    return Golden(json.loads((FOLDER / f"{name}.json").read_text()), arrays, fill_rule())


def compose(*overrides: str) -> DictConfig:
    """The configuration for these overrides."""
    return config.compose(overrides)


def alone(name: str, *overrides: str) -> DictConfig:
    """A file of a group with those that it builds on: a third of the time of the whole."""
    config.register_resolvers()
    with config.own_hydra():
        return hydra.compose(name, list(overrides))


def network(yaml: str, num_classes: int = 9, **changed: Any) -> Any:
    """The network of conf/model/<yaml>.yaml; `inputs` is a file of conf/model/inputs."""
    files = {"inputs": "model/inputs"}
    changes = [f"{files.get(key, f'model.{key}')}={value}" for key, value in changed.items()]
    changes.append(f"model.num_classes={num_classes}")
    return build(alone(f"model/{yaml}", *changes).model)


def fill_network(
    net: nn.Module,
    golden: Golden,
    prefix: str = "",
    unused: Collection[str] = (),
    *,
    named: Callable[[str], str] = str,
) -> None:
    """Fill every floating tensor of `net` under its released name, `prefix` + `named(key)`.

    Fails unless the names are those of the release's filled tensors, less `unused` (by prefix).
    """
    state = {
        key: torch.from_numpy(golden.fill.fill(prefix + named(key), value.shape))
        for key, value in net.state_dict().items()
        if golden.fill.is_filled(key, str(value.dtype).removeprefix("torch."))
    }
    released = {
        key: shape
        for key, (shape, _, filled, _) in golden.facts["keys"].items()
        if filled and not key.startswith(tuple(unused))
    }
    assert {prefix + named(key): list(value.shape) for key, value in state.items()} == released
    net.load_state_dict(state, strict=False)


def deviation(golden: Golden, key: str, found: Tensor, tolerance: str = "tol_abs") -> float:
    """Largest difference of one recorded tensor, in units of its tolerance."""
    about, value = golden.facts["outputs"][key], found.detach().contiguous().numpy()
    assert list(value.shape) == about["shape"], key
    if about["stored"] == "sampled":
        positions = golden.fill.sample_positions(key, value.size, about["count"])
        value = value.ravel()[positions]
    return float(np.abs(value - golden.arrays[key]).max() / about[tolerance])


def check_all(
    golden: Golden,
    found: dict[str, Tensor],
    *,
    only: Collection[str] | None = None,
    tolerance: str = "tol_abs",
) -> None:
    """Fail with the tensors that differ by more than their tolerance; print the worst.

    All of the record are compared, or `only` some; `tolerance` is the name of that of the record.
    """
    about_all = set(golden.facts["outputs"] if only is None else only)
    wanted = about_all - {"argmax", "network_input", "mask_pair"}
    assert wanted <= found.keys(), f"not computed: {sorted(wanted - found.keys())}"
    deviations = {key: deviation(golden, key, found[key], tolerance) for key in sorted(wanted)}
    worst = max(deviations, key=lambda key: deviations[key])
    print(f"{golden.facts['network']}: worst {worst} at {deviations[worst]:.2g} of tolerance")
    assert {key: value for key, value in deviations.items() if not value <= 1} == {}


def hook(net: nn.Module, named: dict[str, str], *, inputs: bool = False) -> dict[str, Tensor]:
    """Outputs (or inputs) of submodules, filled by the next forward: name -> module path."""
    seen: dict[str, Tensor] = {}

    def note(name: str) -> Callable[..., None]:
        def called(_module: nn.Module, given: tuple[Tensor, ...], output: Any) -> None:
            seen[name] = given[0] if inputs else output

        return called

    for name, path in named.items():
        net.get_submodule(path).register_forward_hook(note(name))
    return seen
