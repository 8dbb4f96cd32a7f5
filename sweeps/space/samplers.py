"""Samplers and pruners of a search: nodes such as ``{_target_: optuna.samplers.TPESampler}``."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from optuna.distributions import BaseDistribution
from optuna.pruners import BasePruner
from optuna.samplers import BaseSampler
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState

from rgbt.checks import check_choice
from sweeps.space.space import build_optuna

SAMPLERS = [f"optuna.samplers.{n}Sampler" for n in ("TPE", "Random", "GP", "NSGAII")]
"""Samplers without state outside the storage: others (QMC, grid, brute force) keep a counter or
stop the study, which neither several drivers nor a resumed search can share."""

PRUNERS = [
    f"optuna.pruners.{name}Pruner"
    for name in ("Nop", "Median", "Percentile", "SuccessiveHalving", "Hyperband", "Patient")
]


class PerTrialSampler(BaseSampler):
    """Draws of a trial follow from the seed and the number of the trial, and the trials before it.

    Optuna's samplers draw from one generator for all trials: two drivers with one seed, or a search
    that is resumed, would propose the same points again. Here every trial draws by its own number
    in the storage. No two trials share draws, and one worker repeats a search exactly, even if it
    was stopped and resumed.

    Args:
        make: the sampler that chooses, from a seed; it keeps nothing outside the storage.
        seed: of the search.
    """

    def __init__(self, make: Callable[[int], BaseSampler], seed: int) -> None:
        self.make = make
        self.seed = seed
        self._inner: dict[int, BaseSampler] = {}

    def before_trial(self, study: Study, trial: FrozenTrial) -> None:
        """Begin a trial, also one that another process began and this one resumes."""
        self._inner[trial.number] = self.make(trial_seed(self.seed, trial.number))
        self._inner[trial.number].before_trial(study, trial)

    def infer_relative_search_space(
        self, study: Study, trial: FrozenTrial
    ) -> dict[str, BaseDistribution]:
        """See `BaseSampler`."""
        return self._of(trial).infer_relative_search_space(study, trial)

    def sample_relative(
        self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """See `BaseSampler`."""
        return self._of(trial).sample_relative(study, trial, search_space)

    def sample_independent(
        self, study: Study, trial: FrozenTrial, param_name: str, param_distribution: Any
    ) -> Any:
        """See `BaseSampler`."""
        return self._of(trial).sample_independent(study, trial, param_name, param_distribution)

    def after_trial(
        self, study: Study, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None
    ) -> None:
        """End a trial; one that this process never began is ended all the same."""
        self._of(trial).after_trial(study, trial, state, values)
        self._inner.pop(trial.number, None)

    def _of(self, trial: FrozenTrial) -> BaseSampler:
        return self._inner.get(trial.number) or self.make(trial_seed(self.seed, trial.number))


def trial_seed(seed: int, number: int) -> int:
    """32-bit seed that depends on both arguments (SHA-256), the same on every machine."""
    digest = hashlib.sha256(f"{seed}:trial:{number}".encode()).digest()
    return int.from_bytes(digest[:4], "big")


def build_sampler(node: Mapping[str, Any]) -> PerTrialSampler:
    """The sampler of a search.

    Args:
        node: with `_target_`, one of `SAMPLERS`, and options of its constructor; one worker with
            the same `seed` (0 if it has none) proposes the same points, see `PerTrialSampler`.
    """
    path = "hydra.sweeper.sampler"
    check_choice(f"{path}._target_", str(node.get("_target_")), SAMPLERS)
    build_optuna(node, path)

    return PerTrialSampler(lambda seed: build_optuna(node, path, seed=seed), node.get("seed") or 0)


def build_pruner(node: Mapping[str, Any] | None) -> BasePruner:
    """The pruner of a search; trials report at their validation steps.

    Args:
        node: with `_target_`, one of `PRUNERS`, and options of its constructor; None: no pruner.
            Those that count steps (``n_warmup_steps``, ``min_resource``) count steps of the
            optimizer, not validations.
    """
    path, node = "hydra.sweeper.pruner", node or {"_target_": "optuna.pruners.NopPruner"}
    check_choice(f"{path}._target_", str(node.get("_target_")), PRUNERS)
    # A patient pruner may wrap another one, which the node then holds.
    alone = {} if "wrapped_pruner" in node else {"wrapped_pruner": None}
    pruner: BasePruner = build_optuna(node, path, **alone)
    return pruner
