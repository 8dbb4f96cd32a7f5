"""The command ``python -m rgbt.corruptions`` by the name that it had before."""

from __future__ import annotations

import sys

from rgbt.config.command import plain_command
from rgbt.corruptions.__main__ import OWN, main

if __name__ == "__main__":
    sys.stderr.write("rgbt.degradations is called rgbt.corruptions now.\n")
    plain_command(OWN, main)()
