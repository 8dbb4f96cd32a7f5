"""Upstream runs: which runs a configuration names, and their configurations.

A run names them by their experiment: ``model.weights=experiment:NAME/last.pt`` starts from the end
of that run (the stage before, or another task), ``domains.target.labels=experiment:NAME/best.pt``
learns from what its network predicts. Both runs share seed, scale and data set
(`rgbt.spec.run_spec.SHARED`), so that a run of seed 2 depends on runs of seed 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, cast, get_args

from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError, nearest
from rgbt.config.component import RUN_SETTINGS
from rgbt.config.compose import available, compose, own_folders
from rgbt.config.hydra_messages import own_folder_hint
from rgbt.spec.run_spec import SHARED, WEIGHTS, CheckpointFile

PREFIX = "experiment:"


def parse_reference(key: str, value: str | None) -> tuple[str, CheckpointFile] | None:
    """Experiment and checkpoint that "experiment:NAME/last.pt" names; None for any other value.

    Raises:
        InputError: the reference is not of this form, or there is no such experiment.
    """
    if value is None or not value.startswith(PREFIX):
        return None
    name, _, checkpoint = value.removeprefix(PREFIX).rpartition("/")
    if checkpoint not in get_args(CheckpointFile):
        raise InputError(
            f"{key}={value}: expected experiment:NAME/best.pt or experiment:NAME/last.pt."
        )
    known = available("experiment")
    if name not in known:
        raise InputError(
            f"{key}={value}: there is no experiment '{name}'; {nearest(name, known)}. A run can be "
            f"named by its folder too: runs/<key>/{checkpoint}.{own_folder_hint()}"
        )
    return name, cast(CheckpointFile, checkpoint)


def upstream_config(config: DictConfig, key: str, experiment: str) -> DictConfig:
    """The configuration of an upstream run: its experiment, with what both runs share.

    Shared (`SHARED`) are seed, scale, data set and how it is loaded, durations that were typed,
    device, regions, tracking, and the folder of runs; for weights also the network. Everything else
    is the experiment's own.
    """
    upstream = _composed(experiment, config.scale.name, own_folders()).copy()
    # Its experiment says whether a network has pretrained weights, the scale says all else.
    shared = [*SHARED, *(f"scale.{each}" for each in config.scale if each != "pretrained")]
    if key == WEIGHTS:
        own = RUN_SETTINGS["model"]
        shared += [f"model.{each}" for each in config.model if each not in own]
        upstream.model = {each: upstream.model._get_node(each) for each in own}
    for each in shared:
        *parents, last = each.split(".")
        mine: Any = OmegaConf.select(config, ".".join(parents)) if parents else config
        node = mine._get_node(last)
        value = OmegaConf.to_container(node) if OmegaConf.is_config(node) else node._value()
        OmegaConf.update(upstream, each, value, merge=False, force_add=True)
    return upstream


@cache
def _composed(experiment: str, scale: str, _own: str) -> DictConfig:
    """Cached, because composing takes long and the seeds of a table share their upstream runs."""
    return compose([f"+experiment={experiment}", f"scale={scale}"])


def shared_overrides(overrides: Sequence[str], key: str) -> list[str]:
    """Those of the typed overrides that the upstream run of the setting `key` takes over."""
    groups = ("scale", "dataset", "metric", *(("model",) if key == WEIGHTS else ()))
    own = (WEIGHTS, "model.fresh", "seed", "runs_dir")
    typed = [(word, word.partition("=")[0].lstrip("+").rpartition("@")[2]) for word in overrides]
    return [
        word
        for word, path in typed
        if path not in own
        and (
            path in SHARED
            or path.replace("/", ".").split(".")[0] in groups
            or path.startswith("data.")
        )
    ]
