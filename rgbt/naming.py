"""What a run is called: where it is one of many, its name says what differs."""

from __future__ import annotations

from collections.abc import Sequence

from omegaconf import DictConfig

from rgbt.config import flatten
from rgbt.tracking.folder import Description


def describe(config: DictConfig, overrides: Sequence[str]) -> Description:
    """How the run is shown: "grbm sigma_div=2 seed=1", grouped with the same run of other seeds.

    Only what differs from the experiment is named; keys are cut to their last part where that
    says enough.
    """
    silent = ("experiment", "runs_dir", "tracking", "dataset.root", "name", "seed")
    pairs = [item.lstrip("+").partition("=")[::2] for item in overrides]
    changed = [(k, v) for k, v in pairs if k not in silent and not k.startswith("tracking.")]
    ends = [key.rpartition(".")[2] for key, _ in changed]
    clear = [end != "seed" and ends.count(end) == 1 for end in ends]
    shown = [
        f"{end if ok else key}={value}"
        for (key, value), end, ok in zip(changed, ends, clear, strict=True)
    ]
    group = " ".join([config.name, *shown])
    tags = {"rgbt.experiment": config.name, "rgbt.group": group, "rgbt.seed": str(config.seed)}
    params = {
        key: str(value)
        for key, value in flatten(config).items()
        # Paths and passwords of the tracker are no property of the run.
        if not key.endswith("_target_") and not key.startswith("tracking.")
    }
    return Description(f"{group} seed={config.seed}", tags, params)
