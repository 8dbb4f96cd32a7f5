"""What a run is called: where it is one of many, its name says what differs."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence

from omegaconf import DictConfig

from rgbt.checks import InputError
from rgbt.config import flatten
from rgbt.tracking.folder import Description

TAGS = "RGBT_TAGS"
"""Environment variable with more MLflow tags of a run, as JSON; the sweeper names tables in it."""


def describe(config: DictConfig, overrides: Sequence[str]) -> Description:
    """How the run is shown: "grbm sigma_div=2 seed=1", grouped with the same run of other seeds.

    Only what differs from the experiment is named; keys are cut to their last part where that
    says enough.
    """
    silent = (
        "experiment",
        "search",
        "runs_dir",
        "tracking",
        "dataset.root",
        "name",
        "seed",
        "fresh",
    )
    pairs = [item.lstrip("+").partition("=")[::2] for item in overrides]
    # What is measured beside is no part of the run, and neither are its trackers.
    beside = ("tracking.", "consistency")
    places = [(key, value, key.rpartition("@")[2]) for key, value in pairs]
    changed = [(k, v) for k, v, at in places if k not in silent and not at.startswith(beside)]
    ends = [key.rpartition(".")[2] for key, _ in changed]
    clear = [end != "seed" and ends.count(end) == 1 for end in ends]
    shown = [
        f"{end if ok else key}={value}"
        for (key, value), end, ok in zip(changed, ends, clear, strict=True)
    ]
    group = " ".join([config.name, *shown])
    tags = {
        "rgbt.experiment": config.name,
        "rgbt.group": group,
        "rgbt.seed": str(config.seed),
        **_asked_tags(),
    }
    params = {
        key: str(value)
        for key, value in flatten(config).items()
        # Paths and passwords of the tracker are no property of the run.
        if not key.endswith("_target_") and not key.startswith("tracking.") and key != "fresh"
    }
    return Description(f"{group} seed={config.seed}", tags, params)


def _asked_tags() -> dict[str, str]:
    text = os.environ.get(TAGS, "{}")
    try:
        tags = json.loads(text)
        if not isinstance(tags, dict):
            raise TypeError("not a mapping")
    except (json.JSONDecodeError, TypeError) as error:
        raise InputError(
            f'{TAGS}={text}: expected JSON such as {{"ticket": "42"}} ({error}).'
        ) from error
    return {str(name): str(value) for name, value in tags.items()}
