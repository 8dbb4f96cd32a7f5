"""Overrides that give another command the data set and the regions of a table's rows."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, TypedDict

import hydra
from omegaconf import DictConfig, OmegaConf

from rgbt.config.command import composing
from rgbt.config.component import build
from rgbt.config.compose import compose, flatten, own_folders, own_hydra
from rgbt.metrics.metric import Regions
from sweeps.table.table import Form, Table

GROUPS = ("dataset", "metric")
PLAIN_WORD = re.compile(r"[A-Za-z_/~.][\w/~.-]*")
"""A text that Hydra reads as it is, without quotes."""
OTHER_VALUES = ("null", "true", "false", "nan", "inf")
"""Texts that Hydra reads as another value than a text."""


class Settings(TypedDict):
    """How the rows of a table are run.

    Attributes:
        scale: "demo" or "paper".
        form: "paper" or "released".
        extra: overrides of the user, which win over those of the rows.
        base: overrides that all runs have.
    """

    scale: str
    form: Form
    extra: Sequence[str]
    base: Sequence[str]


@dataclass(frozen=True)
class TableData:
    """The data set that the rows of a table are evaluated on.

    Attributes:
        config: composed configuration of a row.
        files: group ("dataset", "metric") -> its file, e.g. "mfnet".
        fingerprint: of the data set.
    """

    config: DictConfig
    files: Mapping[str, str]
    fingerprint: str

    def values(self, group: str) -> dict[str, Any]:
        """Plain values of a group by dotted key."""
        return _leaves(self.config[group])

    def words(self, group: str, scale: str) -> list[str]:
        """Overrides of the whole group in a command that composes at `scale`."""
        chosen = f"{group}={self.files[group]}"
        default = _default(scale, group, self.files[group], own_folders())
        changed = {
            key: value
            for key, value in self.values(group).items()
            if key not in default or default[key] != value
        }
        new = {key: "" if key in default else "+" for key in changed}
        return [
            chosen,
            *(f"{new[key]}{group}.{key}={as_typed(value)}" for key, value in changed.items()),
        ]

    def regions(self, name: str) -> Regions:
        """The partition of a file of ``conf/metric``; "as trained": that of the rows."""
        node = self.config.metric if name == "as trained" else compose([f"metric={name}"]).metric
        regions: Regions = build(node)
        return regions


def data_of(table: Table, settings: Settings) -> TableData:
    """The data set of the first row that can be run; without one, that of the overrides.

    Raises:
        InputError: overrides that Hydra refuses, or a data set that cannot be read.
    """
    scale, form = settings["scale"], settings["form"]
    rows = table.runnable_rows
    words = table.overrides(rows[0], scale, form) if rows else table.at.get(scale, ())
    first, others = (words[:1], words[1:]) if rows else ((), words)
    every = [*settings["base"], *first, f"scale={scale}", *others, *settings["extra"]]
    with composing(every):
        with own_hydra():
            config = hydra.compose("config", every, return_hydra_config=True)
        files = {group: str(config.hydra.runtime.choices[group]) for group in GROUPS}
        dataset: Any = build(config.dataset)
    return TableData(config, files, str(dataset.fingerprint()))


@cache
def _default(scale: str, group: str, file: str, _own: str) -> dict[str, Any]:
    """Values of a file of a group; cached, because Hydra takes a third of a second."""
    return _leaves(compose([f"scale={scale}", f"{group}={file}"])[group])


def _leaves(node: DictConfig) -> dict[str, Any]:
    plain: Any = OmegaConf.to_container(node, resolve=True)
    return flatten(plain)


def as_typed(value: Any) -> str:
    """A value as an override of Hydra: texts in quotes where they need them.

    Examples:
        >>> as_typed("/data/MF net"), as_typed([1, "a"]), as_typed(None)
        ("'/data/MF net'", "[1,'a']", 'null')
    """
    if isinstance(value, str):
        if PLAIN_WORD.fullmatch(value) and value.lower() not in OTHER_VALUES:
            return value
        # Hydra reads a backslash as an escape only in front of a quote.
        return "'" + re.sub(r"(\\+)(?='|$)", r"\1\1", value).replace("'", "\\'") + "'"
    if isinstance(value, list | tuple):
        return f"[{','.join(map(as_typed, value))}]"
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{as_typed(each)}" for key, each in value.items()) + "}"
    return json.dumps(value)
