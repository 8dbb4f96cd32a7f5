"""Weights from a file as the start of a network, and whether the network is fed as they were."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from torch import nn

from rgbt.checkpoints.load import load_weights
from rgbt.checkpoints.report import Report
from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.config.stored_config import read_settings
from rgbt.spec.run_key import weights_file
from rgbt.tracking.terminal import tell


def start(model: nn.Module, config: DictConfig) -> Report | None:
    """Set what `model.weights` names and say so in a line on stderr; None where it names nothing.

    A second line follows where the network is fed or evaluated in another way than the file's.

    Raises:
        InputError: the file does not fit, or `model.fresh` without a file.
    """
    source, fresh = weights_file(config), tuple(config.model.get("fresh", ()))
    if source is None:
        if fresh:
            raise InputError(
                f"model.fresh=[{','.join(fresh)}] keeps parts of a network whose weights come from "
                "a file; name that with model.weights=..., or omit model.fresh."
            )
        return None
    report = load_weights(model, source, fresh)
    tell(report.sentence())
    others = differences(config.model, report.facts.convention)
    if not others and _fed_otherwise(config.model, report, source):
        others = ["the inputs noted beside it"]
    if others:
        tell(
            f"{source} goes with {' '.join(others)}, this network with something else: its scores "
            "are not those that the weights were trained for."
        )
    return report


def differences(node: DictConfig, convention: Iterable[str]) -> list[str]:
    """Which of these overrides of a network would change it.

    Args:
        node: `model` of a configuration.
        convention: overrides such as "model/inputs=unit" and "model.final_relu=true".
    """
    return [override for override in convention if not _holds(node, override)]


def _holds(node: DictConfig, override: str) -> bool:
    key, _, text = override.partition("=")
    if key == "model/inputs":
        return bool(_plain(node.inputs) == _plain(compose([override]).model.inputs))
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        value = text
    found: Any = node.get(key.removeprefix("model."), value)
    return bool(found == value)


def _fed_otherwise(node: DictConfig, report: Report, source: Path) -> bool:
    """Whether a file of ours says of itself, or its run beside it, that it was fed otherwise."""
    said: Any = report.facts.inputs
    beside = source.parent / "config.yaml"
    if said is None and report.facts.layout == "own" and beside.is_file():
        said = read_settings(beside).get("model", {}).get("inputs")
    return said is not None and "inputs" in node and _plain(said) != _plain(node.inputs)


def _plain(inputs: Any) -> Any:
    plain = OmegaConf.to_container(inputs, resolve=True) if OmegaConf.is_config(inputs) else inputs
    if not isinstance(plain, Mapping):
        return plain
    # As in JSON: 0 and 0.0 are one number.
    return {
        key: [float(each) for each in value] if isinstance(value, list) else value
        for key, value in plain.items()
    }
