"""Reads `results.yaml`: what the results pages say beside the numbers of the store."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal

from rgbt.files.yaml_files import read_yaml
from sweeps.table.cells import OWN_COUNTS
from sweeps.table.claim import STRICT

FILE = Path(__file__).with_name("results.yaml")


@dataclass(frozen=True, kw_only=True)
class Paper:
    """Title and reference of a page of tables."""

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    title: str
    reference: str


@dataclass(frozen=True, kw_only=True)
class Contrast:
    """Two groups of runs to compare.

    Attributes:
        reference: group that the method is compared against.
        method: the other group.
        expected: metric -> the score of the method against that of the reference.
        counts: path of the counts in a run folder.
        options: of `rgbt compare`, to read the same counts; "" for the run's own.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    question: str
    source: str
    reference: str
    method: str
    expected: Mapping[str, Literal["higher", "lower"]]
    counts: str = OWN_COUNTS
    options: str = ""


@dataclass(frozen=True, kw_only=True)
class Network:
    """A network with its sizes.

    Attributes:
        models: files of ``conf/model``, with further overrides of the network.
        overrides: of all its sizes: the data set whose classes are counted.
        weights: (file that fits, address of its authors' page).
        tests: files of tests of its arithmetic.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    name: str
    models: tuple[str, ...]
    overrides: tuple[str, ...] = ()
    weights: tuple[tuple[str, str], ...]
    tests: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class ResultsFile:
    """The whole file."""

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    papers: Mapping[str, Paper] = field(default_factory=dict)
    contrasts: tuple[Contrast, ...] = ()
    networks: tuple[Network, ...] = ()


@cache
def load_results_file(path: Path = FILE) -> ResultsFile:
    """Read and check the file, which is part of the package."""
    import pydantic

    return pydantic.TypeAdapter(ResultsFile).validate_python(read_yaml(path))
