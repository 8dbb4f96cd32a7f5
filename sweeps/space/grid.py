"""Points that a command line or a file names one by one: grids and lists."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep, Override, Sweep

from rgbt.checks import InputError, nearest
from sweeps.point import Value

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

SweptValues = dict[str, list[str]]
"""Key -> values of an override, as they may stand after ``=``."""


@dataclass(frozen=True)
class GridPoint:
    """One point of a grid or a list.

    Attributes:
        params: what is particular to it: key -> value as Hydra reads it, lists and mappings as
            they were typed.
        overrides: all that make it, the fixed ones first.
    """

    params: Mapping[str, Value]
    overrides: tuple[str, ...]


def split(
    overrides: Iterable[str], config_loader: ConfigLoader
) -> tuple[tuple[str, ...], SweptValues, dict[str, dict[str, Any]]]:
    """Sort the overrides of ``-m`` by what they say: one value, several, or a range.

    As with Hydra's own sweeper a key that comes twice counts where it came first, with what it
    said last.

    Args:
        overrides: as typed, e.g. ``["+experiment=grbm", "masker.sigma_div=1,2", "seed=0,1"]``.
        config_loader: answers ``model=glob(*)``.

    Returns:
        fixed overrides as typed; swept: key (with its ``+``) -> values; intervals: key -> entry of
        a search space, ``tag(log, interval(1, 8))`` on a logarithmic scale and
        ``int(interval(1, 8))`` in whole numbers.

    Raises:
        InputError: a sweep without values, a tag that means nothing.
    """
    last = {one.get_key_element(): one for one in _parsed(overrides, config_loader)}
    fixed = tuple(_typed(one) for one in last.values() if not one.is_sweep_override())
    swept = {key: _values(one) for key, one in last.items() if one.is_discrete_sweep()}
    intervals = {key: _interval(one) for key, one in last.items() if one.is_interval_sweep()}
    return fixed, swept, intervals


def grid_points(fixed: Sequence[str], swept: SweptValues) -> list[GridPoint]:
    """All combinations, in Hydra's order: the last key changes fastest.

    Args:
        fixed: overrides of every point.
        swept: as `split` returns it; empty: the one point that `fixed` makes.
    """
    return [
        _point(fixed, [f"{key}={value}" for key, value in zip(swept, values, strict=True)])
        for values in product(*swept.values())
    ]


def list_points(points: Sequence[Sequence[str]], fixed: Sequence[str]) -> list[GridPoint]:
    """Points that are written out, so that values go in pairs (Hydra's issue 3082).

    Args:
        points: the overrides of each.
        fixed: overrides of every point; where a point says the same key, the point's counts.

    Raises:
        InputError: a point without overrides, or one that is a sweep itself.
    """
    found = []
    for own in points:
        parsed = _parsed(own)
        sweeps = [_typed(one) for one in parsed if one.is_sweep_override()]
        if sweeps:
            raise InputError(
                f"points: '{sweeps[0]}' has several values; a point has one of each, write it out "
                "once per value."
            )
        if not parsed:
            raise InputError("points: a point needs at least one override; take out the empty one.")
        taken = {_bare(one) for one in parsed}
        others = [_typed(one) for one in _parsed(fixed) if _bare(one) not in taken]
        found.append(_point(others, own))
    return found


def distributions(points: Sequence[GridPoint]) -> dict[str, BaseDistribution]:
    """What Optuna is told of the parameters of a grid or a list, so that it can draw them.

    Numbers are ranges, which Optuna lets grow in a study; other choices it does not.
    """
    values: dict[str, list[Value]] = {}
    for key, value in (pair for point in points for pair in point.params.items()):
        values.setdefault(key, []).append(value)
    return {key: _distribution(seen) for key, seen in values.items()}


def _distribution(seen: Sequence[Value]) -> BaseDistribution:
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    numbers = [one for one in seen if isinstance(one, int | float) and not isinstance(one, bool)]
    if len(numbers) < len(seen):
        return CategoricalDistribution(tuple(dict.fromkeys(seen)))
    if all(isinstance(one, int) for one in numbers):
        return IntDistribution(int(min(numbers)), int(max(numbers)))
    return FloatDistribution(min(numbers), max(numbers))


def _parsed(overrides: Iterable[str], config_loader: ConfigLoader | None = None) -> list[Override]:
    return OverridesParser.create(config_loader).parse_overrides(list(overrides))


def _typed(override: Override) -> str:
    assert override.input_line is not None, "the parser keeps what it read"
    return override.input_line


def _bare(override: Override) -> str:
    return override.get_key_element().lstrip("+~")


def _point(fixed: Sequence[str], own: Sequence[str]) -> GridPoint:
    parsed = [one for one in _parsed(own) if not one.is_delete()]
    params = {one.get_key_element(): _plain(one) for one in parsed}
    return GridPoint(params, (*fixed, *own))


def _plain(override: Override) -> Value:
    value = override.value()
    if value is None or isinstance(value, str | int | float):
        return value
    return override.get_value_element_as_str()


def _values(override: Override) -> list[str]:
    values = list(override.sweep_string_iterator())
    if not values:
        raise InputError(f"'{_typed(override)}' has no values; widen it.")
    _check_tags(override, ())
    return values


def _interval(override: Override) -> dict[str, Any]:
    """Entry of a search space; Hydra's interval leaves out its end, which an entry takes in."""
    _check_tags(override, ("log",))
    value = override.value()
    assert isinstance(value, IntervalSweep)
    whole = isinstance(value.start, int) and isinstance(value.end, int)
    kind = "int" if whole else "float"
    return {"type": kind, "low": value.start, "high": value.end, "log": "log" in value.tags}


def _check_tags(override: Override, known: Sequence[str]) -> None:
    value = override.value()
    for tag in sorted(value.tags) if isinstance(value, Sweep) else ():
        if tag not in known:
            hint = nearest(tag, known) if known else "tags are for interval() alone"
            raise InputError(f"'{_typed(override)}': tag '{tag}' means nothing; {hint}.")
