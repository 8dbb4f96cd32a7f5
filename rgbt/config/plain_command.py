"""Commands with options of their own: ``rgbt evaluate run=... split=val``.

Other ``key=value`` words are overrides of the configuration. See `rgbt.config.options`.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from rgbt.checks import InputError, nearest
from rgbt.config.commands import typed_as
from rgbt.config.options import help_text, parse
from rgbt.config.reporting import exit_code
from rgbt.runtime.signals import answered

T = TypeVar("T")


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
        """Run with the words of ``sys.argv``; leaves by ``sys.exit``."""
        words = sys.argv[1:]
        if any(word in ("-h", "--help") for word in words):
            sys.stdout.write(f"{self.help()}\n")
            sys.exit(0)
        sys.exit(self.code(words))

    def help(self) -> str:
        """What ``--help`` shows."""
        usage = f"{self.name or typed_as(self.main)} {self.first.upper()}".strip()
        return help_text(usage, self.options, inspect.getdoc(self.main) or "", (self.first,))

    def code(self, words: Sequence[str]) -> int:
        """The exit code of the command with these words; a mistake is one sentence on stderr."""
        with answered():
            return exit_code(lambda: self.run(words))

    def run(self, words: Sequence[str]) -> int | None:
        """Parse `words` and do it.

        Raises:
            InputError: see `rgbt.config.options.parse`.
        """
        from rgbt.config.words import readable_paths

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
        name = sys.argv[1] if len(sys.argv) > 1 else ""
        if name in self.commands:
            del sys.argv[1]
            self.commands[name]()
        if self.default is not None:
            self.default()
        if name in ("-h", "--help"):
            sys.stdout.write(f"{self.about.strip()}\n")
            sys.exit(0)
        sys.exit(exit_code(lambda: self._refuse(name)))

    def _refuse(self, name: str) -> int:
        raise InputError(f"expected a command, got '{name}'; {nearest(name, self.commands)}.")
