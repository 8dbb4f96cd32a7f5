"""Former name of the command `python -m rgbt.data.cache`."""

from __future__ import annotations

import sys

from rgbt.data.cache.__main__ import entry

if __name__ == "__main__":
    sys.stderr.write("rgbt: use python -m rgbt.data.cache; rgbt.data.decoded is its former name.\n")
    entry()
