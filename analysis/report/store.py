"""Reads an MLflow store: runs, tables and studies with their files. Nothing is written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar
from urllib.parse import unquote, urlparse

from rgbt.checks import InputError, RunError, nearest
from rgbt.files.plain_files import inside, read_bytes
from rgbt.runs.folder import read_result
from rgbt.runs.provenance import without_passwords
from rgbt.tracking.mlflow_store import LimitedClient, MlflowTracking
from rgbt.tracking.tracker import Tracking

T = TypeVar("T")
PAGE = 500
"""Runs of one request."""

MOST_FETCHED = 200_000_000
"""Bytes of a file that is copied from a server; larger ones are not read."""

SQLITE = "sqlite:///"
REASON_LENGTH = 160


@dataclass
class RunFiles:
    """Files of one MLflow run: in folders that can be read from here, else fetched from the store.

    Attributes:
        folders: looked through in this order.
        fetch: gets a file by its path; None where the folders are all there is. Raises whatever
            the store raises.
    """

    folders: Sequence[Path]
    fetch: Callable[[str], Path | None] | None = None
    _fetched: dict[str, Path | None] = field(default_factory=dict)

    def find(self, path: str) -> Path | None:
        """Where the file called `path` can be read; None: there is none.

        Raises:
            InputError: it is a link out of its folder, or cannot be fetched from the store.
        """
        for folder in self.folders:
            if (folder / path).is_file():
                return inside(folder / path, folder)
        if self.fetch is None:
            return None
        if path not in self._fetched:
            try:
                self._fetched[path] = self.fetch(path)
            except Exception as error:  # The border to a store that may fail in any way.
                said = f"'{path}' cannot be fetched from the store ({_reason(error)})."
                raise InputError(said) from error
        return self._fetched[path]

    def text(self, path: str) -> str | None:
        """The file as text; None: there is none.

        Raises:
            InputError: it cannot be fetched or is no text.
        """
        found = self.find(path)
        if found is None:
            return None
        try:
            return read_bytes(found).decode()
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{found} cannot be read ({error}).") from error


@dataclass(frozen=True, kw_only=True)
class MlflowRun:
    """One run of MLflow: a training, or the record of a table or study.

    Attributes:
        status: "FINISHED", "RUNNING", "FAILED", "KILLED" or "SCHEDULED".
        started: ISO 8601, UTC; "" where unknown.
        params: by name, as text.
        metrics: last value by name, as MLflow has it.
    """

    run_id: str
    name: str
    status: str
    started: str
    seconds: float | None
    tags: Mapping[str, str]
    params: Mapping[str, str]
    metrics: Mapping[str, float]
    files: RunFiles

    @property
    def kind(self) -> str:
        """What it is: "run", "table" or "study"."""
        return self.tags.get("kind", "run")


def read_each(
    records: Sequence[MlflowRun], read: Callable[[MlflowRun], T], remarks: list[str]
) -> list[T]:
    """What `read` returns for every record; `remarks` gets a sentence for each InputError."""
    found = []
    for record in records:
        try:
            found.append(read(record))
        except InputError as error:
            remarks.append(str(error))
    return found


def read_store(tracking: Tracking, runs_dir: Path, copies: Path) -> list[MlflowRun]:
    """Everything in the experiment of a store, newest first.

    Args:
        tracking: as the configuration builds it.
        runs_dir: folder of runs; files are taken from there where it has them.
        copies: folder for files that must be fetched.

    Raises:
        InputError: no MLflow is configured; no such file or experiment.
        RunError: the store cannot be reached.
    """
    if not isinstance(tracking, MlflowTracking):
        raise InputError(
            "the report is made from an MLflow store; give one with tracking=mlflow "
            "tracking.uri=... or runs_dir=..."
        )
    uri, shown = tracking.uri, without_passwords(tracking.uri)
    database = Path(uri.removeprefix(SQLITE)) if uri.startswith(SQLITE) else None
    # Opening a database that is not there would make an empty one.
    if database is not None and not database.is_file():
        raise InputError(
            f"there is no MLflow store {database}; give the folder of runs with runs_dir=..., or "
            "the store with tracking.uri=..."
        )
    try:
        client = LimitedClient(uri)
        experiment = client.get_experiment_by_name(tracking.experiment)
        if experiment is None:
            known = [each.name for each in client.search_experiments()]
            raise InputError(
                f"tracking.experiment={tracking.experiment}: the store {shown} has no such "
                f"experiment; {nearest(tracking.experiment, known)}."
            )
        runs, token = [], None
        while token is None or token:
            page = client.search_runs(
                [experiment.experiment_id],
                max_results=PAGE,
                order_by=["attributes.start_time DESC", "attributes.run_id ASC"],
                page_token=token,
            )
            runs += page
            token = page.token or ""
    except InputError:
        raise
    except Exception as error:  # The border to a store that may fail in any way.
        raise RunError(
            f"MLflow at {shown} cannot be read ({_reason(error)}); start its server if it "
            "has one, or name another store with tracking.uri=..."
        ) from error
    # A database that was moved with its files has them beside it now.
    beside = None if database is None else database.parent / "mlartifacts"
    finder = _FileFinder(client, runs_dir, copies, beside)
    return [_mlflow_run(run, finder) for run in runs]


@dataclass(frozen=True)
class _FileFinder:
    """Where files of runs may lie.

    Attributes:
        beside: folder of artifacts beside a database, or None.
    """

    client: Any
    runs_dir: Path
    copies: Path
    beside: Path | None

    def files(self, run: Any) -> RunFiles:
        """The files of an MLflow run."""
        run_id, tags = run.info.run_id, run.data.tags
        named = [Path(tags["rgbt.folder"])] if "rgbt.folder" in tags else []
        own = [self.runs_dir / tags["rgbt.key"]] if "rgbt.key" in tags else []
        folders = [each for each in (*own, *named) if _is_same(each, tags, run.info.status)]
        if self.beside is not None:
            folders.append(self.beside / run_id / "artifacts")
        address = urlparse(run.info.artifact_uri or "")
        if address.scheme in ("", "file"):
            return RunFiles((*folders, Path(unquote(address.path))))
        return RunFiles(folders, lambda path: self._fetch(run_id, path))

    def _fetch(self, run_id: str, path: str) -> Path | None:
        parent = str(PurePosixPath(path).parent)
        listed = self.client.list_artifacts(run_id, None if parent == "." else parent)
        sizes = {item.path: item.file_size or 0 for item in listed}
        if path not in sizes:
            return None
        if sizes[path] > MOST_FETCHED:
            raise InputError(f"it is larger than {MOST_FETCHED:,} bytes")
        folder = self.copies / run_id
        folder.mkdir(parents=True, exist_ok=True)
        return Path(self.client.download_artifacts(run_id, path, str(folder)))


def _is_same(folder: Path, tags: Mapping[str, str], status: str) -> bool:
    """Whether a run folder holds what MLflow shows: the same configuration on the same images."""
    try:
        result = read_result(folder)
    except InputError:
        return False
    if result is None:
        return status != "FINISHED" and (folder / "run.json").is_file()
    return tags.get("rgbt.dataset", "") in ("", result.get("dataset"))


def _mlflow_run(run: Any, finder: _FileFinder) -> MlflowRun:
    start, end = run.info.start_time, run.info.end_time
    return MlflowRun(
        run_id=run.info.run_id,
        name=str(run.info.run_name or ""),
        status=str(run.info.status),
        started=datetime.fromtimestamp(start / 1000, UTC).isoformat(timespec="seconds")
        if start
        else "",
        seconds=(end - start) / 1000 if start and end else None,
        tags={name: without_passwords(value) for name, value in run.data.tags.items()},
        params={name: without_passwords(value) for name, value in run.data.params.items()},
        metrics=dict(run.data.metrics),
        files=finder.files(run),
    )


def _reason(error: Exception) -> str:
    text = (without_passwords(str(error)).splitlines() or [""])[0]
    if len(text) > REASON_LENGTH:
        text = text[:REASON_LENGTH].rpartition(" ")[0] + " ..."
    return f"{type(error).__name__}: {text}".rstrip(".: ")
