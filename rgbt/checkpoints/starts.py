"""Published files that recipes start from (``starts.yaml``), compared with a user's file."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from pydantic import TypeAdapter

from rgbt.files.yaml_files import read_yaml


@dataclass(frozen=True, kw_only=True)
class Start:
    """A published file of weights; the attributes are those of ``starts.yaml``."""

    file: str
    trained_on: str
    origin: str
    models: tuple[str, ...]
    digest: str = ""


@dataclass(frozen=True, kw_only=True)
class SameStart:
    """Experiments that start from the same files; the attributes are those of ``starts.yaml``."""

    experiments: tuple[str, ...]
    model: str
    files: tuple[str, ...]
    source: str

    def named(self, experiments: Collection[str]) -> tuple[str, ...]:
        """Return those of all `experiments` that a pattern of this row names."""
        named = []
        for experiment in experiments:
            if any(fnmatchcase(experiment, pattern) for pattern in self.experiments):
                named.append(experiment)
        return tuple(named)


_TABLE = read_yaml(Path(__file__).with_name("starts.yaml"))
STARTS: tuple[Start, ...] = TypeAdapter(tuple[Start, ...]).validate_python(_TABLE["files"])
RECIPES: tuple[SameStart, ...] = TypeAdapter(tuple[SameStart, ...]).validate_python(
    _TABLE["recipes"]
)


def start_lines(file: str, digest: str, experiments: Collection[str]) -> Iterator[tuple[str, str]]:
    """Say which published file a file is, and what starts from it, as lines of (word, text).

    `digest` is its SHA-256 in hexadecimal; `experiments` are the names of all of them.
    """
    for start in STARTS:
        is_same = bool(start.digest) and digest.startswith(start.digest)
        if start.file != file and not is_same:
            continue
        if is_same or not start.digest:
            yield "published", f"{start.file}: {start.trained_on} ({start.origin})"
        else:
            yield "remark", f"not the published {file}, whose SHA-256 begins with {start.digest}"
        yield from (("fits", f"model={model}") for model in start.models)
        for recipe in RECIPES:
            if start.file in recipe.files:
                yield "recipes", ", ".join(recipe.named(experiments))
