"""The options of the command."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.benchmarks.gpu.steps import STEPS

USAGE = (
    "python -m tests.benchmarks.gpu out=FOLDER [minutes=8] [data=FOLDER] [device=cuda|cpu] "
    "[size=full|smoke] [steps=machine,tests,...]"
)
DEVICES = ("cuda", "cpu")
SIZES = ("full", "smoke")
MOST_MINUTES = 24 * 60


class UsageError(Exception):
    """A mistake in the options, as one sentence."""


@dataclass(frozen=True)
class Request:
    """What to measure.

    Attributes:
        out: folder of the results; made if it does not exist.
        minutes: limit of the whole command.
        data: folder of MFNet; None: images are written to a temporary folder.
        device: "cuda", or "cpu" to try the command without a GPU.
        size: "full", or "smoke" for the smallest sizes.
        steps: names of the steps to run, in the order of the table.
    """

    out: Path
    minutes: float = 8.0
    data: Path | None = None
    device: str = "cuda"
    size: str = "full"
    steps: tuple[str, ...] = tuple(step.name for step in STEPS)


def request_of(words: Sequence[str]) -> Request:
    """The request of the words of a command line.

    Raises:
        UsageError: an unknown or repeated option, or a value that does not fit.
    """
    given: dict[str, str] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals or name not in Request.__dataclass_fields__:
            raise UsageError(f"unknown option {shlex.quote(word)}; usage: {USAGE}")
        if name in given:
            raise UsageError(f"{name} is given twice; give it once.")
        if not value:
            raise UsageError(f"{name} has no value; usage: {USAGE}")
        given[name] = value
    if "out" not in given:
        raise UsageError(f"out has no value; name the folder of the results: {USAGE}")
    return Request(
        out=_folder(given["out"]),
        minutes=_minutes(given.get("minutes", "8")),
        data=_data(given.get("data")),
        device=_choice("device", given.get("device", DEVICES[0]), DEVICES),
        size=_choice("size", given.get("size", SIZES[0]), SIZES),
        steps=_steps(given.get("steps")),
    )


def _folder(value: str) -> Path:
    path = Path(value)
    if path.exists() and not path.is_dir():
        raise UsageError(f"out={value} is a file; name a folder, which may not exist yet.")
    return path


def _minutes(value: str) -> float:
    try:
        minutes = float(value)
    except ValueError:
        minutes = 0.0
    if not 0 < minutes <= MOST_MINUTES:
        raise UsageError(f"minutes must be a number above 0, at most {MOST_MINUTES}, got {value}.")
    return minutes


def _data(value: str | None) -> Path | None:
    if value is None:
        return None
    path = Path(value)
    if not (path / "train.txt").is_file():
        raise UsageError(
            f"data={value} does not contain train.txt; name a folder of MFNet, or omit data=... to "
            "measure with synthetic images."
        )
    return path.resolve()


def _choice(name: str, value: str, choices: tuple[str, ...]) -> str:
    if value not in choices:
        raise UsageError(f"{name} must be {' or '.join(choices)}, got {value}.")
    return value


def _steps(value: str | None) -> tuple[str, ...]:
    known = [step.name for step in STEPS]
    if value is None:
        return tuple(known)
    chosen = value.split(",")
    unknown = [name for name in chosen if name not in known]
    if unknown:
        raise UsageError(f"there is no step '{unknown[0]}'; steps: {', '.join(known)}.")
    return tuple(name for name in known if name in chosen)
