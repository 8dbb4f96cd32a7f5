"""The JSON files of a run folder: which keys of which types each of them holds, and their readers.

A mapping is written with a check sum (`rgbt.files.budgets.sealed`), so that a damaged file is
refused and gives no other value. Files of before there was one are read by their types alone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, Required

from typing_extensions import TypedDict  # pydantic takes no other before Python 3.12

from rgbt.files.budgets import read_json

Kind = Literal["train", "val", "test"]

ADVICE = "restore it from a copy, or remove the run's folder to train it again"


class LineForm(TypedDict):
    """A line of ``metrics.jsonl`` (`rgbt.tracking.run_folder.MetricLine`)."""

    step: int
    kind: Kind
    time: float
    values: dict[str, float | None]


class DescriptionForm(TypedDict):
    """``run.json`` (`rgbt.tracking.run_folder.Description`)."""

    name: str
    tags: dict[str, str]
    params: dict[str, str]


class MarkerForm(TypedDict):
    """``dataset.json``: digests of the names of the images, and of the data set's files."""

    names: str
    files: str


class ResultForm(TypedDict, total=False):
    """``result.json`` (`rgbt.training.train`)."""

    name: str
    key: str
    dataset: str
    steps: int
    best_step: int
    best_score: float
    seconds_of_last_process: float
    skipped: list[str]
    val: dict[str, float | None]
    test: dict[str, float | None]


class SentForm(TypedDict, total=False):
    """``mlflow.json`` (`rgbt.tracking.mlflow_upload.UploadState`)."""

    uri: Required[str]
    experiment: Required[str]
    artifact_uri: str | None
    experiment_id: str
    run_id: str
    steps: dict[str, int]
    files: dict[str, str]
    profile: bool
    later: list[str]


def read_result(folder: Path) -> dict[str, Any] | None:
    """What the finished run in `folder` returned; None while it is not finished.

    Raises:
        InputError: the file is damaged.
    """
    return _read(folder / "result.json", ResultForm)


def read_description(folder: Path) -> dict[str, Any] | None:
    """``run.json``; None: there is none. InputError where it is damaged."""
    return _read(folder / "run.json", DescriptionForm)


def read_marker(folder: Path) -> dict[str, Any] | None:
    """``dataset.json``; None: there is none. InputError where it is damaged."""
    return _read(folder / "dataset.json", MarkerForm)


def read_tables(folder: Path) -> dict[str, Any] | None:
    """``tables.json``; None: there is none. InputError where it is damaged."""
    return _read(folder / "tables.json", dict[str, Any])


def read_provenance(file: Path) -> list[dict[str, Any]]:
    """Entries of a ``provenance.json``, one per process; [] where there is no such file.

    Raises:
        InputError: the file is damaged.
    """
    found: list[dict[str, Any]] = []
    if file.exists():
        found = read_json(file, list[dict[str, Any]], ADVICE)
    return found


def _read(path: Path, form: Any) -> dict[str, Any] | None:
    found: dict[str, Any] | None = read_json(path, form, ADVICE) if path.exists() else None
    return found
