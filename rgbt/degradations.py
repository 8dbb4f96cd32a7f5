"""The command ``python -m rgbt.corruptions`` by the name that it had before."""

from __future__ import annotations

import sys

from rgbt.corruptions.__main__ import entry

if __name__ == "__main__":
    sys.stderr.write("rgbt.degradations is called rgbt.corruptions now.\n")
    entry()
