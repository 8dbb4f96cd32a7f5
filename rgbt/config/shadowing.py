"""A user's own folder ``sweeps/`` or ``analysis/`` in the working directory, and ours.

``python -m`` looks for modules in the working directory first; the command ``rgbt`` looks there
last, so that it imports a user's own maskers and nothing of ours is hidden.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.machinery import PathFinder
from pathlib import Path

from rgbt.checks import InputError

ROOT = Path(__file__).resolve().parents[2]
"""The folder that holds our packages."""

SAFE_PATH = "PYTHONSAFEPATH"
"""Variable that keeps a Python from searching the working directory first."""


def search_working_directory_last() -> None:
    """Let imports look in the working directory after all other folders."""
    here = str(Path.cwd())
    sys.path[:] = [*(path for path in sys.path if path not in ("", here)), here]


def searches_working_directory_first() -> bool:
    """Whether this process was started as ``python -m`` is, and not by ``rgbt``."""
    return not sys.flags.safe_path and sys.path[:1] in ([""], [str(Path.cwd())])


@contextmanager
def starting_alike() -> Iterator[None]:
    """Pythons started within search the working directory first only if this process does."""
    before = os.environ.get(SAFE_PATH, "")
    if not searches_working_directory_first():
        os.environ[SAFE_PATH] = "1"
    try:
        yield
    finally:
        os.environ[SAFE_PATH] = before  # "" is as good as none


def check_not_shadowed(package: str, *, in_jobs: bool = False) -> None:
    """Refuse a folder or file of the user's that ``python -m`` imports instead of our package.

    Args:
        package: top-level name that is imported next.
        in_jobs: by processes that are started with ``python -m`` in the working directory.

    Raises:
        InputError: naming what shadows the package.
    """
    path = [str(Path.cwd()), *sys.path] if in_jobs else sys.path
    spec = PathFinder.find_spec(package, path)
    origin = Path(spec.origin).resolve() if spec is not None and spec.origin else None
    if origin is None or origin.is_relative_to(ROOT / package):
        return
    shown = origin.parent if origin.name == "__init__.py" else origin
    remedy = "" if in_jobs else "type `rgbt ...` instead of `python -m ...`, "
    raise InputError(
        f"{shown} is imported instead of rgbt's own package `{package}`, because python -m looks "
        f"in the working directory first; {remedy}rename it, or work in another folder."
    )
