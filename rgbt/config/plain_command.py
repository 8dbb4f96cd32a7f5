"""Commands with options of their own: ``rgbt evaluate run=... split=val``.

Other ``key=value`` words are overrides of the configuration. See `rgbt.config.options`.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from rgbt.checks import nearest
from rgbt.config.commands import typed_as
from rgbt.config.options import help_text, parse, readable_paths
from rgbt.config.reporting import exit_code, say
from rgbt.runtime.signals import answered

T = TypeVar("T")
HELP = ("-h", "--help")


@dataclass(frozen=True)
class PlainCommand(Generic[T]):
    """``entry = PlainCommand(Options, main)``; called, it reads ``sys.argv`` and leaves.

    Attributes:
        options: frozen dataclass that declares the options.
        main: gets the options, and all other words as overrides of the configuration; its docstring
            is the help text.
        heeds: keys of the configuration that take effect, each with all below it; None: all.
        name: as it is typed; "": as `rgbt.config.commands` names its module.
        first: option that the first word sets if it has no ``=``.
    """

    options: type[T]
    main: Callable[[T, list[str]], int | None]
    heeds: Sequence[str] | None = None
    name: str = ""
    first: str = ""

    def __call__(self) -> None:
        """Run with the words of ``sys.argv``; a mistake is one sentence on stderr."""
        words = sys.argv[1:]
        if set(words) & set(HELP):
            usage = f"{self.name or typed_as(self.main)} {self.first.upper()}".strip()
            about = inspect.getdoc(self.main) or ""
            sys.stdout.write(f"{help_text(usage, self.options, about, self.first)}\n")
            sys.exit(0)
        from rgbt.config.compose import searching  # --help does not wait for Hydra

        with answered(), searching(words):
            code = exit_code(lambda: self.run(words))
        sys.exit(code)

    def run(self, words: Sequence[str]) -> int | None:
        """Parse `words` and do it.

        Raises:
            InputError: see `rgbt.config.options.parse`.
        """
        if self.first and words and "=" not in words[0] and not words[0].startswith("-"):
            words = [f"{self.first}={words[0]}", *words[1:]]
        options, overrides = parse(self.options, words, self.heeds)
        return self.main(options, readable_paths(overrides))


@dataclass(frozen=True)
class CommandGroup:
    """Commands of which the first word chooses one: ``rgbt weights inspect FILE``.

    Attributes:
        about: what ``--help`` shows, unless there is a default.
        commands: by name.
        default: runs if the first word names none; None: one must be named.
    """

    about: str
    commands: Mapping[str, PlainCommand[Any]]
    default: PlainCommand[Any] | None = None

    def __call__(self) -> None:
        """Run the command that ``sys.argv`` names; leaves by ``sys.exit``."""
        name = "".join(sys.argv[1:2])
        command = self.commands.get(name)
        if command is not None:
            del sys.argv[1]
        command = command or self.default
        if command is not None:
            command()
        elif name in HELP:
            sys.stdout.write(f"{self.about.strip()}\n")
            sys.exit(0)
        else:
            known = nearest(name, self.commands)
            sys.exit(say(f"expected a command, got '{name}'; {known}.", 2))
