"""Former name of the command `python -m rgbt.data.cache`."""

from __future__ import annotations

import sys

from rgbt.data.cache.__main__ import entry

if __name__ == "__main__":
    sys.stderr.write("rgbt: rgbt.data.decoded was renamed to rgbt.data.cache.\n")
    entry()
