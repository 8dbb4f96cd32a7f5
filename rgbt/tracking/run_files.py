"""The types of the JSON files of a run folder, and their readers.

A mapping is written with a checksum (`rgbt.files.budgets.sealed`), so that a damaged file is
refused. Older files without a checksum are checked by their types only.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NotRequired

from typing_extensions import TypedDict  # pydantic takes no other before Python 3.12

from rgbt.checks import InputError, one_line
from rgbt.files.budgets import read_json
from rgbt.tracking.tables import ResultTables

Kind = Literal["train", "val", "test"]

ADVICE = "restore it from a copy, or remove the run's folder to train it again"


class LineForm(TypedDict):
    """A line of ``metrics.jsonl`` (`rgbt.tracking.run_folder.MetricLine`)."""

    step: int
    kind: Kind
    time: float
    values: dict[str, float | None]


@dataclass(frozen=True)
class Description:
    """``run.json``: how a tracker shows the run."""

    name: str
    tags: dict[str, str]
    params: dict[str, str]


class InputForm(TypedDict):
    """A split that a run uses: its name, what for ("train", "val", "test"), number of images."""

    split: str
    context: str
    images: int


class MarkerForm(TypedDict):
    """``dataset.json``: digests of the names of the images, and of the data set's files.

    Its name, folder and splits, for trackers, are not in older files.
    """

    names: str
    files: str
    name: NotRequired[str]
    root: NotRequired[str]
    inputs: NotRequired[list[InputForm]]


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


def counts_name(split: str) -> str:
    """Name of the file of the counts that a run ended with."""
    return f"counts_{split}.npz"


def read_result(folder: Path) -> dict[str, Any] | None:
    """What the finished run in `folder` returned; None while it is not finished.

    Raises:
        InputError: the file is damaged.
    """
    found: dict[str, Any] | None = _read(folder / "result.json", ResultForm)
    return found


def read_description(folder: Path) -> Description | None:
    """``run.json``; None: there is none. InputError where it is damaged."""
    found: Description | None = _read(folder / "run.json", Description)
    return found


def read_marker(folder: Path) -> MarkerForm | None:
    """``dataset.json``; None: there is none. InputError where it is damaged."""
    found: MarkerForm | None = _read(folder / "dataset.json", MarkerForm)
    return found


def read_tables(folder: Path) -> ResultTables | None:
    """``tables.json``; None: there is none. InputError where it is damaged."""
    path = folder / "tables.json"
    plain = _read(path, dict[str, Any])
    try:
        return None if plain is None else ResultTables.from_json(plain)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is damaged ({one_line(error)}); {ADVICE}.") from error


def read_provenance(file: Path) -> list[dict[str, Any]]:
    """Entries of a ``provenance.json``, one per process, the first one first; [] without a file.

    Raises:
        InputError: the file is damaged.
    """
    return _read(file, list[dict[str, Any]]) or []


def _read(path: Path, form: Any) -> Any:
    return read_json(path, form, ADVICE) if path.exists() else None
