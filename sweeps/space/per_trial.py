"""A sampler that starts anew for every trial; imported late, because it needs optuna."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from typing import Any

from optuna.distributions import BaseDistribution
from optuna.samplers import BaseSampler
from optuna.study import Study
from optuna.trial import FrozenTrial, TrialState


class PerTrialSampler(BaseSampler):
    """Draws of a trial follow from the seed and the number of the trial, and the trials before it.

    Optuna's samplers draw from one generator for all trials: two drivers with one seed, or a search
    that is resumed, would propose the same points again. Here every trial
    draws by its own number in the storage. No two trials share draws, and one worker repeats a
    search exactly, even if it was stopped and resumed.

    Args:
        make: makes the sampler that chooses, from a seed; must keep nothing between trials that is
            not in the storage.
        seed: of the search.
    """

    def __init__(self, make: Callable[[int], BaseSampler], seed: int) -> None:
        self.make = make
        self.seed = seed
        self._inner: dict[int, BaseSampler] = {}

    def __str__(self) -> str:
        return f"{self.make(0)} per trial"

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
        self,
        study: Study,
        trial: FrozenTrial,
        param_name: str,
        param_distribution: BaseDistribution,
    ) -> Any:
        """See `BaseSampler`."""
        return self._of(trial).sample_independent(study, trial, param_name, param_distribution)

    def after_trial(
        self,
        study: Study,
        trial: FrozenTrial,
        state: TrialState,
        values: Sequence[float] | None,
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
