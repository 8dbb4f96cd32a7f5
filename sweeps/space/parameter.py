"""One entry of a search space: what it may hold, and what is said when it holds something else."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import OverrideType
from hydra.errors import HydraException

from rgbt.checks import InputError, nearest

Choice = str | int | float | bool | None | tuple["Choice", ...]
"""What a parameter can be; lists of the file are tuples here."""

_RANGE = ("type", "low", "high", "step", "log", "when")
KEYS = {"float": _RANGE, "int": _RANGE, "categorical": ("type", "choices", "when")}
"""Keys of an entry, by its type."""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One entry of a space.

    Attributes:
        key: of the configuration: dotted, or a group such as ``loss``; as before ``=``.
        type: "float", "int" or "categorical".
        low: smallest value of a number.
        high: largest value of a number, itself possible.
        step: distance of the possible numbers; None: any float, every int.
        log: sampled uniformly on a logarithmic scale.
        choices: of a categorical, at least one.
        when: (earlier key, its values): all must hold, else the parameter is not suggested.
    """

    key: str
    type: str
    low: float = 0.0
    high: float = 0.0
    step: float | None = None
    log: bool = False
    choices: tuple[Choice, ...] = ()
    when: tuple[tuple[str, tuple[Choice, ...]], ...] = ()

    def __str__(self) -> str:
        """For a person: "masker.sigma_div: 0.5 to 32, logarithmic"."""
        words = ["one of " + " ".join(map(str, self.choices))] if self.choices else self._range()
        words += [f"when {key} is {' or '.join(map(str, wanted))}" for key, wanted in self.when]
        return f"{self.key}: {', '.join(words)}"

    def _range(self) -> list[str]:
        step = [] if self.step is None else [f"in steps of {self.step:g}"]
        return [f"{self.low:g} to {self.high:g}", *step, *(["logarithmic"] if self.log else [])]


def read_parameter(key: str, entry: Any, earlier: Mapping[str, Parameter]) -> Parameter:
    """The parameter that an entry describes.

    Args:
        key: of the entry.
        entry: mapping with the keys of `KEYS`. ``when`` maps earlier keys to a value or a list of
            values.
        earlier: parameters above it, by key.

    Raises:
        InputError: the first mistake.
    """
    if not _is_key(key):
        raise _wrong(key, "expected a key as it stands before the = of an override")
    if not isinstance(entry, Mapping):
        raise _wrong(
            key, f"expected a mapping such as {{type: float, low: 0, high: 1}}, got {entry!r}"
        )
    kind = str(entry.get("type"))
    if kind not in KEYS:
        raise _wrong(key, f"type '{kind}' is unknown; {nearest(kind, KEYS)}")
    for name in map(str, entry):
        if name not in KEYS[kind]:
            raise _wrong(key, f"'{name}' is no key of type {kind}; {nearest(name, KEYS[kind])}")
    values = _choices(key, entry) if kind == "categorical" else _range(key, kind, entry)
    return Parameter(key=key, type=kind, when=_conditions(key, entry, earlier), **values)


def _wrong(key: str, what: str) -> InputError:
    return InputError(f"search space, '{key}': {what}.")


def _is_key(key: str) -> bool:
    if not key:
        return False
    try:
        override = OverridesParser.create().parse_override(f"{key}=1")
    except HydraException:
        return False
    return override.type != OverrideType.DEL and override.get_key_element() == key


def _range(key: str, kind: str, entry: Mapping[str, Any]) -> dict[str, Any]:
    log = entry.get("log", False)
    if not isinstance(log, bool):
        raise _wrong(key, f"log is true or false, got {log!r}")
    low, high = _number(key, kind, "low", entry), _number(key, kind, "high", entry)
    if low > high:
        raise _wrong(key, f"low={low} lies above high={high}; exchange them")
    if log and low <= 0:
        raise _wrong(key, f"low={low} has no logarithm; with log: true it must be positive")
    step = None if entry.get("step") is None else _step(key, kind, entry)
    return {"low": low, "high": high, "log": log, "step": step}


def _step(key: str, kind: str, entry: Mapping[str, Any]) -> float:
    step = _number(key, kind, "step", entry)
    if entry.get("log"):
        raise _wrong(key, "step and log: true exclude each other; take one of them")
    if step <= 0:
        raise _wrong(key, f"step must be positive, got {step}")
    low, high = Decimal(str(entry["low"])), Decimal(str(entry["high"]))
    if (high - low) % Decimal(str(step)):
        raise _wrong(key, f"high={high} is no whole number of steps of {step} above low={low}")
    return step


def _number(key: str, kind: str, name: str, entry: Mapping[str, Any]) -> float:
    value = entry.get(name)
    is_whole = isinstance(value, int) and not isinstance(value, bool)
    if kind == "int" and is_whole:
        return int(entry[name])
    if kind == "float" and (is_whole or isinstance(value, float)) and math.isfinite(entry[name]):
        return float(entry[name])
    raise _wrong(key, f"{name} must be a finite {kind}, got {value!r}")


def _choices(key: str, entry: Mapping[str, Any]) -> dict[str, Any]:
    given = entry.get("choices")
    if not isinstance(given, list | tuple) or not given:
        raise _wrong(key, f"choices must be a list of at least one value, got {given!r}")
    choices = tuple(_choice(key, item) for item in given)
    # Optuna tells values apart by ==, which takes 1, 1.0 and true for one.
    twice = [choice for place, choice in enumerate(choices) if choice in choices[:place]]
    if twice:
        raise _wrong(key, f"choices hold {twice[0]!r} twice, or a value that equals it")
    return {"choices": choices}


def _choice(key: str, value: Any) -> Choice:
    if isinstance(value, list | tuple):
        return tuple(_choice(key, item) for item in value)
    if isinstance(value, float) and not math.isfinite(value):
        raise _wrong(key, f"a choice must be finite, got {value}")
    if value is None or isinstance(value, str | int | float):
        return value
    raise _wrong(key, f"a choice is a plain value or a list of them, got {value!r}")


def _conditions(
    key: str, entry: Mapping[str, Any], earlier: Mapping[str, Parameter]
) -> tuple[tuple[str, tuple[Choice, ...]], ...]:
    given = entry.get("when") or {}
    if not isinstance(given, Mapping):
        raise _wrong(key, f"when must be a mapping such as {{loss: set_criterion}}, got {given!r}")
    found = []
    for other, wanted in given.items():
        if other not in earlier:
            raise _wrong(
                key, f"when: '{other}' is no parameter above it; {nearest(other, earlier)}"
            )
        alternatives = wanted if isinstance(wanted, list | tuple) else [wanted]
        values = tuple(_choice(key, item) for item in alternatives)
        for value in values:
            _check_possible(key, earlier[other], value)
        found.append((str(other), values))
    return tuple(found)


def _check_possible(key: str, other: Parameter, value: Choice) -> None:
    """Refuse a condition that can never hold."""
    if other.type == "float":
        raise _wrong(key, f"when: '{other.key}' is a float, which hardly ever equals a value")
    if other.type == "categorical" and value not in other.choices:
        known = nearest(str(value), map(str, other.choices))
        raise _wrong(key, f"when: '{other.key}' is never {value!r}; {known}")
    if other.type == "int" and not (isinstance(value, int) and other.low <= value <= other.high):
        between = f"an int from {other.low} to {other.high}"
        raise _wrong(key, f"when: '{other.key}' is never {value!r} but {between}")
