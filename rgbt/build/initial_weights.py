"""Start a network from a file of weights; warn if it has other inputs than the weights."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from omegaconf import OmegaConf
from torch import nn

from rgbt.checkpoints.load import load_weights
from rgbt.checkpoints.report import Report
from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.config.stored_config import read_settings
from rgbt.requirements import Record
from rgbt.spec.run_spec import WEIGHTS, RunSpec
from rgbt.tracking.terminal import info


@dataclass(frozen=True)
class InitialWeights:
    """`model.weights` as a component whose record others can require; `named` is its value."""

    named: str | None

    @property
    def record(self) -> Record:
        """Whether weights are named."""
        return Record(pretrained=self.named is not None)


def start_from_weights(model: nn.Module, spec: RunSpec) -> Report | None:
    """Load the weights that `model.weights` names and report this on stderr; None without weights.

    A second line warns if the network has other inputs or settings than the weights were trained
    with.

    Raises:
        InputError: the file does not fit, or `model.fresh` without a file.
    """
    source, fresh = spec.weights_path, spec.fresh_parts
    if source is None:
        if fresh:
            raise InputError(
                f"model.fresh=[{','.join(fresh)}] has no effect without a file of weights. Name "
                "the file with model.weights=..., or omit model.fresh."
            )
        return None
    dependency = spec.dependency(WEIGHTS)
    is_common = dependency is not None and dependency.is_common
    report = load_weights(model, source, fresh, other_classes=is_common)
    info(report.sentence())
    node = spec.model.plain
    others = differences(node, report.facts.convention)
    # A file of this project, or the run beside it, notes its inputs.
    noted: Any = report.facts.inputs
    beside = source.parent / "config.yaml"
    if not others and noted is None and report.facts.layout == "own" and beside.is_file():
        noted = read_settings(beside).get("model", {}).get("inputs")
    if not others and None not in (noted, node.get("inputs")):
        is_same = _plain(noted) == _plain(node["inputs"])
        others = [] if is_same else ["the inputs noted beside it"]
    if others:
        info(
            f"{source} was trained with {' '.join(others)}, but this network has other settings: "
            "its scores will differ from those of the trained network."
        )
    return report


def differences(node: Mapping[str, Any], convention: Iterable[str]) -> list[str]:
    """Which of these overrides of a network would change it.

    Args:
        node: `model` of a configuration.
        convention: overrides such as "model/inputs=unit" and "model.final_relu=true".
    """
    return [override for override in convention if not _holds(node, override)]


def _holds(node: Mapping[str, Any], override: str) -> bool:
    key, _, text = override.partition("=")
    if key == "model/inputs":
        return bool(_plain(node["inputs"]) == _plain(compose([override]).model.inputs))
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        value = text
    found: Any = node.get(key.removeprefix("model."), value)
    return bool(found == value)


def _plain(inputs: Any) -> Any:
    plain = OmegaConf.to_container(inputs, resolve=True) if OmegaConf.is_config(inputs) else inputs
    if not isinstance(plain, Mapping):
        return plain
    # As in JSON: 0 and 0.0 are one number.
    return {
        key: [float(each) for each in value] if isinstance(value, list) else value
        for key, value in plain.items()
    }
