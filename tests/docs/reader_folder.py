"""The folder in which a reader follows a page: files of titled blocks, variables, search paths."""

from __future__ import annotations

import importlib
import multiprocessing.forkserver
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.docs.blocks import ROOT, Block, PageError
from tests.docs.shell import Line


def write_titled(block: Block, folder: Path) -> Path:
    """Write the file that a block shows, or continue it.

    Raises:
        PageError: a title that is not a path inside the folder.
    """
    path = folder / block.title
    if Path(block.title).is_absolute() or ".." in Path(block.title).parts:
        raise PageError(block.place(), f"title={block.title}: expected a path in the folder")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write(block.text)
    forget_modules(folder)
    return path


def export(line: Line, folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Set the variables of ``export A=B``; ``$PWD`` is the folder."""
    for word in line.words[1:]:
        name, _, value = word.partition("=")
        set_variable(name, expanded(value, folder), patch)


def expanded(text: str, folder: Path) -> str:
    """`text` with $PWD as the folder, and other variables with their values."""
    text = text.replace("$(pwd)", "$PWD").replace("${PWD}", "$PWD").replace("$PWD", str(folder))
    return os.path.expandvars(text)


def set_variable(name: str, value: str, patch: pytest.MonkeyPatch) -> None:
    patch.setenv(name, value)
    stop_fork_server()
    if name == "PYTHONPATH":
        for path in filter(None, value.split(os.pathsep)):
            if path not in sys.path:
                patch.syspath_prepend(str(Path(path).resolve()))
        # Commands that start others find this repository and not an installed copy.
        patch.setenv(name, os.pathsep.join([str(ROOT), value]))


@contextmanager
def reading_in(folder: Path) -> Iterator[pytest.MonkeyPatch]:
    """Work in `folder` with variables of its own; modules imported from there are forgotten."""
    stop_fork_server()
    forget_modules(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.syspath_prepend(str(folder))
        for name in ("RGBT_CONF", "MLFLOW_TRACKING_URI"):
            patch.delenv(name, raising=False)
        patch.setenv("PYTHONPATH", str(ROOT))
        patch.setenv("MPLBACKEND", "agg")
        try:
            yield patch
        finally:
            forget_modules(folder)


def forget_modules(folder: Path) -> None:
    """Import modules of `folder` anew, as the next process of the reader does."""
    importlib.invalidate_caches()
    for name, module in list(sys.modules.items()):
        origin = getattr(module, "__file__", None)
        # Other tests, in other folders, have a my_lab too.
        if name.partition(".")[0] == "my_lab" or (origin and Path(origin).is_relative_to(folder)):
            del sys.modules[name]


def stop_fork_server() -> None:
    """Let the next grid start a server of its own: the server keeps the variables of its start."""
    multiprocessing.forkserver._forkserver._stop()
