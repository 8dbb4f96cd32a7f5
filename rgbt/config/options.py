"""Parse the options of a command, which are the fields of a frozen dataclass.

``resamples: Annotated[int, Interval(ge=100, le=10**6), Help("of the images")] = 2000`` is set by
``resamples=500``; a field without a default must be given. pydantic checks types and ranges.
"""

from __future__ import annotations

import dataclasses
import re
import textwrap
import typing
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

from rgbt.checks import InputError, nearest, split_list

PATHS = ("model.weights", "pretrained", "dataset.root", "runs_dir", "out")

WIDTH = 100  # columns of a help text

T = TypeVar("T")


@dataclass(frozen=True)
class Help:
    """Help text of an option, in its annotation."""

    text: str


def types_of(options: type) -> dict[str, Any]:
    """Return the annotation of every option, by name."""
    return typing.get_type_hints(options, include_extras=True)


def parse(
    options: type[T], words: Sequence[str], heeds: Sequence[str] | None = None
) -> tuple[T, list[str]]:
    """Return the options that `words` set, and the words that are overrides of the configuration.

    Of these only the keys `heeds` take effect, each with all below it; None: all. InputError names
    a word that is no ``key=value``, an unknown key, or one whose value is wrong or missing.
    """
    kinds = types_of(options)
    values, overrides = {}, []
    for word in words:
        key, equals, text = word.partition("=")
        if not equals:
            raise InputError(f"'{word}': expected key=value; {nearest(key, kinds)}.")
        if key in kinds:
            values[key] = _read(key, with_home(text), kinds[key])
            continue
        if heeds is None:
            from rgbt.config.overrides import check_key

            check_key(word, list(kinds))
        else:
            # The search path names the folder of a user's own data set files.
            known = (*heeds, "hydra.searchpath") if heeds else ()
            key = key.lstrip("+~")
            if not any(f"{key}.".startswith(f"{name}.") for name in known):
                raise InputError(f"'{key}' has no effect here; {nearest(key, [*kinds, *heeds])}.")
        overrides.append(word)
    for name in _required(options):
        if name not in values:
            raise InputError(f"'{name}' has no value; give one with {name}=...")
    return options(**values), overrides


def _required(options: Any) -> list[str]:
    fields = dataclasses.fields(options)
    return [option.name for option in fields if option.default is option.default_factory is MISSING]


def _read(key: str, text: str, annotation: Any) -> Any:
    """Return the text as it is, as YAML, or as a list: the first that the annotation takes."""
    from pydantic import ConfigDict, TypeAdapter, ValidationError

    from rgbt.config.values import refusal
    from rgbt.files.yaml_files import parse_yaml

    adapter: TypeAdapter[Any] = TypeAdapter(annotation, config=ConfigDict(allow_inf_nan=False))
    candidates: list[Any] = [None, text] if text in ("", "null") else [text]
    for read in (parse_yaml, split_list):
        with suppress(InputError):
            candidates.append(read(text, key))
    errors = []
    for candidate in candidates:
        try:
            return adapter.validate_python(candidate)
        except ValidationError as error:
            errors.append(error)
    # For a list or mapping, the error of the text read as YAML names the wrong entry.
    raise refusal(key, errors[-1] if text[:1] in ("[", "{") else errors[0])


def choices_of(annotation: Any) -> list[str]:
    """Return the texts that an annotation names one by one."""
    inner = typing.get_args(annotation)
    if typing.get_origin(annotation) is Literal:
        return [choice for choice in inner if isinstance(choice, str)]
    return [choice for part in inner for choice in choices_of(part)]


def with_home(text: str) -> str:
    """Replace ~ at the start of `text` by the home folder: shells keep it after "="."""
    return re.sub(r"^~(?=/|$)", str(Path.home()), text)


def readable_paths(words: Sequence[str]) -> list[str]:
    """Write arguments as Hydra reads them: ~ is the home folder, paths (epoch=299.ckpt) are quoted.

    A comma still makes a grid, and names of upstream runs (experiment:NAME/last.pt) stay.
    """
    readable = []
    for word in words:
        key, equals, value = word.partition("=")
        value = with_home(value)
        is_path = key in PATHS and not value.startswith(("experiment:", "common:"))
        if is_path and re.search(r"[=\s()\[\]{}:]", value) and value[0] not in "'\"":
            value = "'" + value.replace("'", "\\'") + "'"
        readable.append(f"{key}{equals}{value}")
    return readable


def help_text(usage: str, options: type, about: str, given: str = "") -> str:
    """Return the text of ``--help``; `usage` is the command as typed, with the option `given`."""
    summary, _, rest = about.partition("\n\n")
    needed = [f"{name}=..." for name in _required(options) if name != given]
    kinds = types_of(options)
    width = 4 + max(map(len, kinds), default=0)
    fill = textwrap.TextWrapper(
        WIDTH, subsequent_indent=" " * width, break_on_hyphens=False, break_long_words=False
    ).fill
    lines = []
    for option in dataclasses.fields(options):
        notes = getattr(kinds[option.name], "__metadata__", ())
        text = "; ".join(note.text for note in notes if isinstance(note, Help))
        choices = choices_of(kinds[option.name])
        if not all(re.search(rf"\b{re.escape(choice)}\b", text) for choice in choices):
            text += f"; one of: {', '.join(choices)}"
        if option.default not in (None, MISSING, "") and "default" not in text:
            text += f" (default: {option.default})"
        lines.append(fill(f"  {option.name}".ljust(width) + text))
    usage = " ".join(["usage:", usage, *needed, "[option=value ...]"])
    return "\n\n".join(filter(None, [summary, usage, "\n".join(lines), rest]))
