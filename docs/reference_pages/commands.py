"""The page of commands: every command of ``rgbt`` with its options."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
from collections.abc import Iterator
from typing import Any

from reference_pages.configuration import kind_of
from reference_pages.guides import link
from reference_pages.markdown import block, code, page, table
from rgbt.config.options import Help, types_of
from rgbt.config.plain_command import COMMANDS, CommandGroup, PlainCommand


def commands_page() -> str:
    """Every command with its options, types and defaults."""
    rows = [
        [f"[`rgbt {name}`](#{name})", entry.about, link("commands", name, 1)]
        for name, entry in COMMANDS.items()
    ]
    return page(
        "# Commands",
        "`rgbt NAME` is `python -m MODULE`. Options and overrides have the form `key=value`. Every "
        "command answers `--help`. Exit codes are on the page "
        "[Files of a run](run-folder.md).",
        table(["Command", "What it does", "Guide"], rows),
        *(part for name in COMMANDS for part in _section(name)),
    )


def _section(name: str) -> Iterator[str]:
    module = importlib.import_module(COMMANDS[name].module)
    yield f"## {name}"
    yield f"`python -m {COMMANDS[name].module}`. {link('commands', name, 1)}"
    entry = getattr(module, "entry", None)
    if isinstance(entry, CommandGroup):
        if entry.default is not None:
            yield from _command(entry.default, f"rgbt {name}")
        for first, command in entry.commands.items():
            yield f"### {name} {first}"
            yield from _command(command, f"rgbt {name} {first}")
    elif isinstance(entry, PlainCommand):
        yield from _command(entry, f"rgbt {name}")
    else:  # its words are overrides of the configuration alone
        yield inspect.getdoc(module) or ""
        yield "Every word is an override of the [configuration](configuration/index.md)."


def _command(command: PlainCommand[Any], usage: str) -> Iterator[str]:
    about, _, rest = (inspect.getdoc(command.main) or "").partition("\n\n")
    yield " ".join(about.split())
    words = [usage, command.first.upper(), *_required(command), "[option=value ...]"]
    yield block(" ".join(filter(None, words)), "text")
    kinds = types_of(command.options)
    fields: Any = dataclasses.fields(command.options)
    yield table(
        ["Option", "Type", "Default", "Meaning"],
        [
            [code(each.name), kind_of(kinds[each.name]), _default(each), _meaning(kinds[each.name])]
            for each in fields
        ],
    )
    yield rest


def _required(command: PlainCommand[Any]) -> list[str]:
    fields: Any = dataclasses.fields(command.options)
    return [
        f"{each.name}=..." for each in fields if _is_required(each) and each.name != command.first
    ]


def _is_required(field: Any) -> bool:
    return bool(field.default is field.default_factory is dataclasses.MISSING)


def _default(field: Any) -> str:
    if _is_required(field):
        return "required"
    value = field.default
    if value in (None, "", dataclasses.MISSING):
        return ""
    return code(str(value).lower() if isinstance(value, bool) else str(value))


def _meaning(kind: Any) -> str:
    return "; ".join(e.text for e in getattr(kind, "__metadata__", ()) if type(e) is Help)
