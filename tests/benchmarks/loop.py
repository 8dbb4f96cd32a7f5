"""The training loop on the objects of a run, without what a run writes around its steps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from rgbt.assembly.training_setup import TrainingSetup
from rgbt.engine.trainer import Hooks, Trainer


def trainer_of(
    setup: TrainingSetup, folder: Path, hooks: Hooks | None = None, **changes: Any
) -> Trainer:
    """Make the loop of a run; `changes` are of the settings of its trainer."""
    return Trainer(
        fabric=setup.fabric,
        settings=replace(setup.session.trainer, **changes),
        phases=setup.scheme.phases,
        model=setup.model,
        others=setup.others,
        optimizers=setup.optimizers,
        schedule=setup.schedule,
        steps_per_epoch=1000,
        folder=folder,
        hooks=Hooks() if hooks is None else hooks,
    )
