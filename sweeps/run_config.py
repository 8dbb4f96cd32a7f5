"""Composes and checks the configuration of a run; other modules of sweeps do not read its nodes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError
from rgbt.config.command import composing
from rgbt.config.compose import compose
from rgbt.config.schema import build, check, check_node
from rgbt.spec.run_key import run_key
from sweeps.worker.run_store import RunStore


@dataclass(frozen=True)
class PlannedRun:
    """One run of a point.

    Attributes:
        key: config key, which names its folder.
        dataset: fingerprint of its data set.
        overrides: of `python -m rgbt.run`.
        steps: optimizer steps.
        pixel_factor: size of its images relative to the paper's.
        consistency_splits: splits on which it measures its temporal consistency.
    """

    key: str
    dataset: str
    overrides: tuple[str, ...]
    steps: int
    pixel_factor: float = 1.0
    consistency_splits: tuple[str, ...] = ()


def checked_config(overrides: Sequence[str]) -> DictConfig:
    """The checked configuration of one run.

    Raises:
        InputError: Hydra or a component refuses an override, in the words of the command line.
    """
    with composing(overrides):
        config = compose(overrides)
        check(config)
    return config


def open_run_store(config: DictConfig) -> RunStore:
    """Finished runs in the folder of runs and in the tracker of a configuration."""
    runs_dir = Path(config.runs_dir).expanduser().resolve()
    return RunStore(runs_dir, build(config.tracking), fresh=config.fresh)


def planned_run(overrides: tuple[str, ...], fingerprints: dict[str, str]) -> PlannedRun:
    """Compose and check one run.

    Args:
        overrides: of `python -m rgbt.run`.
        fingerprints: of data sets by their settings; a new one is added.

    Raises:
        InputError: a configuration or a data set that does not fit, in one sentence.
    """
    config = checked_config(overrides)
    dataset = json.dumps(OmegaConf.to_container(config.dataset, resolve=True), sort_keys=True)
    key = run_key(config)
    node = config.consistency
    if dataset not in fingerprints:
        fingerprints[dataset] = _fingerprint(build(config.dataset))
    return PlannedRun(
        key=key,
        dataset=fingerprints[dataset],
        overrides=overrides,
        steps=int(config.trainer.max_steps),
        pixel_factor=float(config.scale.pixel_factor),
        consistency_splits=tuple(node.splits) if node.sets else (),
    )


def _fingerprint(dataset: Any) -> str:
    if not any(dataset.has(split) for split in dataset.splits):
        paths = ", ".join(dict.fromkeys(dataset.splits.values()))
        raise InputError(
            f"{dataset.root} holds none of the lists or files {paths} of the data set; "
            "name its folder with dataset.root=..."
        )
    return str(dataset.fingerprint())


def million_parameters(overrides: Sequence[str]) -> float:
    """Millions of parameters of the network that overrides of `python -m rgbt.run` describe.

    Only the node `model` is built, on torch's device "meta": no data set is read, its `root` may be
    missing, and no memory is used. Discriminators belong to the scheme and are not counted; frozen
    parameters are.

    Args:
        overrides: with ``scale=paper`` for a published size.

    Raises:
        InputError: overrides that Hydra or the network's constructor refuses.
    """
    import torch

    with composing(overrides):
        node = compose(overrides).model
        check_node(node, "model")
        with torch.device("meta"):
            network = build(node)
    count: int = sum(parameter.numel() for parameter in network.parameters())
    return count / 1e6
