"""The command ``rgbt``, also ``python -m rgbt``: ``rgbt evaluate run=...``.

``rgbt NAME ...`` is ``python -m MODULE ...`` (`rgbt.config.plain_command`), except that the
working directory is searched for modules last.
"""

from __future__ import annotations

import runpy
import sys
from collections.abc import Iterable
from pathlib import Path

import rgbt
from rgbt.checks import nearest
from rgbt.config.plain_command import COMMANDS, say

HELP = """A lab for RGB-thermal semantic segmentation.

usage: rgbt COMMAND [key=value ...]

{commands}

rgbt COMMAND --help shows its options. Start with: rgbt run +experiment=grbm
rgbt --all shows all {number} commands, rgbt --version the version.
"""

# What a first day needs, in its order.
FIRST = ("run", "predict", "compare", "check", "ui", "doctor")


def main() -> None:
    """Run the command that the first word names; leaves by ``sys.exit``."""
    name, *words = sys.argv[1:] or ["--help"]
    sys.path.append(str(Path.cwd()))  # a user's own maskers; searched last
    code = 0
    if name in COMMANDS:
        sys.argv[1:] = words
        runpy.run_module(COMMANDS[name].module, run_name="__main__", alter_sys=True)
    elif name in ("-h", "--help"):
        sys.stdout.write(help_text(FIRST))
    elif name == "--all":
        sys.stdout.write(help_text(COMMANDS))
    elif name in ("-V", "--version"):
        sys.stdout.write(f"rgbt {rgbt.__version__}\n")
    else:
        code = say(f"'{name}' is not a command; {nearest(name, COMMANDS)}.", 2)
    sys.exit(code)


def help_text(names: Iterable[str]) -> str:
    """Return what ``rgbt --help`` shows: one line about each of these commands."""
    width = 2 + max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}{COMMANDS[name].about}" for name in names]
    return HELP.format(commands="\n".join(lines), number=len(COMMANDS))


if __name__ == "__main__":
    main()
