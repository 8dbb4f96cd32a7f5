"""The command ``rgbt``, also ``python -m rgbt``: ``rgbt evaluate run=...``.

``rgbt NAME ...`` is ``python -m MODULE ...`` (`rgbt.config.commands`), except that the working
directory is searched for modules last.
"""

from __future__ import annotations

import runpy
import sys
from collections.abc import Sequence

from rgbt.checks import nearest
from rgbt.config.commands import COMMANDS
from rgbt.config.shadowing import search_working_directory_last

COMPLETION = "--completion"
COMPLETE = "--complete"


def main() -> None:
    """Run the command that the first word names; leaves by ``sys.exit``."""
    name, *words = sys.argv[1:] or ["--help"]
    search_working_directory_last()
    if name in COMMANDS:
        sys.argv[1:] = words
        runpy.run_module(COMMANDS[name].module, run_name="__main__", alter_sys=True)
        sys.exit(0)
    sys.exit(_answer(name, words))


def _answer(name: str, words: Sequence[str]) -> int:
    """What is no command: help, completion, or a mistake."""
    if name in ("-h", "--help"):
        sys.stdout.write(f"{help_text()}\n")
        return 0
    if name == COMPLETION:
        from rgbt.config.completion import print_script
        from rgbt.config.reporting import exit_code

        return exit_code(lambda: print_script(words))
    if name == COMPLETE:
        from rgbt.config.completion import print_candidates

        return print_candidates(words)
    known = nearest(name, COMMANDS)
    sys.stderr.write(f"rgbt: '{name}' is not a command; {known}.\n")
    return 2


def help_text() -> str:
    """What ``rgbt --help`` shows: every command with one line."""
    width = 2 + max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}{entry.about}" for name, entry in COMMANDS.items()]
    return "\n".join(
        [
            "A lab for RGB-thermal semantic segmentation.",
            "",
            "usage: rgbt COMMAND [key=value ...]",
            "",
            *lines,
            "",
            "rgbt COMMAND --help explains one; start with rgbt run +experiment=grbm.",
            "Completion of the command line: rgbt --completion bash (zsh, fish).",
        ]
    )


if __name__ == "__main__":
    main()
