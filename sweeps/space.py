"""What a sweep varies: points of a grid or a list, ranges of a search, samplers and pruners.

A space maps keys of the configuration to `optuna.distributions`, as in ``conf/search``::

    masker.sigma_div: {type: float, low: 0.5, high: 32, log: true}
    masker.patch_size: {type: categorical, choices: ["${px:8}", "${px:64}"]}

Samplers and pruners are nodes such as ``{_target_: optuna.samplers.TPESampler, seed: 0}``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep, Override, Quote, QuotedString
from hydra.errors import HydraException
from optuna import distributions as kinds
from optuna.pruners import BasePruner, NopPruner
from optuna.samplers import BaseSampler

from rgbt.checks import InputError, check_choice, one_line
from rgbt.config.component import Component
from rgbt.config.values import check_value
from sweeps.point import Point, Value

Distribution = kinds.FloatDistribution | kinds.IntDistribution | kinds.CategoricalDistribution
# Key of the configuration (dotted, or a group such as ``loss``) -> what Optuna samples.
Space = Mapping[str, Distribution]


def parse_space(entries: Mapping[str, Mapping[str, Any]]) -> Space:
    """Return the distributions of a space, in the order of the file.

    `entries`: key -> type (float, int, categorical) and arguments of the distribution. An
    interpolation (``${px:64}``), which the run resolves, and a list among the choices are text.
    InputError: what the distribution refuses, or choices that Optuna takes for equal.
    """
    space: dict[str, Distribution] = {}
    for key, entry in entries.items():
        path, options = f"hydra.sweeper.space.{key}", dict(entry)
        kind = str(options.pop("type", None))
        check_choice(f"{path}.type", kind, ("float", "int", "categorical"))
        if "choices" in options:
            options["choices"] = _choices(f"{path}.choices", options["choices"])
        target = f"optuna.distributions.{kind.capitalize()}Distribution"
        space[key] = build_optuna({"_target_": target, **options}, path)
    return space


def _choices(path: str, given: Any) -> list[Any]:
    choices = list[Any]()
    for value in check_value(path, given, list[Any]):
        choice = _text(value) if isinstance(value, list) else value
        # Optuna compares by ==, for which 1, 1.0 and true are equal: it would run another one.
        if choice in choices:
            raise InputError(f"'{path}': {choice!r} equals another choice.")
        choices.append(choice)
    return choices


def build_optuna(node: Mapping[str, Any], path: str) -> Any:
    """Build the object of a node; what its constructor refuses is an InputError with `path`."""
    try:
        return Component.from_node(node, path).build()
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"'{path}': {one_line(error)}.") from error


def ends(space: Space) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return overrides of the lowest and the highest point; of choices the first and the last."""
    lowest, highest = dict[str, Any](), dict[str, Any]()
    for key, distribution in space.items():
        if isinstance(distribution, kinds.CategoricalDistribution):
            lowest[key], highest[key] = distribution.choices[0], distribution.choices[-1]
        else:
            lowest[key], highest[key] = distribution.low, distribution.high
    return as_overrides(lowest), as_overrides(highest)


def as_overrides(params: Mapping[str, Any]) -> tuple[str, ...]:
    """Return ``key=value`` for every value, such that Hydra reads exactly that value.

    Text with an interpolation, and text of a list ("[48,64]"), is passed on as it is.
    """
    return tuple(f"{key}={_text(value)}" for key, value in params.items())


def _text(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list):
        return "[" + ",".join(_text(entry) for entry in value) + "]"
    if value.startswith("[") and value.endswith("]"):
        return str(value)
    try:  # whether the grammar takes the bare text as this very text, also inside a list
        is_read_back = OverridesParser.create().parse_override(f"x=[{value}]").value() == [value]
    except HydraException:
        is_read_back = False
    return value if is_read_back else QuotedString(text=value, quote=Quote.single).with_quotes()


def signature(*parts: Any) -> str:
    """Return a hash of what makes a study (12 hexadecimal digits)."""
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:12]


SweptValues = dict[str, list[str]]  # Key -> values of an override, as they stand after ``=``


def split(
    overrides: Iterable[str], config_loader: ConfigLoader | None = None
) -> tuple[tuple[str, ...], SweptValues, dict[str, dict[str, Any]]]:
    """Split the overrides of ``-m`` into single values, lists of values, and ranges.

    Like in Hydra's own sweeper, a repeated key keeps its first position and its last value.

    Returns:
        fixed overrides as typed; swept: key (with its ``+``) -> values; intervals: key -> entry of
        a search space, ``tag(log, interval(1, 8))`` on a logarithmic scale and
        ``int(interval(1, 8))`` in whole numbers. InputError: a sweep without values.
    """
    fixed: list[str] = []
    swept: SweptValues = {}
    intervals: dict[str, dict[str, Any]] = {}
    parsed = OverridesParser.create(config_loader).parse_overrides(list(overrides))
    last = {override.get_key_element(): override for override in parsed}
    for key, override in last.items():
        value = override.value()
        if not override.is_sweep_override():
            fixed.append(str(override.input_line))
        elif isinstance(value, IntervalSweep):
            if value.tags - {"log"}:
                raise InputError(f"'{override.input_line}': the only tag of an interval is log.")
            # Hydra's interval leaves out its end, which an entry of a space takes in.
            whole = isinstance(value.start, int) and isinstance(value.end, int)
            ends = {"low": value.start, "high": value.end}
            kind = "int" if whole else "float"
            intervals[key] = {"type": kind, **ends, "log": "log" in value.tags}
        else:
            swept[key] = list(override.sweep_string_iterator())
            if not swept[key]:
                raise InputError(f"'{override.input_line}' has no values; widen it.")
    return tuple(fixed), swept, intervals


def grid_points(fixed: Sequence[str], swept: SweptValues) -> list[Point]:
    """Return all combinations of the `swept` values; the last key changes fastest, as in Hydra."""
    points = []
    for values in product(*swept.values()):
        own = [f"{key}={value}" for key, value in zip(swept, values, strict=True)]
        points.append(_point(fixed, own))
    return points


def list_points(points: Sequence[Sequence[str]], fixed: Sequence[str]) -> list[Point]:
    """Return points written out one by one, so that values vary together (Hydra's issue 3082).

    A point's own override has priority over the `fixed` one of the same key.
    """
    found = []
    for own in points:
        keys = {key_of(word) for word in own}
        others = [word for word in fixed if key_of(word) not in keys]
        found.append(_point(others, own))
    return found


def key_of(override: str) -> str:
    """Return the key of an override as typed."""
    return override.partition("=")[0].lstrip("+~")


def merge_space(
    entries: Mapping[str, Mapping[str, Any]],
    fixed: Sequence[str],
    swept: SweptValues,
    intervals: Mapping[str, Mapping[str, Any]],
) -> Space:
    """Return the space of a search from a file and the command line, which has priority.

    A key that is `fixed` is not searched; `swept` values are choices.
    """
    merged = dict(entries)
    for key, texts in swept.items():
        choices = [override.value() for override in _parsed(f"{key}={text}" for text in texts)]
        merged[key] = {"type": "categorical", "choices": choices}
    merged.update(intervals)
    keys = {override.get_key_element() for override in _parsed(fixed)}
    return parse_space({key: entry for key, entry in merged.items() if key not in keys})


def _parsed(overrides: Iterable[str]) -> list[Override]:
    return OverridesParser.create().parse_overrides(list(overrides))


def _point(fixed: Sequence[str], own: Sequence[str]) -> Point:
    params: dict[str, Value] = {}
    for override in _parsed(own):
        value = override.value()
        if override.is_delete():
            continue
        if override.is_sweep_override():
            raise InputError(f"hydra.sweeper.points: '{override.input_line}' is not one value.")
        if not (value is None or isinstance(value, str | int | float)):
            value = override.get_value_element_as_str()
        params[override.get_key_element()] = value
    return Point("", (*fixed, *own), params)


# Samplers without state outside the storage: others (QMC, grid, brute force) keep a counter or
# stop the study, which a resumed search cannot share.
SAMPLERS = [f"optuna.samplers.{name}Sampler" for name in ("TPE", "Random", "GP", "NSGAII")]


def trial_seed(seed: int, number: int) -> int:
    """Return a 32-bit seed of both arguments (SHA-256), the same on every machine."""
    digest = hashlib.sha256(f"{seed}:trial:{number}".encode()).digest()
    return int.from_bytes(digest[:4], "big")


def build_sampler(node: Mapping[str, Any], number: int) -> BaseSampler:
    """Return the sampler of one trial, one of `SAMPLERS` with options of its constructor.

    Optuna's samplers draw from one generator for all trials, so that a search that is resumed would
    propose the same points again. Here every trial has a sampler of its own, whose seed follows
    from the seed of the node (0 if it has none) and the `number` of the trial.
    """
    path = "hydra.sweeper.sampler"
    check_choice(f"{path}._target_", str(node.get("_target_")), SAMPLERS)
    seed = check_value(f"{path}.seed", node.get("seed") or 0, int)
    sampler: BaseSampler = build_optuna({**node, "seed": trial_seed(seed, number)}, path)
    return sampler


def build_pruner(node: Mapping[str, Any] | None) -> BasePruner:
    """Return the pruner of a search, any of Optuna; trials report at their validation steps.

    Options such as ``n_warmup_steps`` count steps of the optimizer, not validations.
    """
    pruner: BasePruner = build_optuna(node, "hydra.sweeper.pruner") if node else NopPruner()
    return pruner
