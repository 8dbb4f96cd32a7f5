"""The parts of a training that are the same in every process of a run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rgbt.assembly.session import Session
from rgbt.assembly.training_setup import TrainingSetup
from rgbt.data.domains import TestedHead
from rgbt.data.loaders import Batches, PairedBatches
from rgbt.engine.checkpoint import Checkpoints, State, restore_weights
from rgbt.engine.trainer import Loaded, Trainer
from rgbt.evaluation.prediction import view_of
from rgbt.evaluation.request import EvaluationRequest


def make_trainer(setup: TrainingSetup, folder: Path, **of_process: Any) -> Trainer:
    """The training loop of a run; `of_process` are the attributes in which processes differ."""
    session = setup.session
    return Trainer(
        fabric=setup.fabric,
        settings=session.trainer,
        scheme=setup.scheme,
        model=setup.model,
        others=setup.others,
        optimizers=setup.optimizers,
        schedule=setup.schedule,
        steps_per_epoch=max(1, setup.steps_per_epoch() // session.trainer.accumulate),
        folder=folder,
        **of_process,
    )


def fit(trainer: Trainer, setup: TrainingSetup, state: State) -> None:
    """Train from ``state.step`` to the last step."""
    accumulate = trainer.settings.accumulate
    steps = range(state.step * accumulate, trainer.settings.max_steps * accumulate)
    trainer.fit(_noting_skipped(setup.batches(steps), state), state)


def load_best(session: Session, folder: Path, step: int) -> None:
    """Give the network the weights of the best checkpoint, which is of this step."""
    checkpoints = Checkpoints(folder)
    restore_weights(session.model, checkpoints.load_best(step), checkpoints.best)


def target_request(session: Session, split: str) -> EvaluationRequest | None:
    """The evaluation in the view of the target; None where that is the source's."""
    target = session.domains.target
    if target is None or target.view in (None, view_of(session)):
        return None
    return EvaluationRequest(split=split, view=target.view)


def other_head_request(session: Session) -> EvaluationRequest | None:
    """The evaluation of the test split with the head that the run does not select for the night.

    None in a run without a head for the day and another one for the night.
    """
    if session.domains.target_is != "night":
        return None
    head: TestedHead = "target" if session.domains.tested_head == "source" else "source"
    return EvaluationRequest(split="test", head=head)


def _noting_skipped(batches: Batches[Any] | PairedBatches, state: State) -> Iterator[Loaded]:
    """The batches, with unreadable files noted in `state` before a checkpoint is written."""
    for batch in batches:
        state.skip(batches.skipped)
        yield batch
