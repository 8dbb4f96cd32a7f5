"""Finished runs: in the folder of runs, or in MLflow where another machine has sent them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from rgbt.checks import InputError, RunError
from rgbt.config.component import build
from rgbt.metrics.counts import Counts
from rgbt.tracking.folder import RunFolder
from rgbt.tracking.formats import ADVICE, read_provenance, read_result
from rgbt.tracking.mlflow_fill import shown
from rgbt.tracking.mlflow_store import MlflowTracking, Tracking
from rgbt.tracking.other_code import other_code
from rgbt.tracking.provenance import without_passwords
from rgbt.tracking.replaced import replace_finished
from rgbt.tracking.terminal import tell
from sweeps.points import Evaluation

FETCHED_FILES = ("result.json", "counts_test.npz", "provenance.json", "evaluations")
CHECKPOINT = "best.pt"
"""What evaluations are made of; other machines do not get it."""

FETCHED = ".fetched"
"""Folder inside the folder of runs: what was taken from MLflow of runs made elsewhere."""


@dataclass(frozen=True)
class Found:
    """A finished run.

    Attributes:
        key: its config key.
        folder: where its files lie here: the run folder, or copies of what MLflow holds.
        run_id: its MLflow run where the files came from there, else "".
    """

    key: str
    folder: Path
    run_id: str = ""

    @property
    def result(self) -> dict[str, Any]:
        """``result.json`` of the run (see `rgbt.training.train`)."""
        result = read_result(self.folder)
        if result is None or "dataset" not in result:
            raise InputError(
                f"{self.folder / 'result.json'} is missing or names no data set; {ADVICE}."
            )
        return result

    @property
    def dataset(self) -> str:
        """Fingerprint of the data set it was made on."""
        return str(self.result["dataset"])

    @property
    def commit(self) -> str | None:
        """Git commit of the code that made it; "+" is added for changes that were not committed."""
        first = next(iter(read_provenance(self.folder / "provenance.json")), {})
        commit = first.get("git_commit")
        return None if commit is None else f"{commit[:10]}{'+' if first.get('git_dirty') else ''}"

    @property
    def is_of_other_code(self) -> bool:
        """Whether it was made by other code than that of this process."""
        return other_code(RunFolder(self.folder)) is not None

    def scores(self) -> dict[str, float]:
        """Scores by "val/..." and "test/..." names, as MLflow shows them but not rounded."""
        result = self.result
        return {
            f"{split}/{name}": in_percent(name, value)
            for split in ("val", "test")
            for name, value in result.get(split, {}).items()
            if value is not None
        }

    def counts(self, evaluation: Evaluation | None = None) -> Counts:
        """Counts of the test split.

        Args:
            evaluation: None: those that the run itself ended with.

        Raises:
            InputError: the file is missing or not readable.
        """
        return Counts.load(self.counts_file(evaluation))

    def has(self, evaluation: Evaluation) -> bool:
        """Whether the evaluation is there, of this training and not of an earlier one."""
        # The checkpoint tells, not the result: a run may have made it itself before that.
        path, best = self.counts_file(evaluation), self.folder / CHECKPOINT
        if not path.exists():
            return False
        if best.exists() and path.stat().st_mtime < best.stat().st_mtime:
            return False
        try:
            counts = Counts.load(path)
        except InputError:  # not readable: it is made again
            return False
        return counts.dataset == self.dataset and counts.split == "test"

    def counts_file(self, evaluation: Evaluation | None = None) -> Path:
        """Where the counts lie, whether they are there yet or not."""
        if evaluation is None:
            return self.folder / "counts_test.npz"
        return self.folder / evaluation.path


def in_percent(name: str, value: float) -> float:
    """A score as MLflow shows it (percent, Var as it is), with all its digits."""
    return 100 * value if shown(name, 1.0) == 100 else value


def open_runs(config: DictConfig) -> Runs:
    """Finished runs where a configuration says that runs lie and how they are tracked."""
    runs_dir = Path(config.runs_dir).expanduser().resolve()
    return Runs(runs_dir, build(config.tracking), fresh=config.fresh)


class Runs:
    """All finished runs that can be found from here.

    Args:
        runs_dir: the folder of runs.
        tracking: as the configuration builds it; MLflow is asked for runs that have no result here.
        fresh: finished runs that other code made do not count: they are trained again.
    """

    def __init__(self, runs_dir: Path, tracking: Tracking, *, fresh: bool = False) -> None:
        self.runs_dir = runs_dir
        self.tracking = tracking
        self.fresh = fresh
        self._is_away = False

    def find(self, key: str, dataset: str) -> Found | None:
        """The finished run `key` on the data set with that fingerprint; None if there is none.

        Raises:
            RunError: the run folder is finished, but on other files of the data set.
        """
        found = self._any(key, dataset)
        return None if found is not None and self._is_outdated(found) else found

    def replace_outdated(self, key: str) -> None:
        """Make room for a training of `key` where `find` passes over a finished run of it."""
        folder = self.runs_dir / key
        if (folder / "result.json").exists() and self._is_outdated(Found(key, folder)):
            replace_finished(RunFolder(folder), self.tracking)

    def _is_outdated(self, found: Found) -> bool:
        return self.fresh and found.is_of_other_code

    def _any(self, key: str, dataset: str) -> Found | None:
        """See `find`; whatever code made it."""
        folder = self.runs_dir / key
        if not (folder / "result.json").exists():
            return self._remote(key, dataset)
        found = Found(key, folder)
        try:
            made_on = found.dataset
        except InputError as error:
            raise RunError(str(error)) from error
        if made_on != dataset:
            raise RunError(
                f"{folder} was made on other files of the data set ({made_on[:8]}, now "
                f"{dataset[:8]}); give the runs another folder (runs_dir=...)."
            )
        return found

    def tag(self, found: Found, tags: Mapping[str, str]) -> None:
        """Add MLflow tags to a finished run that lacks them."""
        if found.run_id:
            self._guarded(lambda tracking: _set_tags(tracking, found.run_id, tags))
            return
        folder = RunFolder(found.folder)
        description = folder.description()
        assert description is not None, "a finished run has its description"
        if tags.items() <= description.tags.items():
            return
        folder.describe(replace(description, tags={**description.tags, **tags}))
        self._guarded(lambda tracking: tracking.sync(folder, "FINISHED"))

    def send(self, found: Found) -> None:
        """Bring MLflow up to date with a run folder that has got new files."""
        self._guarded(lambda tracking: tracking.sync(RunFolder(found.folder), "FINISHED"))

    def stopped(self, key: str, reason: str) -> None:
        """Show in MLflow why a run was stopped before its end."""
        path = self.runs_dir / key
        if not (path / "run.json").exists() or (path / "result.json").exists():
            return  # not begun, or finished while it was being stopped
        folder = RunFolder(path)
        description = folder.description()
        assert description is not None, "run.json exists"
        folder.describe(replace(description, tags={**description.tags, "rgbt.stopped": reason}))
        self._guarded(lambda tracking: tracking.sync(folder, "KILLED"))

    def fetch_again(self, found: Found, evaluation: Evaluation) -> bool:
        """Look for an evaluation that the other machine has made since; whether it is here now."""
        self._guarded(lambda tracking: _download(tracking, found, ("evaluations",)))
        return found.has(evaluation)

    def touch(self) -> None:
        """Open the store once, before several processes would make its tables at the same time."""
        self._guarded(lambda tracking: tracking.store())

    def _remote(self, key: str, dataset: str) -> Found | None:
        copy = self.runs_dir / FETCHED / key
        known = copy / "run_id"
        if known.exists():
            found = Found(key, copy, known.read_text(errors="replace"))
            if found.dataset == dataset:
                return found
        fetched: Found | None = self._guarded(lambda t: _fetch(t, (key, dataset), copy))
        return fetched

    def _guarded(self, work: Any) -> Any:
        """`work` on MLflow; None without it, and where it cannot be reached, which is told once."""
        if self._is_away or not isinstance(self.tracking, MlflowTracking):
            return None
        try:
            return work(self.tracking)
        except Exception as error:  # The border to a store that may fail in any way.
            self._is_away = True
            said = without_passwords(str(error)).splitlines() or [type(error).__name__]
            reason = said[0][:120]
            tell(
                f"MLflow cannot be used ({reason}); runs are looked for in {self.runs_dir} alone, "
                "and `python -m rgbt.tracking.sync` sends them later."
            )
            return None


def _fetch(tracking: MlflowTracking, wanted: tuple[str, str], copy: Path) -> Found | None:
    """Copy what MLflow holds of a finished run; None where it does not know it."""
    key, dataset = wanted
    if not is_there(tracking):
        return None
    store = tracking.store()
    query = (
        f"attributes.status = 'FINISHED' and tags.`rgbt.key` = '{key}' "
        f"and tags.`rgbt.dataset` = '{dataset}'"
    )
    runs = store.client.search_runs([store.experiment_id], filter_string=query, max_results=1)
    if not runs:
        return None
    run_id = runs[0].info.run_id
    copy.mkdir(parents=True, exist_ok=True)
    _download(tracking, Found(key, copy, run_id), FETCHED_FILES)
    if not (copy / "result.json").exists() or not (copy / "counts_test.npz").exists():
        return None
    # Written last: without it the copy is not whole and is made again.
    (copy / "run_id").write_text(run_id)
    return Found(key, copy, run_id)


def is_there(tracking: MlflowTracking) -> bool:
    """Whether the store exists; opening a file of SQLite would make it."""
    scheme, _, path = tracking.uri.partition(":///")
    return scheme != "sqlite" or Path(path).exists()


def _download(tracking: MlflowTracking, found: Found, wanted: Sequence[str]) -> None:
    client = tracking.store().client
    there = {item.path for item in client.list_artifacts(found.run_id)}
    for name in wanted:
        if name in there:
            client.download_artifacts(found.run_id, name, str(found.folder))


def _set_tags(tracking: MlflowTracking, run_id: str, tags: Mapping[str, str]) -> None:
    for name, value in tags.items():
        tracking.store().client.set_tag(run_id, name, value)
