"""Parse the options of a command, which are the fields of a frozen dataclass.

    @dataclass(frozen=True)
    class Options:
        run: Annotated[str, Help("run folder, config key or MLflow run id")]
        resamples: Annotated[int, Interval(ge=100, le=10**6), Help("of the images")] = 2000

``resamples=500`` sets one; a field without a default must be given. Types and ranges are checked as
those of a configuration are (`rgbt.config.values`), and ``--help`` is made from the declaration.
"""

from __future__ import annotations

import dataclasses
import re
import textwrap
import typing
from collections.abc import Sequence
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Any, TypeVar

from rgbt.checks import InputError, nearest, split_list

PATHS = ("model.weights", "pretrained", "dataset.root", "runs_dir", "out")

RENAMED = {"degradation": "corruption", "degradations": "corruptions"}
"""Renamed options: former name -> current name."""

WIDTH = 100
"""Columns of a help text."""

T = TypeVar("T")


@dataclass(frozen=True)
class Help:
    """Help text of an option, in its annotation: ``Annotated[str, Help("run folder")]``."""

    text: str


def types_of(options: type) -> dict[str, Any]:
    """Annotation of every option, by name."""
    return typing.get_type_hints(options, include_extras=True)


def parse(
    options: type[T], words: Sequence[str], heeds: Sequence[str] | None = None
) -> tuple[T, list[str]]:
    """The options that `words` set, and the words that are overrides of the configuration.

    Args:
        options: dataclass that declares them.
        words: ``key=value``, as typed.
        heeds: keys of the configuration that take effect, each with all below it; None: all.

    Raises:
        InputError: a word of another form, an unknown key, a value of a wrong type, or none where
            one is needed.
    """
    from rgbt.config.values import check_value

    kinds = types_of(options)
    values, overrides = {}, []
    for word in words:
        key, equals, text = word.partition("=")
        if not equals:
            raise InputError(f"'{word}': expected key=value; {nearest(key, kinds)}.")
        if key in kinds:
            values[key] = check_value(key, _plain(key, text, kinds[key]), kinds[key])
        else:
            _check_override(word, list(kinds), heeds)
            overrides.append(word)
    for name in _required(options):
        if name not in values:
            raise InputError(f"'{name}' has no value; give one with {name}=...")
    return options(**values), overrides


def _required(options: Any) -> list[str]:
    fields = dataclasses.fields(options)
    return [each.name for each in fields if each.default is each.default_factory is MISSING]


def _plain(key: str, text: str, annotation: Any) -> Any:
    """The text itself where the annotation takes a text; else as Hydra reads a value."""
    text = with_home(text)
    kinds = _leaves(annotation)
    if type(None) in kinds and text in ("", "null"):
        return None
    if Path in kinds and not text:
        raise InputError(f"'{key}' has no value; give a path.")
    if str in kinds or Path in kinds or text in kinds:
        return text
    for kind in kinds:
        # An entry of a list may be one number or a list of them.
        is_number = bool({int, float} & set(kinds)) and not text.startswith("[")
        if typing.get_origin(kind) is tuple and not is_number:
            item = typing.get_args(kind)[0]
            return [_plain(key, each, item) for each in split_list(text, "values")]
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        parsed = OverridesParser.create().parse_override(f"{key}={text}")
        # What is no single value (1,2) is refused as the text that it is.
        return text if parsed.is_sweep_override() else parsed.value()
    except HydraException:
        return text


def _leaves(annotation: Any) -> list[Any]:
    """The members of a union without their ranges, those of a Literal as they are."""
    origin, args = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return _leaves(args[0])
    if origin is typing.Literal:
        return list(args)
    if args and origin not in (tuple, dict, list):
        return [leaf for each in args for leaf in _leaves(each)]
    return [annotation]


def choices_of(annotation: Any) -> list[str]:
    """The texts that an annotation names one by one."""
    leaves = _leaves(annotation)
    booleans = ["true", "false"] if bool in leaves else []
    return [*booleans, *(each for each in leaves if isinstance(each, str))]


def _check_override(word: str, names: Sequence[str], heeds: Sequence[str] | None) -> None:
    """Refuse an override that takes no effect, or an option that is misspelt."""
    from rgbt.config.hydra_messages import check_key

    key = word.lstrip("+~").partition("=")[0]
    option, dot, setting = key.partition(".")
    if option in RENAMED:
        now = f"{RENAMED[option]}{dot}{setting}"
        raise InputError(f"'{key}' was renamed to '{now}'; use {now}=...")
    if heeds is None:
        check_key(word, names)
        return
    # The search path names the folder of a user's own data set files.
    known = (*heeds, "hydra.searchpath") if heeds else ()
    if not any(f"{key}.".startswith(f"{each}.") for each in known):
        raise InputError(f"'{key}' has no effect here; {nearest(key, [*names, *heeds])}.")


def with_home(text: str) -> str:
    """`text` with ~ at its start as the home folder: shells keep it after "="."""
    return re.sub(r"^~(?=/|$)", str(Path.home()), text)


def readable_paths(words: Sequence[str]) -> list[str]:
    """Arguments as Hydra reads them: shells keep ~ after "=", and file names hold anything.

    A path with "=", spaces or brackets (epoch=299.ckpt) is put in quotes; a comma still makes a
    grid. Names of upstream runs (experiment:NAME/last.pt, common:NAME/last.pt) are read as
    they are.
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
    """What ``--help`` shows: the text of a command around its options.

    Args:
        usage: the command as it is typed, without its options.
        options: dataclass that declares them.
        about: the first paragraph says what the command does; others follow the options.
        given: an option that `usage` names already.
    """
    summary, _, rest = about.partition("\n\n")
    needed = [f"{name}=..." for name in _required(options) if name != given]
    usage = " ".join(["usage:", usage, *needed, "[option=value ...]"])
    kinds = types_of(options)
    width = 2 + max(map(len, kinds), default=0)
    fields: Any = dataclasses.fields(options)
    lines = [_entry(each.name, kinds[each.name], each.default, width) for each in fields]
    return "\n\n".join(filter(None, [summary, usage, "\n".join(lines), rest]))


def _entry(name: str, annotation: Any, default: Any, width: int) -> str:
    """One option with its meaning, choices and default."""
    notes = [each.text for each in getattr(annotation, "__metadata__", ()) if type(each) is Help]
    text = "; ".join(notes)
    choices = [each for each in choices_of(annotation) if each not in ("true", "false")]
    if not all(re.search(rf"\b{re.escape(each)}\b", text) for each in choices):
        text += f"; one of: {', '.join(choices)}"
    if default not in (None, MISSING, "") and "default" not in text:
        shown = str(default).lower() if isinstance(default, bool) else default
        text += f" (default: {shown})"
    return textwrap.fill(
        text.lstrip("; "),
        WIDTH,
        initial_indent=f"  {name:<{width}}",
        subsequent_indent=" " * (width + 2),
        break_on_hyphens=False,
        break_long_words=False,
    )
