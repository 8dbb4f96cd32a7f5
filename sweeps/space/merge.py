"""A search whose ranges come from a file and from the command line, which wins."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser

from sweeps.space.grid import SweptValues
from sweeps.space.space import Parameter, parse_space, plain_space


def merge_space(
    space: Mapping[str, Any],
    fixed: Sequence[str],
    swept: SweptValues,
    intervals: Mapping[str, Mapping[str, Any]],
) -> tuple[Parameter, ...]:
    """What is searched, the command line having the last word on every key.

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
    return OverridesParser.create().parse_override(override).value()


def _without(space: Mapping[str, Any], fixed: Mapping[str, Any]) -> dict[str, Any]:
    """`space` where some keys have one value: without them and without what they rule out."""
    left: dict[str, Any] = {}
    for key, entry in space.items():
        when = entry.get("when") or {}
        # What is gone without being fixed was ruled out itself.
        impossible = any(other not in left and other not in fixed for other in when)
        unmet = any(fixed[other] not in _listed(when[other]) for other in when if other in fixed)
        if key in fixed or impossible or unmet:
            continue
        open_conditions = {other: wanted for other, wanted in when.items() if other not in fixed}
        left[key] = {**entry, "when": open_conditions} if when else entry
    return left


def _listed(wanted: Any) -> Iterable[Any]:
    return wanted if isinstance(wanted, list | tuple) else [wanted]
