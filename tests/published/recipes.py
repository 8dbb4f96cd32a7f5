"""The table of published settings: every key of every recipe with its value and its source.

The files of this folder are the table. `sections` list rows that hold for `experiments`:

    key       key of the composed configuration at scale=paper; `_target_` stands for its class.
    paper     [value, place in the paper]
    release   [value, place in the code that the authors published]
    ours      [value, reason], where neither has a value or the experiment decides otherwise
    for, skip experiments of the section that the row holds for, as patterns
    use       the side that the experiments have, if the sides differ: a name, or patterns by name

An experiment with overrides, such as "crm masker=square", has the rows of its experiment, except
those that it has itself. `unpublished` lists keys that need no source, with the reason.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from rgbt.files.yaml_files import _Loader

FOLDER = Path(__file__).parent
FILES = ("crm", "networks", "cmnext", "dinov2", "thesis", "self_training", "data", "run")
SIDES = ("paper", "release", "ours")
ROW_KEYS = {"key", "for", "skip", "use", *SIDES}


@dataclass(frozen=True)
class Side:
    """One source of a value, and its place there; of "ours": the reason."""

    value: Any
    place: str


@dataclass(frozen=True)
class Row:
    """A key, its value by source, and the source that each experiment uses."""

    key: str
    sides: Mapping[str, Side]
    used: Mapping[str, str]  # experiment -> name of the side

    def value(self, experiment: str) -> Any:
        """The value that the configuration of an experiment must have."""
        return self.sides[self.used[experiment]].value


@dataclass(frozen=True)
class Section:
    """Rows of one subject; `group` is the title of its file."""

    group: str
    title: str
    about: str
    experiments: tuple[str, ...]
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Unpublished:
    """Keys that need no source, and why; `experiments` is empty where it holds for all."""

    name: str
    reason: str
    keys: tuple[str, ...]
    experiments: tuple[str, ...]


@cache
def sections() -> tuple[Section, ...]:
    """All sections, in the order of `FILES`."""
    files = [_file(name) for name in FILES]
    return tuple(_section(file["title"], each) for file in files for each in file["sections"])


@cache
def unpublished() -> tuple[Unpublished, ...]:
    """All groups of keys without a source."""
    return tuple(
        Unpublished(
            each["name"], each["reason"], tuple(each["keys"]), _flat(each.get("experiments", []))
        )
        for name in FILES
        for each in _file(name).get("unpublished", [])
    )


@cache
def missing() -> dict[str, str]:
    """What keeps a user from the printed number, by experiment."""
    return dict(_file("missing"))


def entries() -> list[str]:
    """Every experiment of the table, also those with overrides."""
    return sorted({name for section in sections() for name in section.experiments})


def words(entry: str) -> tuple[str, ...]:
    """The command line of an entry: "crm masker=square"."""
    experiment, *overrides = entry.split()
    return (f"+experiment={experiment}", *overrides)


def rows_of(entry: str) -> dict[str, Row]:
    """The rows that name an entry itself, by key.

    Raises:
        ValueError: two rows of one key.
    """
    found: dict[str, Row] = {}
    named = ((part, row) for part in sections() for row in part.rows if entry in row.used)
    for section, row in named:
        if row.key in found:
            raise ValueError(f"{entry}: two rows of {row.key}, one in '{section.title}'")
        found[row.key] = row
    return found


def flattened(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Keys and values of a configuration; a class is named without its modules."""
    for key, value in node.items():
        if isinstance(value, Mapping):
            yield from flattened(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value.rpartition(".")[2] if key == "_target_" else value


class _WithAliases(_Loader):
    """Reads aliases, which strangers' files may not have: several sections share experiments."""

    construct_object = _Loader.__mro__[1].construct_object


def _file(name: str) -> Any:
    return yaml.load((FOLDER / f"{name}.yaml").read_text(), _WithAliases)  # noqa: S506


def _section(group: str, text: Mapping[str, Any]) -> Section:
    experiments = _flat(text["experiments"])
    rows = tuple(_row(each, experiments, text["title"]) for each in text["rows"])
    return Section(group, text["title"], text.get("about", ""), experiments, rows)


def _row(text: Mapping[str, Any], experiments: Sequence[str], title: str) -> Row:
    place = f"{title}: {text.get('key')}"
    if unknown := set(text) - ROW_KEYS:
        raise ValueError(f"{place}: unknown words {sorted(unknown)}")
    sides = {name: Side(*text[name]) for name in SIDES if name in text}
    skipped = _matching(experiments, text.get("skip", []), place)
    chosen = _matching(experiments, text.get("for", ["*"]), place) - skipped
    named = [name for name in experiments if name in chosen]
    used = {name: _side(name, text.get("use"), sides, place) for name in named}
    return Row(text["key"], sides, used)


def _matching(experiments: Iterable[str], patterns: Sequence[str], place: str) -> set[str]:
    found: set[str] = set()
    for pattern in patterns:
        names = {name for name in experiments if fnmatchcase(name, pattern)}
        if not names:
            raise ValueError(f"{place}: no experiment of the section is called '{pattern}'")
        found |= names
    return found


def _side(experiment: str, use: Any, sides: Mapping[str, Side], place: str) -> str:
    if use is None:
        values = [side.value for side in sides.values()]
        if not values or any(value != values[0] for value in values):
            raise ValueError(f"{place}: the sides differ; `use` says which one counts")
        return next(iter(sides))
    by_side = {use: ["*"]} if isinstance(use, str) else use
    fitting = (
        name
        for name, patterns in by_side.items()
        if any(fnmatchcase(experiment, p) for p in patterns)
    )
    side = next(fitting, None)
    if side is None:
        raise ValueError(f"{place}: `use` says nothing about {experiment}")
    if side not in sides:
        raise ValueError(f"{place}: `use` names '{side}', which has no value")
    return str(side)


def _flat(names: Iterable[Any]) -> tuple[str, ...]:
    """Names of a list that may have lists in it."""
    nested = ([each] if isinstance(each, str) else each for each in names)
    return tuple(name for part in nested for name in part)
