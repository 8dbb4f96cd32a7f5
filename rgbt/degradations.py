"""The former name of the command ``python -m rgbt.corruptions``."""

from __future__ import annotations

import sys

from rgbt.corruptions.__main__ import entry

if __name__ == "__main__":
    sys.stderr.write("rgbt.degradations was renamed to rgbt.corruptions.\n")
    entry()
