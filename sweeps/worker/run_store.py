"""Finished runs: in the folder of runs, in an archive, or in MLflow of several machines."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from omegaconf import DictConfig

from analysis.archive import unpack
from rgbt.checks import InputError, RunError
from rgbt.config.component import build
from rgbt.runs.folder import RunFolder, counts_name, is_finished, read_description, set_aside
from rgbt.runs.provenance import without_passwords
from rgbt.runs.result import ALL_COUNTS, RunResult
from rgbt.terminal import info
from rgbt.tracking.mlflow_store import MlflowTracking
from rgbt.tracking.tracker import Tracking
from sweeps.evaluation import ExtraEvaluation

FETCHED_FILES = ("result.json", "provenance.json", "evaluations")
FETCHED = ".fetched"  # in the folder of runs: copies of runs that other machines made

Answer = TypeVar("Answer")


@dataclass
class RunStore:
    """All finished runs that this machine can reach.

    Runs without a result here are looked for in the folder `archive`, and in MLflow of `tracking`.
    With `fresh`, finished runs that other code made are ignored, so that they are trained again.
    """

    runs_dir: Path
    tracking: Tracking
    fresh: bool = False
    archive: Path | None = None
    _is_unreachable: bool = field(default=False, init=False)

    def find(
        self, key: str, dataset: str, evaluations: Sequence[ExtraEvaluation] = ()
    ) -> RunResult | None:
        """The finished run `key` on the data set with that fingerprint; None if there is none.

        An archived run cannot be evaluated further: it counts if it has all `evaluations`.
        RunError: the run folder is finished, but on other files of the data set.
        """
        folder = self.runs_dir / key
        result = RunResult(folder) if is_finished(folder) else None
        if result is None and self.archive and (path := self.archive / f"{key}.zip").exists():
            archived = unpack(path)
            is_whole = all(each.is_stored(archived) for each in evaluations)
            result = archived if is_whole and archived.fingerprint == dataset else None
        if result is None:
            fetch = partial(self._fetched, key=key, dataset=dataset, evaluations=evaluations)
            result = self._with_mlflow(fetch)
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

    def _fetched(
        self,
        tracking: MlflowTracking,
        key: str,
        dataset: str,
        evaluations: Sequence[ExtraEvaluation],
    ) -> RunResult | None:
        """The copy of a run from MLflow; fetched where it is not there yet with all evaluations."""
        copy = self.runs_dir / FETCHED / key
        marker = copy / "run_id"
        if marker.exists():
            result = RunResult(copy, marker.read_text())
            is_whole = all(each.is_stored(result) for each in evaluations)
            if result.fingerprint == dataset and is_whole:
                return result
        file = tracking.uri.partition("sqlite:///")[2]
        if file and (Path(file).parent == self.runs_dir or not Path(file).exists()):
            return None  # it holds the runs of this folder alone; opening it would create it
        store = tracking.store()
        query = (
            f"attributes.status = 'FINISHED' and tags.`rgbt.key` = '{key}' "
            f"and tags.`rgbt.dataset` = '{dataset}'"
        )
        runs = store.client.search_runs([store.experiment_id], filter_string=query, max_results=1)
        if not runs:
            return None
        result = RunResult(copy, runs[0].info.run_id)
        copy.mkdir(parents=True, exist_ok=True)
        for item in store.client.list_artifacts(result.run_id):
            if item.path in FETCHED_FILES or Path(item.path).match(ALL_COUNTS):
                store.client.download_artifacts(result.run_id, item.path, str(copy))
        if not result.is_finished or not (copy / counts_name("test")).exists():
            return None
        marker.write_text(result.run_id)  # last: a copy without it is incomplete
        return result

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

    def _with_mlflow(self, action: Callable[[MlflowTracking], Answer]) -> Answer | None:
        """`action` on MLflow; None without MLflow, and from its first failure on (one warning)."""
        if self._is_unreachable or not isinstance(self.tracking, MlflowTracking):
            return None
        try:
            return action(self.tracking)
        except Exception as error:  # The border to a store that may fail in any way.
            self._is_unreachable = True
            reason = without_passwords(f"{type(error).__name__}: {error}").splitlines()[0][:120]
            info(f"MLflow cannot be used ({reason}). Send new runs later: `rgbt sync`.")
            return None


def open_run_store(config: DictConfig) -> RunStore:
    """Finished runs in the folder of runs and in the tracker of a composed configuration."""
    runs_dir = Path(config.runs_dir).expanduser().resolve()
    return RunStore(runs_dir, build(config.tracking), fresh=config.fresh)
