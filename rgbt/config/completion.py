"""What may follow on a command line of ``rgbt``: commands, options, groups, keys and values."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress

from rgbt.config.commands import COMMANDS
from rgbt.config.options import choices_of, types_of
from rgbt.config.plain_command import CommandGroup, PlainCommand

HYDRA_OPTIONS = ("-m", "--multirun", "--help", "--cfg", "--resolve")


def print_candidates(words: Sequence[str]) -> int:
    """Write what may stand for the last word of a line, one candidate a line.

    Args:
        words: the line up to the cursor, from ``rgbt`` on, as one argument.
    """
    with suppress(Exception):  # a shell that completes shows nothing of what went wrong
        sys.stdout.write("".join(f"{each}\n" for each in candidates(" ".join(words))))
    return 0


def candidates(line: str) -> list[str]:
    """Whole words that the last word of a line may become.

    Args:
        line: from ``rgbt`` up to the cursor; a space at its end begins a new word.
    """
    _, *words = [*line.split(), *([""] if line.endswith(" ") else [])]
    if len(words) < 2:
        return _begin(words[0] if words else "", [*(f"{name} " for name in COMMANDS), "--help "])
    name, *rest = words
    if name not in COMMANDS:
        return []
    if rest[-1].startswith("-"):
        return _begin(rest[-1], HYDRA_OPTIONS if name in OF_HYDRA else ("--help",))
    if name in OF_HYDRA:
        return _of_hydra(rest)
    return _of_command(importlib.import_module(_importable(COMMANDS[name].module)).entry, rest)


OF_HYDRA = ("run", "check", "masks")
"""Commands whose words are all overrides."""


def _importable(module: str) -> str:
    spec = importlib.util.find_spec(module)
    is_package = spec is not None and spec.submodule_search_locations is not None
    return f"{module}.__main__" if is_package else module


def _of_command(command: PlainCommand | CommandGroup, words: list[str]) -> list[str]:
    if isinstance(command, PlainCommand):
        return _of_options(command, words)
    if words[0] in command.commands and len(words) > 1:
        return _of_options(command.commands[words[0]], words[1:])
    named = _begin(words[0], [f"{name} " for name in command.commands]) if len(words) == 1 else []
    return [*named, *(_of_options(command.default, words) if command.default else [])]


def _of_options(command: PlainCommand, words: list[str]) -> list[str]:
    kinds = types_of(command.options)
    key, equals, _ = words[-1].partition("=")
    if equals and key in kinds:
        return _begin(words[-1], [f"{key}={each} " for each in choices_of(kinds[key])])
    overrides = [word for word in words[:-1] if word.partition("=")[0] not in kinds]
    given = {word.partition("=")[0] for word in words[:-1]}
    options = [f"{name}=" for name in kinds if name not in given]
    return [*_begin(words[-1], options), *_heeded(command, [*overrides, words[-1]])]


def _heeded(command: PlainCommand, words: list[str]) -> Iterator[str]:
    """Overrides of the configuration that the command takes."""
    heeds = command.heeds
    if heeds == () or (heeds is None and not words[-1]):  # all of them would hide the options
        return
    for each in _of_hydra(words):
        if heeds is None or any(each.startswith((key, *[f"{key}."])) for key in heeds):
            yield each


def _of_hydra(words: list[str]) -> list[str]:
    """What Hydra knows: groups, their files, keys; also behind a comma."""
    from hydra._internal.config_loader_impl import ConfigLoaderImpl
    from hydra._internal.utils import create_config_search_path
    from hydra.core.plugins import Plugins
    from hydra.plugins.completion_plugin import DefaultCompletionPlugin

    from rgbt.config.compose import conf_dir, register_resolvers

    register_resolvers()
    Plugins.instance()
    loader = ConfigLoaderImpl(create_config_search_path(str(conf_dir())))
    *others, last = words
    begun, comma, value = last.rpartition(",")
    key = begun.partition("=")[0]
    word = f"{key}={value}" if comma else last
    known = DefaultCompletionPlugin(loader)._query("config", " ".join([*others, word]))
    return [f"{begun},{each.partition('=')[2]}" if comma else each for each in known]


def _begin(word: str, known: Sequence[str]) -> list[str]:
    return [each for each in known if each.startswith(word)]
