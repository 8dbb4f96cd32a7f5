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
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException
from omegaconf import OmegaConf

from sweeps.space.parameter import Choice, Parameter, read_parameter

if TYPE_CHECKING:
    from optuna.trial import BaseTrial

__all__ = ["Choice", "Parameter", "as_overrides", "parse_space", "signature", "suggest"]


def parse_space(space: Mapping[str, Any]) -> tuple[Parameter, ...]:
    """The parameters of a space, in the order of the file.

    Args:
        space: key -> entry, see `sweeps.space.parameter.read_parameter`. Interpolations are kept as
            text: ``${px:64}`` is resolved by the run that gets it.

    Raises:
        InputError: the first mistake: an unknown type or key, a range that is none, no choices, a
            condition on a parameter that is not above it.
    """
    parameters: dict[str, Parameter] = {}
    for key, entry in plain_space(space).items():
        parameters[str(key)] = read_parameter(str(key), entry, parameters)
    return tuple(parameters.values())


def plain_space(space: Mapping[str, Any]) -> dict[str, Any]:
    """`space` without OmegaConf's containers, interpolations as text."""
    whole = OmegaConf.to_container(space) if OmegaConf.is_config(space) else space
    assert isinstance(whole, Mapping)
    return dict(whole)


def suggest(trial: BaseTrial, parameters: tuple[Parameter, ...]) -> dict[str, Choice]:
    """Values of a trial, by key: of those parameters whose conditions hold.

    Optuna gets lists among the choices as text, because its storages hold plain values.
    """
    values: dict[str, Choice] = {}
    for parameter in parameters:
        if all(key in values and values[key] in wanted for key, wanted in parameter.when):
            values[parameter.key] = _suggested(trial, parameter)
    return values


def _suggested(trial: BaseTrial, parameter: Parameter) -> Choice:
    key, low, high, step = parameter.key, parameter.low, parameter.high, parameter.step
    if parameter.type == "float":
        return trial.suggest_float(key, low, high, step=step, log=parameter.log)
    if parameter.type == "int":
        return trial.suggest_int(key, int(low), int(high), step=int(step or 1), log=parameter.log)
    by_label = {_label(choice): choice for choice in parameter.choices}
    return by_label[trial.suggest_categorical(key, tuple(by_label))]


def _label(choice: Choice) -> str | int | float | bool | None:
    return _text(choice) if isinstance(choice, tuple) else choice


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
    quoted = QuotedString(text=value, quote=Quote.single).with_quotes()
    return value if _reads_back(value) else quoted


def _reads_back(text: str) -> bool:
    """Whether the grammar takes bare `text` as this very text, also inside a list."""
    try:
        return bool(OverridesParser.create().parse_override(f"x=[{text}]").value() == [text])
    except HydraException:
        return False


def signature(parameters: tuple[Parameter, ...], *more: Any) -> str:
    """Hash of a space (12 hexadecimal digits), independent of the order of its parameters.

    Args:
        parameters: the space.
        more: other constants of a study, such as its objectives: plain values, dataclasses.
    """
    ordered = sorted((asdict(parameter) for parameter in parameters), key=lambda one: one["key"])
    text = json.dumps([ordered, more], sort_keys=True, default=asdict)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
