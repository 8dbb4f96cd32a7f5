"""Write the folder of a generated data set once, and reuse it."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rgbt.checks import InputError


def default_cache() -> Path:
    """$XDG_CACHE_HOME/rgbt, or ~/.cache/rgbt where that is not set."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "rgbt"


def written_once(
    name: str,
    plan: Mapping[str, Any],
    cache_dir: str | Path | None,
    write: Callable[[Path], None],
) -> Path:
    """The folder of a data set, written now if it is not there yet.

    It is written under another name and renamed when complete, so that an interrupted generation
    leaves nothing that looks like a data set, and two at once cannot mix.

    Args:
        name: of the data set; begins the name of the folder, which a hash of the plan ends.
        plan: all settings that determine its bytes; stored in it as plan.json.
        cache_dir: folder that holds written data sets; None: `default_cache`.
        write: fills the empty folder that it is given.

    Raises:
        InputError: the cache cannot be written.
    """
    text = json.dumps(plan, sort_keys=True, indent=1)
    cache = Path(cache_dir).expanduser() if cache_dir else default_cache()
    folder = cache / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"
    if folder.is_dir():
        return folder
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".synth-", dir=cache) as scratch:
            made = Path(scratch) / "made"
            made.mkdir()
            write(made)
            (made / "plan.json").write_text(text + "\n", encoding="utf-8")
            _publish(made, folder)
    except OSError as error:
        raise InputError(
            f"dataset.cache_dir: cannot write {folder} ({error.strerror or error}); choose a "
            "writable folder."
        ) from error
    return folder


def _publish(made: Path, folder: Path) -> None:
    try:
        made.rename(folder)
    except OSError:
        # Another process was first; equal plans give equal files, so its folder is as good.
        if not folder.is_dir():
            raise
