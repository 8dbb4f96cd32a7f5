"""The errors that rgbt raises, and checks of values, shapes and members with uniform messages."""

from __future__ import annotations

import difflib
import importlib
import inspect
import platform
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # --help does not wait for torch
    from torch import Tensor


class InputError(ValueError):
    """A mistake of the user: a message without a traceback, exit code 2."""


class RunError(RuntimeError):
    """A run that cannot continue (a loss that is not finite): a message, exit code 1."""


def of_posix(name: str, purpose: str) -> Any:
    """Return a module or function that POSIX systems alone have, such as "fcntl" or "os.fork".

    InputError: this system has none; `purpose` says what needs it.
    """
    module, _, member = name.partition(".")
    try:
        found = importlib.import_module(module)
        return getattr(found, member) if member else found
    except (ImportError, AttributeError):
        system = platform.system()
        raise InputError(
            f"{purpose} needs {name}, which {system} does not have; use Linux, macOS or WSL."
        ) from None


def without_controls(text: str) -> str:
    """Write "?" for control characters, such as codes of a terminal; new lines are kept."""
    return "".join(letter if letter.isprintable() or letter == "\n" else "?" for letter in text)


def one_line(text: object) -> str:
    """Write `text` in one line without control characters, at most 200 characters long."""
    plain = without_controls(" ".join(str(text).split())).rstrip(".")
    return plain if len(plain) <= 200 else f"{plain[:197]}..."


def nearest(word: str, known: Iterable[str]) -> str:
    """Return the names `known` after the nearest one: "did you mean 'grbm'? known: crm, grbm".

    Of more than thirty names: "did you mean 'grbm', 'crm' or 'grbm_kp'? known: 71 names".
    """
    names = sorted(known)
    if len(names) > 30:
        first, second, third = difflib.get_close_matches(word, names, n=3, cutoff=0)
        return f"did you mean '{first}', '{second}' or '{third}'? known: {len(names)} names"
    close = difflib.get_close_matches(word, names, n=1, cutoff=0.5)
    return "".join(f"did you mean '{name}'? " for name in close) + f"known: {', '.join(names)}"


def split_list(text: str, what: str) -> list[str]:
    """Split a list as people type it: "a,b", "[a, b]", "[crm, grbm sizes=[240,480]]".

    InputError names `what` the entries are, where one is empty.
    """
    whole = re.fullmatch(r"\s*\[((?:[^\[\]]|\[[^\[\]]*\])*)\]\s*", text)
    words = [word.strip() for word in re.split(r",(?![^\[]*\])", whole[1] if whole else text)]
    if not all(words):
        raise InputError(f"'{text}': expected {what}, separated by commas.")
    return words


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Raise InputError unless low <= value <= high (NaN never passes)."""
    if not low <= value <= high:
        raise InputError(f"{name} must be between {low:g} and {high:g}, got {value:g}.")


def check_choice(name: str, value: str, known: Iterable[str]) -> None:
    """Raise InputError unless `value` is one of `known`; names the nearest one."""
    if value not in (names := list(known)):
        raise InputError(f"{name}: '{value}' is not a valid choice; {nearest(value, names)}.")


def not_finite(tensors: Mapping[str, Tensor]) -> list[str]:
    """Return the names of the tensors that hold NaN or infinity, in their order."""
    # All sums before any is waited for: a sum is fast, and not finite if a part is not.
    sums = {name: tensor.sum().isfinite() for name, tensor in tensors.items()}
    names = []
    for name, is_finite in sums.items():
        if not is_finite and not tensors[name].isfinite().all():
            names.append(name)
    return names


def check_shape(name: str, tensor: Tensor, letters: str, **sizes: int) -> dict[str, int]:
    """Return sizes by letter: ``check_shape("label", label, "B H W", B=2)["W"]``; ValueError."""
    names = letters.split()
    found = dict(zip(names, tensor.shape, strict=False))
    expected = {letter: sizes.get(letter, found.get(letter, -1)) for letter in names}
    if len(names) != tensor.dim() or found != expected:
        wanted = " x ".join(f"{n}={sizes[n]}" if n in sizes else n for n in names)
        raise ValueError(f"{name}: expected shape {wanted}, got {tuple(tensor.shape)}.")
    return found


def check_members(
    key: str, part: object, attributes: Iterable[str], calls: Mapping[str, Sequence[str]]
) -> None:
    """Refuse a user's component, of the node `key`, that lacks a member that rgbt uses.

    `calls` has the arguments of each method in order; those that end in "=" are passed by keyword.
    """
    name = f"{key}: {type(part).__name__}"
    for member in (*attributes, *calls):
        if not hasattr(part, member):
            raise InputError(f"{name} has no `{member}`; see docs/how-to/add-other-components.md.")
    for method, arguments in calls.items():
        by_keyword = {argument[:-1]: None for argument in arguments if argument.endswith("=")}
        by_place = [argument for argument in arguments if not argument.endswith("=")]
        try:
            inspect.signature(getattr(part, method)).bind(*by_place, **by_keyword)
        except TypeError as error:
            raise InputError(f"{name}.{method}({', '.join(arguments)}): {error}.") from None


def described(value: object) -> str:
    """Return a value in a message: "Tensor (2, 9, 4, 6) float32", "dict with loss", "float 1.0"."""
    kind = "None" if value is None else type(value).__name__
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{kind} {tuple(value.shape)} {str(value.dtype).removeprefix('torch.')}"
    if isinstance(value, Mapping):
        return f"{kind} with {', '.join(map(str, value)) or 'nothing'}"
    return f"{kind} {value!r}" if isinstance(value, str | int | float) else kind
