"""Write the checkpoints of a run folder so that a single rename commits each state.

====================  ============================================================================
last.pt               the committed state: model, optimisers, step, and which step is the best
last_previous.pt      the state committed before it, for the case that last.pt is damaged
checkpoints/<step>/   files of the evaluation at that step: best.pt, counts_val.npz, ...; kept for
                      the best steps of these two states
best.pt, ...          hard links to the files of the best step of last.pt
====================  ============================================================================

An evaluation first writes its files under its step. They are used only once last.pt names that
step. If a process is killed in between, the files are repaired when the run resumes.
"""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path
from typing import Any

from rgbt.checkpoints.torch_files import save
from rgbt.checks import InputError, RunError
from rgbt.engine.checkpoint import State, load_checkpoint, step_of

BEST = "best.pt"
NO_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK, errno.EACCES)
"""Errors of file systems without hard links; files are copied there."""


class Checkpoints:
    """Read and commit the checkpoints of one run folder (see the module).

    Args:
        folder: of the run.

    Attributes:
        warning: after `load`: the problem with last.pt, "" if there is none.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.last = folder / "last.pt"
        self.previous = folder / "last_previous.pt"
        self.best = folder / BEST
        self.warning = ""
        self._by_step = folder / "checkpoints"
        self._committed: tuple[int, int] | None = None
        self._best_step = 0

    def begin_evaluation(self, step: int) -> Path:
        """The empty folder for the files of the evaluation at `step`."""
        folder = self._by_step / str(step)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        return folder

    def save_best(self, step: int, weights: dict[str, Any]) -> None:
        """Write the weights of an evaluation with the highest score so far, or of the last one."""
        folder = self._by_step / str(step)
        folder.mkdir(parents=True, exist_ok=True)
        save(folder / BEST, {"model": weights, "step": step})

    def commit(self, payload: dict[str, Any], state: State) -> None:
        """Write the state of a run, unless it is already committed."""
        if self._committed == (state.step, state.evaluated_step):
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        if self.last.exists():
            _link(self.last, self.previous)
        save(self.last, payload)
        self._publish(state.best_step)
        kept = {str(self._best_step), str(state.best_step)}
        for folder in self._by_step.glob("*"):
            if folder.name not in kept:
                shutil.rmtree(folder)
        self._committed = state.step, state.evaluated_step
        self._best_step = state.best_step

    def load(self) -> tuple[dict[str, Any], State] | None:
        """The committed payload and its state; None before there is any.

        Where last.pt or its best weights are damaged, the state committed before takes its place,
        and `warning` says so.

        Raises:
            RunError: both are damaged.
        """
        if not self.last.exists() and not self.previous.exists():
            return None
        try:
            payload, state = self._whole(self.last)
        except InputError as damage:
            payload, state = self._fallen_back(damage)
        self._committed = state.step, state.evaluated_step
        self._best_step = state.best_step
        self._publish(state.best_step)
        return payload, state

    def committed(self) -> tuple[dict[str, Any], State]:
        """What `load` returned in another process of this run, which repaired the files.

        Raises:
            InputError: this machine does not see the files.
        """
        payload = load_checkpoint(self.last)
        return payload, State.of(payload)

    def load_best(self, step: int) -> dict[str, Any]:
        """The weights of the best step, by name.

        Raises:
            InputError: the file is missing or damaged.
            RunError: it holds the weights of another step.
        """
        payload = load_checkpoint(self.best)
        found = step_of(payload, self.best)
        if found != step:
            raise RunError(
                f"{self.best} is of step {found}, but the best evaluation of this run is of step "
                f"{step}; {self._begin_again()}"
            )
        weights: dict[str, Any] = payload["model"]
        return weights

    def tidy(self) -> None:
        """Remove the files that are only needed to resume, after training has ended."""
        self.previous.unlink(missing_ok=True)
        shutil.rmtree(self._by_step, ignore_errors=True)

    def _whole(self, path: Path) -> tuple[dict[str, Any], State]:
        """A committed state whose best weights are there too.

        Raises:
            InputError: one of both is missing or damaged.
        """
        payload = load_checkpoint(path)
        try:
            state = State.of(payload)
        except TypeError as error:
            raise InputError(f"{path} does not hold the state of a training.") from error
        named = self._by_step / str(state.best_step) / BEST
        # Runs of before there was this folder have their best weights beside last.pt.
        best = named if named.exists() else self.best
        found = step_of(load_checkpoint(best), best) if state.best_step else 0
        # A later one was written by a process that was killed before it committed it.
        if found != state.best_step and found <= state.step:
            raise InputError(f"{best} is of step {found}, not {state.best_step}.")
        return payload, state

    def _fallen_back(self, damage: InputError) -> tuple[dict[str, Any], State]:
        reason = str(damage).partition(";")[0].rstrip(".")
        if not self.previous.exists():
            raise RunError(f"{reason}; {self._begin_again()}") from damage
        try:
            payload, state = self._whole(self.previous)
        except InputError as error:
            raise RunError(
                f"{reason}, and the previous checkpoint ({self.previous.name}) is damaged too; "
                f"{self._begin_again()}"
            ) from error
        if self.last.exists():
            self.warning = f"{reason}; the run resumes from the previous checkpoint."
        _link(self.previous, self.last)
        return payload, state

    def _begin_again(self) -> str:
        return f"remove {self.folder} and rerun the command to train the run from the start."

    def _publish(self, step: int) -> None:
        """Link the public file names to the files of the best step."""
        for source in (self._by_step / str(step)).glob("*"):
            _link(source, self.folder / source.name)


def _link(source: Path, target: Path) -> None:
    """Atomically make `target` another name of `source`, replacing an older file."""
    if target.exists() and target.samefile(source):
        return
    temporary = target.with_name(f".{target.name}.partial")
    temporary.unlink(missing_ok=True)
    try:
        try:
            os.link(source, temporary)
        except OSError as error:
            if error.errno not in NO_LINKS:
                raise
            shutil.copy2(source, temporary)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
