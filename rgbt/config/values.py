"""Check one value of a configuration against its annotated type and range.

The range of a setting is declared once, in the annotations of the constructor that takes it
(aliases in `rgbt.ranges`). Messages are written from these annotations.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import types
import typing
from functools import cache
from pathlib import Path
from typing import Any

from annotated_types import DocInfo, Ge, GroupedMetadata, Gt, Le, Lt, MaxLen, MinLen, MultipleOf
from omegaconf import OmegaConf

from rgbt.checks import InputError

Location = tuple[int | str, ...]
"""Where in a value: indices of lists and keys of mappings."""

NAMES: dict[Any, str] = {
    **{float: "a number", int: "a whole number", str: "a text", bool: "true or false"},
    **{type(None): "null", dict: "a mapping", list: "a list", tuple: "a list", Path: "a path"},
    Any: "a finite value",
}

BOUNDS: dict[Any, str] = {Ge: "at least", Gt: "above", Le: "at most", Lt: "below"}

SHOWN = 80
"""Characters of a refused value that a sentence quotes."""


def check_value(path: str, value: Any, annotation: Any) -> Any:
    """`value` as the annotated type; as in JSON, a list may be a tuple and an int a float.

    NaN and infinity are refused whatever the annotation is.

    Args:
        path: key of the value, for messages.
        value: plain, or a list or mapping of OmegaConf.
        annotation: a type with `annotated_types` that give its range.

    Raises:
        InputError: another type, or a value out of its range: key, range and value.
    """
    import pydantic  # not at the top: --help does not need it

    plain = OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
    infinite = _not_finite(plain)
    if infinite is not None:
        raise InputError(_refusal(path, plain, annotation, infinite))
    try:
        return _adapter(annotation).validate_json(json.dumps(plain), strict=True)
    except pydantic.errors.PydanticSchemaGenerationError:
        raise InputError(
            f"'{path}' must be an object, got {_shown(plain)}. Give a mapping with `_target_`, or "
            "omit the key if the run provides the object."
        ) from None
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        if first["type"] == "value_error":  # a check of the type's own, which has its sentence
            raise InputError(f"'{path}': {first['ctx']['error']}") from None
        raise InputError(_refusal(path, plain, annotation, first["loc"])) from None


@cache
def _adapter(annotation: Any) -> Any:
    import pydantic

    return pydantic.TypeAdapter(annotation)


def _parts(value: Any) -> dict[Any, Any]:
    """What a list or mapping holds, by index or key."""
    if isinstance(value, list):
        return dict(enumerate(value))
    return value if isinstance(value, dict) else {}


def _not_finite(value: Any) -> Location | None:
    """Where NaN or infinity is; None where there is neither."""
    if isinstance(value, float) and not math.isfinite(value):
        return ()
    inner = ((key, _not_finite(part)) for key, part in _parts(value).items())
    return next(((key, *rest) for key, rest in inner if rest is not None), None)


def _refusal(path: str, value: Any, annotation: Any, location: Location) -> str:
    """The sentence about the innermost part at `location` whose type is known."""
    for step in () if "[key]" in location else location:
        inner = _part_type(annotation, step)
        if inner is None or step not in _parts(value):
            break
        annotation, value = inner, value[step]
        path += f"[{step}]" if isinstance(step, int) else f".{step}"
    literals = [each for each in _members(annotation) if typing.get_origin(each) is typing.Literal]
    words = [str(word) for each in literals for word in typing.get_args(each)]
    close = difflib.get_close_matches(str(value), words, n=1)
    end = f"; did you mean '{close[0]}'?" if close else "."
    return f"'{path}' must be {expected(annotation)}, got {_shown(value)}{end}"


def _part_type(annotation: Any, step: int | str) -> Any:
    """Annotation of a part of a value; None where the types do not say."""
    members = [each for each in _members(annotation) if each is not type(None)]
    if len(members) != 1:
        return None
    kind = _bare(members[0])
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple and isinstance(step, int):
        return args[0] if args[-1] is ... else args[min(step, len(args) - 1)]
    if origin is dict:
        return args[1]
    if dataclasses.is_dataclass(kind):
        return typing.get_type_hints(kind, include_extras=True).get(str(step))
    return None


def _bare(annotation: Any) -> Any:
    is_annotated = typing.get_origin(annotation) is typing.Annotated
    return typing.get_args(annotation)[0] if is_annotated else annotation


def _members(annotation: Any) -> tuple[Any, ...]:
    bare = _bare(annotation)
    is_union = typing.get_origin(bare) in (typing.Union, types.UnionType)
    return typing.get_args(bare) if is_union else (bare,)


def expected(annotation: Any) -> str:
    """The values that an annotation allows, in words: "a number from 0 to 1, or null"."""
    limits: list[Any] = []
    if typing.get_origin(annotation) is typing.Annotated:
        annotation, *limits = typing.get_args(annotation)
        flat = (each if isinstance(each, GroupedMetadata) else (each,) for each in limits)
        limits = [limit for group in flat for limit in group]
    members = _members(annotation)
    if len(members) > 1:
        words = [expected(each) for each in members if each is not type(None)]
        return " or ".join(words) + (", or null" if type(None) in members else "")
    origin, args = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Literal:
        *others, last = map(repr, args)
        return f"{', '.join(others)} or {last}" if others else last
    if origin is tuple:
        return _list(args, limits)
    if origin is dict:
        return f"a mapping whose values are each {expected(args[1])}"
    if dataclasses.is_dataclass(annotation):
        return "a mapping with " + ", ".join(each.name for each in dataclasses.fields(annotation))
    return f"{NAMES.get(annotation, 'a mapping with `_target_`')}{_range(limits)}{_remarks(limits)}"


def _list(args: tuple[Any, ...], limits: list[Any]) -> str:
    if args[-1] is ...:
        return f"a list{_range(limits)}{_remarks(limits)}, each {expected(args[0])}"
    count = f"a list of {len(args)}{_remarks(limits)}"
    if len(set(args)) == 1:
        return f"{count}, each {expected(args[0])}"
    return f"{count}: {'; '.join(map(expected, args))}"


def _range(limits: list[Any]) -> str:
    """Bounds of a number, or of how much a list or text holds."""
    bound = {type(each): each for each in limits}
    least, most = bound.get(MinLen), bound.get(MaxLen)
    if most:  # `Len(0, ...)` has no `MinLen`
        return f" of {least.min_length if least else 0} to {most.max_length}"
    ends = {kind: getattr(bound[kind], kind.__name__.lower()) for kind in BOUNDS if kind in bound}
    shown = {kind: str(end) if isinstance(end, int) else f"{end:g}" for kind, end in ends.items()}
    if Ge in shown and Le in shown:
        return f" from {shown[Ge]} to {shown[Le]}"
    words = " and ".join(f"{BOUNDS[kind]} {end}" for kind, end in shown.items())
    return f" {words}" if words else ""


def _remarks(limits: list[Any]) -> str:
    words = [f"multiples of {each.multiple_of}" for each in limits if isinstance(each, MultipleOf)]
    words += [each.documentation for each in limits if isinstance(each, DocInfo)]
    return f" ({', '.join(words)})" if words else ""


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."
