"""The Hydra plugin of `sweeps`: ``hydra/sweeper=study``.

Hydra looks for sweepers only in modules below ``hydra_plugins`` and imports them at every start,
also for ``--help``. This module is therefore only a stub, which imports `sweeps` when a sweep runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


class StudySweeper(Sweeper):
    """Runs a grid, a list or a search, each point in a separate process (`sweeps.sweep`).

    `settings` are the keys of ``conf/hydra/sweeper/study.yaml``; checked when the sweep begins.
    """

    def __init__(self, **settings: Any) -> None:
        self.settings = settings

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Store the configuration; the task function is not used, because points are commands."""
        del task_function
        self.config, self.hydra_context = config, hydra_context

    def sweep(self, arguments: list[str]) -> None:
        """Run every point of the overrides `arguments`; errors as of `sweeps.sweep.sweep`."""
        from sweeps.sweep import sweep

        assert self.hydra_context is not None, "Hydra calls setup() before sweep()"
        assert self.config is not None, "as above"
        sweep(arguments, self.config, self.hydra_context.config_loader)


class RayLauncher(Launcher):
    """Takes the settings of ``conf/hydra/launcher/ray.yaml``, which `StudySweeper` alone reads."""

    def __init__(self, **settings: Any) -> None:
        del settings

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Refuse another sweeper, which wants to launch jobs with it, by an InputError."""
        del hydra_context, task_function, config
        from rgbt.checks import InputError

        raise InputError("hydra/launcher=ray needs hydra/sweeper=study.")

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Do nothing: it is never called, see `setup`."""
        raise NotImplementedError
