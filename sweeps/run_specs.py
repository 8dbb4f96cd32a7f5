"""Specifications of runs, composed from overrides, and what sweeps take from them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from rgbt.checks import InputError
from rgbt.config.command import composing
from rgbt.config.component import Component, build
from rgbt.config.compose import compose
from rgbt.spec.run_spec import RunSpec
from rgbt.spec.specify import specify
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


def specify_run(overrides: Sequence[str]) -> RunSpec:
    """The specification of one run.

    Raises:
        InputError: Hydra or a component refuses an override, in the words of the command line.
    """
    with composing(overrides):
        return specify(compose(overrides), overrides)


def plan_run(overrides: tuple[str, ...], fingerprints: dict[str, str]) -> PlannedRun:
    """Specify one run and read its data set.

    Args:
        overrides: of `python -m rgbt.run`.
        fingerprints: of data sets by their settings; a new one is added.

    Raises:
        InputError: a configuration or a data set that does not fit, in one sentence.
    """
    spec = specify_run(overrides)
    views = spec.consistency.values
    key = spec.key
    dataset = json.dumps(spec.dataset.plain, sort_keys=True)
    if dataset not in fingerprints:
        fingerprints[dataset] = _fingerprint(spec.dataset)
    return PlannedRun(
        key=key,
        dataset=fingerprints[dataset],
        overrides=overrides,
        steps=spec.trainer.max_steps,
        pixel_factor=spec.scale.pixel_factor,
        consistency_splits=tuple(views["splits"]) if views["sets"] else (),
    )


def _fingerprint(component: Component) -> str:
    dataset: Any = component.build()
    if not any(dataset.has(split) for split in dataset.splits):
        paths = ", ".join(dict.fromkeys(dataset.splits.values()))
        raise InputError(
            f"{dataset.root} holds none of the lists or files {paths} of the data set; "
            "name its folder with dataset.root=..."
        )
    return str(dataset.fingerprint())


def open_run_store(config: DictConfig) -> RunStore:
    """Finished runs in the folder of runs and in the tracker of a composed configuration."""
    runs_dir = Path(config.runs_dir).expanduser().resolve()
    return RunStore(runs_dir, build(config.tracking), fresh=config.fresh)


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

    with composing(overrides), torch.device("meta"):
        network = build(compose(overrides).model)
    count: int = sum(parameter.numel() for parameter in network.parameters())
    return count / 1e6
