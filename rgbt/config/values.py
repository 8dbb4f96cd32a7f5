"""Check one value against its annotated type and range, by pydantic with the key in front."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from functools import cache
from typing import TYPE_CHECKING, Any

from rgbt.checks import InputError, one_line

if TYPE_CHECKING:  # --help waits for neither
    import pydantic

# Members of a union, as pydantic names them.
KINDS = ("int", "float", "str", "bool", "dict", "list", "tuple")


def check_value(path: str, value: Any, annotation: Any) -> Any:
    """Convert plain YAML to the annotated type; as in JSON, a list may be a tuple, an int a float.

    Raises:
        InputError: another type, a value out of its range, NaN or infinity; `path` is named.
    """
    import pydantic

    try:
        return _adapter(annotation).validate_json(json.dumps(value, allow_nan=False), strict=True)
    except pydantic.errors.PydanticSchemaGenerationError:
        what = f"'{path}' must be a mapping with `_target_`"
        raise InputError(f"{what}, got {repr(value)[:80]}.") from None
    except pydantic.ValidationError as error:
        raise refusal(path, error) from None
    except ValueError:
        key, found = next(_not_finite(path, value), (path, value))
        raise InputError(f"'{key}': expected a finite value, got {repr(found)[:80]}.") from None


def _not_finite(path: str, value: Any) -> Iterator[tuple[str, float]]:
    """Yield the dotted key and value of every NaN and infinity in plain YAML."""
    if isinstance(value, float) and not math.isfinite(value):
        yield path, value
    for key, inner in value.items() if isinstance(value, dict) else ():
        yield from _not_finite(f"{path}.{key}".lstrip("."), inner)
    for index, inner in enumerate(value) if isinstance(value, list | tuple) else ():
        yield from _not_finite(f"{path}[{index}]", inner)


@cache
def _adapter(annotation: Any) -> Any:
    import pydantic

    return pydantic.TypeAdapter(annotation)


def refusal(path: str, error: pydantic.ValidationError) -> InputError:
    """Return pydantic's first message after the key of the refused value, which is below `path`."""
    first = error.errors()[0]
    for step in first["loc"]:
        if isinstance(step, int):
            path += f"[{step}]"
        elif step.isidentifier() and step not in KINDS:
            path += f".{step}"
    return InputError(
        f"'{path.lstrip('.')}': {one_line(first['msg'])}, got {repr(first['input'])[:80]}."
    )
