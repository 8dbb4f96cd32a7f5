"""The processes beside process 0: they train and evaluate their part of each run.

They write nothing. Every collective call here has its counterpart in `rgbt.training.members` or
`rgbt.training.train`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass

from torch import nn

from rgbt.assembly.training_setup import TrainingSetup, set_up_training
from rgbt.checks import InputError, RunError
from rgbt.engine.checkpoint import State
from rgbt.evaluation.request import EvaluationRequest
from rgbt.evaluation.segmentation import evaluate, panel_names
from rgbt.metrics import names, scores
from rgbt.processes import agreed, collected
from rgbt.runs.run_spec import RunSpec
from rgbt.runtime.member import LOST
from rgbt.training.common import (
    fit,
    load_best,
    make_trainer,
    other_head_request,
    target_request,
)
from rgbt.training.members import NO_MORE


def follow(run: RunSpec) -> None:
    """Take part in the training of each run that process 0 names, until it names no more.

    Raises:
        RunError: this process does not know the run that process 0 trains.
    """
    known = {spec.key: spec for spec in _with_upstream(run)}
    while (key := agreed(NO_MORE)) != NO_MORE:
        if key not in known:
            raise RunError(
                f"process 0 trains the run {key}, but the configuration of this process describes "
                f"{', '.join(known)}. Use the same code, data and files of weights on all machines."
            )
        _take_part(known[key])


def _with_upstream(run: RunSpec) -> Iterator[RunSpec]:
    for upstream in run.upstream:
        yield from _with_upstream(upstream)
    yield run


def _take_part(spec: RunSpec) -> None:
    reason = ""
    try:
        setup = set_up_training(spec)
    except (InputError, RunError) as error:
        reason = str(error)
    if not agreed(False):
        return
    if any(collected(reason)):
        sys.exit(LOST)  # process 0 reports it
    _Part(setup).complete()


@dataclass(frozen=True)
class _Part:
    """The part of this process in a run; see `rgbt.training.train.Run` for that of process 0."""

    setup: TrainingSetup

    def complete(self) -> None:
        """Train to the last step and evaluate the best checkpoint."""
        session = self.setup.session
        folder = session.spec.folder
        split = session.selection_split
        state = State(seed=session.spec.drawn.masks)

        def validate(step: int) -> float:  # noqa: ARG001
            assert split is not None, "called only where there is one"
            return self._evaluate(self.setup.model, split)

        trainer = make_trainer(
            self.setup,
            folder,
            record=lambda step, values: None,  # noqa: ARG005
            validate=None if split is None else validate,
            writes=False,
        )
        if agreed(False):  # process 0 resumes
            trainer.resume(state)
        fit(trainer, self.setup, state)
        agreed(None)  # process 0 has written the best checkpoint
        load_best(session, folder, state.best_step)
        self._evaluate(session.model, "test")
        other = other_head_request(session)
        if other is not None:
            evaluate(session, session.model, other)

    def _evaluate(self, model: nn.Module, split: str) -> float:
        """Predict this part of a split, also in the view of the target; the mIoU of the whole."""
        session = self.setup.session
        keep = panel_names(session.dataset, split) if split == "test" else ()
        result = evaluate(session, model, EvaluationRequest(split=split, keep=keep))
        target = target_request(session, split)
        if target is not None:
            evaluate(session, model, target)
        return scores.summary(result.counts, session.regions.absent)[names.MIOU]
