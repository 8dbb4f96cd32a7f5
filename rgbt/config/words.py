"""Words of a command line, before anything reads them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

PATHS = ("model.weights", "pretrained", "dataset.root", "runs_dir", "out")


def with_home(text: str) -> str:
    """`text` with ~ at its start as the home folder: shells keep it after "="."""
    return re.sub(r"^~(?=/|$)", str(Path.home()), text)


def readable_paths(words: Sequence[str]) -> list[str]:
    """Arguments as Hydra reads them: shells keep ~ after "=", and file names hold anything.

    A path with "=", spaces or brackets (epoch=299.ckpt) is put in quotes; a comma still makes a
    grid. Names of upstream runs (experiment:NAME/last.pt) are read as they are.
    """
    readable = []
    for word in words:
        key, equals, value = word.partition("=")
        value = with_home(value)
        is_path = key in PATHS and not value.startswith("experiment:")
        if is_path and re.search(r"[=\s()\[\]{}:]", value) and value[0] not in "'\"":
            value = "'" + value.replace("'", "\\'") + "'"
        readable.append(f"{key}{equals}{value}")
    return readable
