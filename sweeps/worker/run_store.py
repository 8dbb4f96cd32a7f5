"""Finished runs: in the folder of runs, or in MLflow where another machine has sent them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import TypeVar

from omegaconf import DictConfig

from rgbt.checks import InputError, RunError
from rgbt.config.component import build
from rgbt.runs.folder import RunFolder, counts_name, is_finished, read_description, set_aside
from rgbt.runs.provenance import without_passwords
from rgbt.runs.result import ALL_COUNTS, RunResult
from rgbt.terminal import info
from rgbt.tracking.mlflow_store import MlflowTracking
from rgbt.tracking.tracker import Status, Tracking
from sweeps.evaluation import ExtraEvaluation

FETCHED_FILES = ("result.json", ALL_COUNTS, "provenance.json", "evaluations")
FETCHED = ".fetched"
"""Folder inside the folder of runs: copies of runs that other machines made, from MLflow."""

Answer = TypeVar("Answer")


@dataclass
class RunStore:
    """All finished runs that this machine can reach.

    Attributes:
        tracking: as the configuration builds it; MLflow is searched for runs without a result here.
        fresh: ignore finished runs that other code made, so that they are trained again.
    """

    runs_dir: Path
    tracking: Tracking
    fresh: bool = False
    _is_unreachable: bool = field(default=False, init=False)

    def find(self, key: str, dataset: str) -> RunResult | None:
        """The finished run `key` on the data set with that fingerprint; None if there is none.

        Raises:
            RunError: the run folder is finished, but on other files of the data set.
        """
        local = RunResult(self.runs_dir / key)
        result = local if local.is_finished else self._find_remote(key, dataset)
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

    def replace_outdated(self, key: str) -> None:
        """Move a finished run that `find` ignores out of the way of a new training."""
        result = RunResult(self.runs_dir / key)
        if result.is_finished and self._is_outdated(result):
            kept = set_aside(RunFolder(result.folder))
            known = None if kept is None else read_description(kept.path)
            if kept is not None and known is not None:
                self.tracking.refresh(kept, known)

    def _is_outdated(self, result: RunResult) -> bool:
        return self.fresh and result.other_code is not None

    def tag(self, result: RunResult, tags: Mapping[str, str]) -> None:
        """Add MLflow tags to a finished run that lacks them."""

        def set_tags(tracking: MlflowTracking) -> None:
            for name, value in tags.items():
                tracking.store().client.set_tag(result.run_id, name, value)

        if result.run_id:
            self._with_mlflow(set_tags)
        elif not tags.items() <= result.tags.items():
            self._describe(RunFolder(result.folder), tags, "FINISHED")

    def sync(self, result: RunResult) -> None:
        """Send new files of a run folder to MLflow."""
        self._with_mlflow(lambda tracking: tracking.sync(RunFolder(result.folder), "FINISHED"))

    def mark_stopped(self, key: str, reason: str) -> None:
        """Record in MLflow why a run was stopped before its end."""
        path = self.runs_dir / key
        if not (path / "run.json").exists() or is_finished(path):
            return  # not started, or finished while it was being stopped
        self._describe(RunFolder(path), {"rgbt.stopped": reason}, "KILLED")

    def _describe(self, folder: RunFolder, tags: Mapping[str, str], status: Status) -> None:
        description = read_description(folder.path)
        assert description is not None, "a run that has started has run.json"
        folder.describe(replace(description, tags={**description.tags, **tags}))
        self._with_mlflow(lambda tracking: tracking.sync(folder, status))

    def fetch_counts(self, result: RunResult, evaluation: ExtraEvaluation) -> bool:
        """Download what another machine evaluated since; whether `evaluation` is among it."""
        self._with_mlflow(lambda tracking: _download(tracking, result, ("evaluations",)))
        return evaluation.is_stored(result)

    def create_tables(self) -> None:
        """Open the store once, before several processes create its tables at the same time."""
        self._with_mlflow(lambda tracking: tracking.store())

    def _find_remote(self, key: str, dataset: str) -> RunResult | None:
        copy = self.runs_dir / FETCHED / key
        run_id = copy / "run_id"
        if run_id.exists():
            result = RunResult(copy, run_id.read_text(errors="replace"))
            if result.fingerprint == dataset:
                return result
        return self._with_mlflow(lambda tracking: _fetch(tracking, dataset, copy))

    def _with_mlflow(self, action: Callable[[MlflowTracking], Answer]) -> Answer | None:
        """`action` on MLflow; None without MLflow, and from its first failure on (one warning)."""
        if self._is_unreachable or not isinstance(self.tracking, MlflowTracking):
            return None
        try:
            return action(self.tracking)
        except Exception as error:  # The border to a store that may fail in any way.
            self._is_unreachable = True
            lines = without_passwords(str(error)).splitlines() or [type(error).__name__]
            info(
                f"MLflow cannot be used ({lines[0][:120]}); finished runs are searched only "
                f"in {self.runs_dir}. Send new runs later: `rgbt sync`."
            )
            return None


def _fetch(tracking: MlflowTracking, dataset: str, copy: Path) -> RunResult | None:
    """Copy the files of a finished run from MLflow to `copy`; None where MLflow has no such run."""
    if not store_exists(tracking):
        return None
    store = tracking.store()
    query = (
        f"attributes.status = 'FINISHED' and tags.`rgbt.key` = '{copy.name}' "
        f"and tags.`rgbt.dataset` = '{dataset}'"
    )
    runs = store.client.search_runs([store.experiment_id], filter_string=query, max_results=1)
    if not runs:
        return None
    result = RunResult(copy, runs[0].info.run_id)
    copy.mkdir(parents=True, exist_ok=True)
    _download(tracking, result, FETCHED_FILES)
    if not result.is_finished or not (copy / counts_name("test")).exists():
        return None
    # Written last: a copy without it is incomplete and is fetched again.
    (copy / "run_id").write_text(result.run_id)
    return result


def store_exists(tracking: MlflowTracking) -> bool:
    """Whether the store exists; opening a file of SQLite would create it."""
    scheme, _, path = tracking.uri.partition(":///")
    return scheme != "sqlite" or Path(path).exists()


def _download(tracking: MlflowTracking, result: RunResult, patterns: Sequence[str]) -> None:
    client = tracking.store().client
    artifacts = [item.path for item in client.list_artifacts(result.run_id)]
    for name in artifacts:
        if any(fnmatch(name, pattern) for pattern in patterns):
            client.download_artifacts(result.run_id, name, str(result.folder))


def open_run_store(config: DictConfig) -> RunStore:
    """Finished runs in the folder of runs and in the tracker of a composed configuration."""
    runs_dir = Path(config.runs_dir).expanduser().resolve()
    return RunStore(runs_dir, build(config.tracking), fresh=config.fresh)
