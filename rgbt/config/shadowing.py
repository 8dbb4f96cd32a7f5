"""Prevent a user's modules from replacing rgbt's packages, such as ``sweeps`` and ``analysis``.

``python -m`` looks for modules in the working directory and in the folders of PYTHONPATH first; the
command ``rgbt`` looks there last, so that it imports a user's own maskers and nothing of ours is
hidden.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.machinery import PathFinder
from pathlib import Path

from rgbt.checks import InputError

ROOT = Path(__file__).resolve().parents[2]
"""The folder that holds our packages."""

PACKAGES = ("rgbt", "sweeps", "analysis", "hydra_plugins")

SAFE_PATH = "PYTHONSAFEPATH"
"""Variable that keeps a Python from searching the working directory first."""


def search_user_folders_last() -> None:
    """Move the folders of PYTHONPATH and the working directory to the end of the search path."""
    users = [path for path in _python_path() if Path(path).resolve() != ROOT]
    users = list(dict.fromkeys([*users, str(Path.cwd())]))
    sys.path[:] = [*(path for path in sys.path if path not in ("", *users)), *users]


def _python_path() -> list[str]:
    return [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]


def searches_working_directory_first() -> bool:
    """Whether this process was started as ``python -m`` is, and not by ``rgbt``."""
    return not sys.flags.safe_path and sys.path[:1] in ([""], [str(Path.cwd())])


@contextmanager
def starting_alike() -> Iterator[None]:
    """Pythons started within search a user's folders first only if this process does."""
    before = {name: os.environ.get(name, "") for name in (SAFE_PATH, "PYTHONPATH")}
    if not searches_working_directory_first():
        os.environ[SAFE_PATH] = "1"
        if any(_shadow(package, _python_path()) for package in PACKAGES):
            os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), *_python_path()])
    try:
        yield
    finally:
        os.environ.update(before)  # "" is as good as none


def check_not_shadowed(package: str, *, in_jobs: bool = False) -> None:
    """Refuse a folder or file of the user's that ``python -m`` imports instead of our package.

    Args:
        package: top-level name that is imported next.
        in_jobs: by processes that are started with ``python -m`` in the working directory.

    Raises:
        InputError: naming what shadows the package.
    """
    shadow = _shadow(package, [str(Path.cwd()), *sys.path] if in_jobs else sys.path)
    if shadow is None:
        return
    is_here = shadow.parent == Path.cwd()
    first = "in the working directory" if is_here else "in the folders of PYTHONPATH"
    remedy = "" if in_jobs else "type `rgbt ...` instead of `python -m ...`, "
    away = "work in another folder" if is_here else f"remove {shadow.parent} from PYTHONPATH"
    raise InputError(
        f"{shadow} would be imported instead of rgbt's own package `{package}`, because python -m "
        f"searches {first} first; {remedy}rename it, or {away}."
    )


def _shadow(package: str, path: Sequence[str]) -> Path | None:
    """What `package` is on this search path, if it is not ours."""
    spec = PathFinder.find_spec(package, list(path))
    origin = Path(spec.origin).resolve() if spec is not None and spec.origin else None
    if origin is None or origin.is_relative_to(ROOT / package):
        return None
    return origin.parent if origin.name == "__init__.py" else origin
