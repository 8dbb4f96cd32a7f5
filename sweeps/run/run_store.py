"""Finished runs: in the folder of runs, or in an archive; and their records in MLflow."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from analysis.archive import unpack
from rgbt.checks import InputError, RunError
from rgbt.config.component import build
from rgbt.runs.folder import RunFolder, is_finished, read_description, set_aside
from rgbt.runs.provenance import without_passwords
from rgbt.runs.result import RunResult
from rgbt.terminal import info
from rgbt.tracking.mlflow_store import MlflowTracking
from rgbt.tracking.tracker import Tracking
from sweeps.plan.measurement import Words, stored_at
from sweeps.plan.planner import PlannedPoint


@dataclass
class RunStore:
    """All finished runs that this machine can reach, of a folder of runs and of an `archive`.

    With `fresh`, finished runs that other code made are ignored, so that they are trained again.
    """

    runs_dir: Path
    tracking: Tracking
    fresh: bool = False
    archive: Path | None = None
    _is_unreachable: bool = field(default=False, init=False)

    def find(self, key: str, dataset: str, evaluations: Sequence[Words] = ()) -> RunResult | None:
        """Return the finished run `key` on the data set with that fingerprint; None: there is none.

        An archived run cannot be evaluated further: it counts if it has all `evaluations`.
        RunError: the run folder is finished, but on other files of the data set.
        """
        folder = self.runs_dir / key
        result = RunResult(folder) if is_finished(folder) else None
        if result is None and self.archive and (path := self.archive / f"{key}.zip").exists():
            archived = unpack(path)
            is_whole = all(stored_at(archived, words) for words in evaluations)
            result = archived if is_whole and archived.fingerprint == dataset else None
        if result is None:
            return None
        try:
            trained_on = result.fingerprint
        except InputError as error:
            raise RunError(str(error)) from error
        if trained_on != dataset:
            raise RunError(
                f"{result.folder} was trained on other files of the data set ({trained_on[:8]}, "
                f"now {dataset[:8]}); use another folder of runs (runs_dir=...)."
            )
        return None if self._is_outdated(result) else result

    def of_point(self, plan: PlannedPoint) -> tuple[RunResult, ...]:
        """Return the runs of a point if `find` has all of them, evaluated or not; else ()."""
        wanted = plan.point.evaluations
        results = []
        for run in plan.runs:
            result = self.find(run.key, plan.fingerprints[run.key], wanted)
            if result is None:
                return ()
            results.append(result)
        return tuple(results)

    def replace_outdated(self, key: str) -> None:
        """Move a finished run that `find` ignores out of the way of a new training."""
        result = RunResult(self.runs_dir / key)
        if result.is_finished and self._is_outdated(result):
            kept = set_aside(RunFolder(result.folder))
            if kept is not None and (known := read_description(kept.path)) is not None:
                self.tracking.refresh(kept, known)

    def _is_outdated(self, result: RunResult) -> bool:
        return self.fresh and result.other_code is not None

    def is_own(self, result: RunResult) -> bool:
        """Whether a run is a run folder here, and not a copy."""
        return result.folder.parent == self.runs_dir

    def tag(self, result: RunResult, tags: Mapping[str, str]) -> None:
        """Add MLflow tags to a finished run of this machine that lacks them."""
        if self.is_own(result) and not tags.items() <= result.tags.items():
            known = result.description
            RunFolder(result.folder).describe(replace(known, tags={**known.tags, **tags}))
            self.sync(result)

    def sync(self, result: RunResult) -> None:
        """Send new files of a run folder to MLflow."""
        self._with_mlflow(lambda tracking: tracking.sync(RunFolder(result.folder), "FINISHED"))

    def create_tables(self) -> None:
        """Open the store once, before several processes create its tables at the same time."""
        self._with_mlflow(lambda tracking: tracking.store())

    def _with_mlflow(self, action: Callable[[MlflowTracking], Any]) -> None:
        """Do `action` on MLflow; nothing without it, or after a failure, which is one warning."""
        if self._is_unreachable or not isinstance(self.tracking, MlflowTracking):
            return
        try:
            action(self.tracking)
        except Exception as error:  # The border to a store that may fail in any way.
            self._is_unreachable = True
            reason = without_passwords(f"{type(error).__name__}: {error}").splitlines()[0][:120]
            info(f"MLflow cannot be used ({reason}). Send new runs later: `rgbt sync`.")


def open_run_store(config: DictConfig) -> RunStore:
    """Open the finished runs in the folder of runs and the tracker of a composed configuration."""
    runs_dir = Path(config.runs_dir).expanduser().resolve()
    return RunStore(runs_dir, build(config.tracking), fresh=config.fresh)
