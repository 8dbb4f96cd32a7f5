"""Points of a grid or a list, and ranges of a search, from a command line and a file."""

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
from sweeps.space.space import Parameter, parse_space, plain_space

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

SweptValues = dict[str, list[str]]
"""Key -> values of an override, as they may stand after ``=``."""


@dataclass(frozen=True)
class GridPoint:
    """One point of a grid or a list.

    Attributes:
        params: varied keys -> values as Hydra reads them, lists and mappings as they were typed.
        overrides: all that make it, the fixed ones first.
    """

    params: Mapping[str, Value]
    overrides: tuple[str, ...]


def split(
    overrides: Iterable[str], config_loader: ConfigLoader
) -> tuple[tuple[str, ...], SweptValues, dict[str, dict[str, Any]]]:
    """Split the overrides of ``-m`` into single values, lists of values, and ranges.

    Like in Hydra's own sweeper, a repeated key keeps its first position and its last
    value.

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
    swept: SweptValues = {}
    intervals: dict[str, dict[str, Any]] = {}
    for key, override in last.items():
        value = override.value()
        if override.is_discrete_sweep():
            swept[key] = list(override.sweep_string_iterator())
            if not swept[key]:
                raise InputError(f"'{_typed(override)}' has no values; widen it.")
            _check_tags(override, ())
        elif isinstance(value, IntervalSweep):
            # Hydra's interval leaves out its end, which an entry of a space takes in.
            _check_tags(override, ("log",))
            whole = isinstance(value.start, int) and isinstance(value.end, int)
            kind = "int" if whole else "float"
            ends = {"low": value.start, "high": value.end}
            intervals[key] = {"type": kind, **ends, "log": "log" in value.tags}
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
    """Points written out one by one, so that values vary together (Hydra's issue 3082).

    Args:
        points: the overrides of each.
        fixed: overrides of every point; a point's own override of the same key has priority.

    Raises:
        InputError: a point without overrides, or one that is a sweep itself.
    """
    result = []
    for own in points:
        parsed = _parsed(own)
        sweeps = [_typed(one) for one in parsed if one.is_sweep_override()]
        if sweeps:
            raise InputError(
                f"points: '{sweeps[0]}' has several values; a point has one value per key: write "
                "one point per value."
            )
        if not parsed:
            raise InputError("points: a point needs at least one override; remove the empty one.")
        taken = {_bare(one) for one in parsed}
        others = [_typed(one) for one in _parsed(fixed) if _bare(one) not in taken]
        result.append(_point(others, own))
    return result


def distributions(points: Sequence[GridPoint]) -> dict[str, BaseDistribution]:
    """Distributions of the parameters of a grid or a list, for Optuna's figures.

    Numbers are ranges, which may grow in a study; other choices may not.
    """
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    values: dict[str, list[Any]] = {}
    for key, value in (pair for point in points for pair in point.params.items()):
        values.setdefault(key, []).append(value)
    found: dict[str, BaseDistribution] = {}
    for key, seen in values.items():
        numbers = [each for each in seen if type(each) in (int, float)]
        if len(numbers) < len(seen):
            found[key] = CategoricalDistribution(tuple(dict.fromkeys(seen)))
        elif all(isinstance(each, int) for each in numbers):
            found[key] = IntDistribution(int(min(numbers)), int(max(numbers)))
        else:
            found[key] = FloatDistribution(min(numbers), max(numbers))
    return found


def _parsed(overrides: Iterable[str], config_loader: ConfigLoader | None = None) -> list[Override]:
    return OverridesParser.create(config_loader).parse_overrides(list(overrides))


def _typed(override: Override) -> str:
    assert override.input_line is not None, "the parser keeps what it read"
    return override.input_line


def _bare(override: Override) -> str:
    return override.get_key_element().lstrip("+~")


def _point(fixed: Sequence[str], own: Sequence[str]) -> GridPoint:
    params: dict[str, Value] = {}
    for override in _parsed(own):
        value = override.value()
        if override.is_delete():
            continue
        if value is None or isinstance(value, str | int | float):
            params[override.get_key_element()] = value
        else:
            params[override.get_key_element()] = override.get_value_element_as_str()
    return GridPoint(params, (*fixed, *own))


def _check_tags(override: Override, known: Sequence[str]) -> None:
    value = override.value()
    for tag in sorted(value.tags) if isinstance(value, Sweep) else ():
        if tag not in known:
            hint = nearest(tag, known) if known else "only interval() has tags"
            raise InputError(f"'{_typed(override)}': tag '{tag}' is unknown; {hint}.")


def merge_space(
    space: Mapping[str, Any],
    fixed: Sequence[str],
    swept: SweptValues,
    intervals: Mapping[str, Mapping[str, Any]],
) -> tuple[Parameter, ...]:
    """The parameters of a search; the command line has priority for every key.

    Args:
        space: as in ``conf/search``.
        fixed: overrides as typed. One for a key of `space` takes it out of the search, and with it
            the parameters whose conditions it rules out.
        swept: key -> values; they are the choices of the key.
        intervals: key -> entry of a space; it is the range of the key. Like `swept` it takes the
            place of an entry of `space` and keeps its ``when``.

    Raises:
        InputError: as `parse_space`, for `space` as it is and for what is made of it.
    """
    parse_space(space)
    merged = plain_space(space)
    choices = {key: [_value(f"{key}={text}") for text in texts] for key, texts in swept.items()}
    entries = {key: {"type": "categorical", "choices": values} for key, values in choices.items()}
    for key, entry in {**entries, **intervals}.items():
        kept = {"when": merged[key]["when"]} if merged.get(key, {}).get("when") else {}
        merged[key] = {**entry, **kept}
    keys = {word.partition("=")[0]: word for word in fixed}
    left = _without(merged, {key: _value(word) for key, word in keys.items() if key in merged})
    return parse_space(left)


def _value(override: str) -> Any:
    (parsed,) = _parsed([override])
    return parsed.value()


def _without(space: Mapping[str, Any], fixed: Mapping[str, Any]) -> dict[str, Any]:
    """`space` where some keys have one value: without them and without what they rule out."""
    left: dict[str, Any] = {}
    for key, entry in space.items():
        when = {
            other: wanted if isinstance(wanted, list | tuple) else [wanted]
            for other, wanted in (entry.get("when") or {}).items()
        }
        # What is gone without being fixed was ruled out itself.
        impossible = any(other not in left and other not in fixed for other in when)
        unmet = any(fixed[other] not in when[other] for other in when if other in fixed)
        if key in fixed or impossible or unmet:
            continue
        open_conditions = {other: wanted for other, wanted in when.items() if other not in fixed}
        left[key] = {**entry, "when": open_conditions} if when else entry
    return left
