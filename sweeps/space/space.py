"""Search spaces: read from a file, sampled by Optuna, passed to Hydra as overrides.

A space maps keys of the configuration to their ranges or choices, as in ``conf/search``::

    masker.sigma_div: {type: float, low: 0.5, high: 32, log: true}
    masker.patch_size: {type: categorical, choices: ["${px:8}", "${px:64}"]}
    loss: {type: categorical, choices: [set_criterion, set_criterion_spatial]}
    loss.spatial.alpha: {type: float, low: 0, high: 3, when: {loss: set_criterion_spatial}}
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from decimal import Decimal
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import OverrideType, Quote, QuotedString
from hydra.errors import HydraException
from omegaconf import OmegaConf

from rgbt.checks import InputError, nearest

if TYPE_CHECKING:
    from optuna.trial import BaseTrial

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
        """As shown: "masker.sigma_div: 0.5 to 32, logarithmic"."""
        if self.choices:
            words = ["one of " + " ".join(map(str, self.choices))]
        else:
            words = [f"{self.low:g} to {self.high:g}"]
            words += [] if self.step is None else [f"in steps of {self.step:g}"]
            words += ["logarithmic"] if self.log else []
        words += [f"when {key} is {' or '.join(map(str, wanted))}" for key, wanted in self.when]
        return f"{self.key}: {', '.join(words)}"


def parse_space(space: Mapping[str, Any]) -> tuple[Parameter, ...]:
    """The parameters of a space, in the order of the file.

    Args:
        space: key -> mapping with the keys of `KEYS`; ``when`` maps earlier keys to a value or a
            list of values. Interpolations are kept as text: ``${px:64}`` is resolved by the run
            that gets it.

    Raises:
        InputError: the first mistake: an unknown type or key, a range that is none, no choices, a
            condition on a parameter that is not above it.
    """
    parameters: dict[str, Parameter] = {}
    for name, entry in plain_space(space).items():
        key = str(name)
        if not _is_key(key):
            raise _wrong(key, "expected a key such as masker.sigma_div")
        if not isinstance(entry, Mapping):
            example = "{type: float, low: 0, high: 1}"
            raise _wrong(key, f"expected a mapping such as {example}, got {entry!r}")
        kind = str(entry.get("type"))
        if kind not in KEYS:
            raise _wrong(key, f"type '{kind}' is unknown; {nearest(kind, KEYS)}")
        for word in map(str, entry):
            if word not in KEYS[kind]:
                raise _wrong(
                    key, f"'{word}' is not a key of type {kind}; {nearest(word, KEYS[kind])}"
                )
        values = _choices(key, entry) if kind == "categorical" else _range(key, kind, entry)
        when = _conditions(key, entry.get("when") or {}, parameters)
        parameters[key] = Parameter(key=key, type=kind, when=when, **values)
    return tuple(parameters.values())


def plain_space(space: Mapping[str, Any]) -> dict[str, Any]:
    """`space` without OmegaConf's containers, interpolations as text."""
    whole = OmegaConf.to_container(space) if OmegaConf.is_config(space) else space
    assert isinstance(whole, Mapping)
    return dict(whole)


def _wrong(key: str, what: str) -> InputError:
    return InputError(f"search space, '{key}': {what}.")


def _is_key(key: str) -> bool:
    try:
        override = OverridesParser.create().parse_override(f"{key}=1")
    except HydraException:
        return False
    return bool(key) and override.type != OverrideType.DEL and override.get_key_element() == key


def _range(key: str, kind: str, entry: Mapping[str, Any]) -> dict[str, Any]:
    log = entry.get("log", False)
    if not isinstance(log, bool):
        raise _wrong(key, f"log must be true or false, got {log!r}")
    low, high = (_number(key, kind, end, entry.get(end)) for end in ("low", "high"))
    if low > high:
        raise _wrong(key, f"low={low} is greater than high={high}; exchange them")
    if log and low <= 0:
        raise _wrong(key, f"low={low} has no logarithm; with log: true it must be positive")
    step = entry.get("step")
    if step is not None:
        step = _number(key, kind, "step", step)
        if log:
            raise _wrong(key, "step and log: true exclude each other; use one of them")
        if step <= 0:
            raise _wrong(key, f"step must be positive, got {step}")
        first, last = Decimal(str(entry["low"])), Decimal(str(entry["high"]))
        if (last - first) % Decimal(str(step)):
            raise _wrong(
                key, f"high={last} is not a whole number of steps of {step} above low={first}"
            )
    return {"low": low, "high": high, "log": log, "step": step}


def _number(key: str, kind: str, name: str, value: Any) -> float:
    is_whole = isinstance(value, int) and not isinstance(value, bool)
    if kind == "int" and is_whole:
        return int(value)
    if kind == "float" and (is_whole or isinstance(value, float)) and math.isfinite(value):
        return float(value)
    raise _wrong(key, f"{name} must be a finite {kind}, got {value!r}")


def _choices(key: str, entry: Mapping[str, Any]) -> dict[str, Any]:
    given = entry.get("choices")
    if not isinstance(given, list | tuple) or not given:
        raise _wrong(key, f"choices must be a list of at least one value, got {given!r}")
    choices = tuple(_choice(key, item) for item in given)
    # Optuna compares values by ==, for which 1, 1.0 and true are equal.
    twice = [choice for place, choice in enumerate(choices) if choice in choices[:place]]
    if twice:
        raise _wrong(key, f"choices contain {twice[0]!r} twice, or a value that equals it")
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
    key: str, given: Any, earlier: Mapping[str, Parameter]
) -> tuple[tuple[str, tuple[Choice, ...]], ...]:
    """The conditions of an entry; one that can never hold is refused."""
    if not isinstance(given, Mapping):
        raise _wrong(key, f"when must be a mapping such as {{loss: set_criterion}}, got {given!r}")
    conditions = []
    for name, wanted in given.items():
        if name not in earlier:
            known = nearest(name, earlier)
            raise _wrong(key, f"when: '{name}' is not a parameter above it; {known}")
        other = earlier[name]
        alternatives = wanted if isinstance(wanted, list | tuple) else [wanted]
        values = tuple(_choice(key, item) for item in alternatives)
        for value in values:
            if other.type == "float":
                raise _wrong(
                    key, f"when: '{name}' is a float, which almost never equals a given value"
                )
            if other.type == "categorical" and value not in other.choices:
                known = nearest(str(value), map(str, other.choices))
                raise _wrong(key, f"when: '{name}' is never {value!r}; {known}")
            is_inside = isinstance(value, int) and other.low <= value <= other.high
            if other.type == "int" and not is_inside:
                between = f"an int from {other.low} to {other.high}"
                raise _wrong(key, f"when: '{name}' is never {value!r} but {between}")
        conditions.append((str(name), values))
    return tuple(conditions)


def suggest(trial: BaseTrial, parameters: tuple[Parameter, ...]) -> dict[str, Choice]:
    """Values of a trial, by key: of those parameters whose conditions hold.

    Optuna gets lists among the choices as text, because its storages hold plain values.
    """
    values: dict[str, Choice] = {}
    for each in parameters:
        if not all(key in values and values[key] in wanted for key, wanted in each.when):
            continue
        key, low, high, step = each.key, each.low, each.high, each.step
        if each.type == "float":
            values[key] = trial.suggest_float(key, low, high, step=step, log=each.log)
        elif each.type == "int":
            whole = int(step or 1)
            values[key] = trial.suggest_int(key, int(low), int(high), step=whole, log=each.log)
        else:
            labels = [_text(one) if isinstance(one, tuple) else one for one in each.choices]
            chosen = trial.suggest_categorical(key, tuple(labels))
            values[key] = dict(zip(labels, each.choices, strict=True))[chosen]
    return values


def as_overrides(params: Mapping[str, Any]) -> tuple[str, ...]:
    """``key=value`` for every value, such that Hydra reads exactly that value.

    Args:
        params: None, booleans, numbers, texts or lists of these, by key. Text with an
            interpolation is passed on as it is.
    """
    return tuple(f"{key}={_text(value)}" for key, value in params.items())


def _text(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return "[" + ",".join(_text(item) for item in value) + "]"
    try:  # whether the grammar takes the bare text as this very text, also inside a list
        is_read_back = OverridesParser.create().parse_override(f"x=[{value}]").value() == [value]
    except HydraException:
        is_read_back = False
    return value if is_read_back else QuotedString(text=value, quote=Quote.single).with_quotes()


def signature(parameters: tuple[Parameter, ...], *more: Any) -> str:
    """Hash of a space (12 hexadecimal digits), independent of the order of its parameters.

    Args:
        parameters: the space.
        more: other constants of a study, such as its objectives: plain values, dataclasses.
    """
    ordered = sorted((asdict(parameter) for parameter in parameters), key=lambda one: one["key"])
    text = json.dumps([ordered, more], sort_keys=True, default=asdict)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
