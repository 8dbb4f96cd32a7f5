"""Digest the code in a run that is not ours: the user's modules, and an author's checkout.

The digest is part of the run key. It covers the modules of the targets and their imports, which
are read from the source without importing anything. Modules whose names are computed at run time,
and files that the code reads, are not detected.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import pkgutil
import sys
import sysconfig
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from rgbt.config.stored_config import EXTERNAL, targets
from rgbt.files.adapters import adapter_of

# Packages whose targets do not count: their versions are in ``provenance.json``.
RELEASED = ("rgbt", "torch")

# Packages that are not the user's: ours may be in a working tree and not installed.
SHIPPED = (*RELEASED, "sweeps", "analysis", "hydra_plugins")

INSTALLED = {"site-packages", "dist-packages"}

# Prefix of the names of a checkout's modules, which may be names of the user's own.
PREFIX = "checkout/"

# Name of a recipe's adapter among these modules.
ADAPTER = "adapter"

# Name of a module and SHA-256 of its code, or name and version of an installed distribution.
Used = tuple[str, str]

# Digests of the code of each module when this process first read it.
_used_by: dict[str, tuple[Used, ...]] = {}


def user_code(named: Iterable[str]) -> tuple[Used, ...]:
    """Digest the code of a configuration's objects outside this package and torch.

    Args:
        named: values of `_target_`, such as "my_lab.losses.Boundary".

    Returns:
        modules of the user's own tree with the digest of their code, by name: those of the targets,
        their packages, and what all of these import. Of a target in an installed distribution the
        distribution and its version. () where every target is released. Each module is read once
        per process, so that the answer belongs to the code that this process has loaded.
    """
    own = set()
    for target in (name for name in named if name.split(".")[0] not in RELEASED):
        name = target.rpartition(".")[0]
        while "." in name and _place(name) is None:  # the longest beginning that is a module
            name = name.rpartition(".")[0]
        own.add(name)
    for module in own - set(_used_by):
        place = _place(module)
        if place is not None and INSTALLED & set(Path(place[0] or "").parts):
            packages = metadata.packages_distributions().get(module.split(".")[0], ())
            _used_by[module] = tuple((n, metadata.version(n)) for n in sorted(set(packages)))
        else:
            _used_by[module] = tuple(_modules_from(module, _own_file))
    return tuple(sorted({used for module in own for used in _used_by[module]}))


def checkout_code(model: Mapping[str, Any]) -> tuple[Used, ...]:
    """List the modules of a checkout that a network executes, with the digest of their code.

    An adapter of the recipe is one of them, and what it imports is followed.

    Args:
        model: plain values of the node.

    Returns:
        () where the network is no other author's, or there is no such module.
    """
    if model.get("_target_") != EXTERNAL:
        return ()
    root = Path(str(model.get("checkout"))).expanduser() / str(model.get("root"))
    constructor = str(model.get("constructor"))
    try:
        adapter = adapter_of(constructor)
    except FileNotFoundError:
        return ()

    def file_of(name: str) -> Path | None:
        place = root.joinpath(*name.split("."))
        files = (place / "__init__.py", place.with_name(f"{place.name}.py"))
        found = next((file for file in files if file.is_file()), None)
        return adapter if name == ADAPTER else found

    first = constructor.partition(":")[0] if adapter is None else ADAPTER
    found = {PREFIX + name: code for name, code in _modules_from(first, file_of)}
    return tuple(sorted(found.items())) if found.keys() - {PREFIX + ADAPTER} else ()


def code_of(plain: Mapping[str, Any]) -> dict[str, str]:
    """Return the user's own code and that of a checkout in a configuration: digest by module.

    Args:
        plain: the whole configuration as resolved values.
    """
    return dict((*user_code(targets(plain).values()), *checkout_code(plain["model"])))


def counted_modules() -> list[str]:
    """List the user's own modules that `user_code` has read and this process has imported."""
    names = {name for used in _used_by.values() for name, _ in used}
    return sorted(name for name in names & set(sys.modules) if name != "__main__")


def loaded_modules() -> list[str]:
    """Return the modules of the user's own tree that this process has imported."""
    files = [(name, getattr(module, "__file__", None)) for name, module in sys.modules.items()]
    return [name for name, file in files if name.split(".")[0] not in SHIPPED and _is_own(file)]


def _modules_from(module: str, file_of: Callable[[str], Path | None]) -> Iterator[Used]:
    """Yield a module and all that it imports, as far as `file_of` gives files, with digests."""
    waiting, seen = [*_with_packages(module)], set()
    while waiting:
        name = waiting.pop()
        file = None if name in seen else file_of(name)
        seen.add(name)
        if file is not None:
            status = file.stat()
            digest, imported = _parsed(name, file, (status.st_mtime_ns, status.st_size))
            waiting += imported
            yield name, digest


def _own_file(name: str) -> Path | None:
    """Return the file of a module of the user's own tree; None for all others."""
    place = None if name.split(".")[0] in RELEASED else _place(name)
    return Path(str(place[0])) if place is not None and _is_own(place[0]) else None


def _place(name: str) -> tuple[str | None, Any] | None:
    """Find the file of a module and where its submodules lie; None: there is no such module."""
    module = sys.modules.get(name)
    if module is not None:
        return getattr(module, "__file__", None), getattr(module, "__path__", None)
    package = name.rpartition(".")[0]
    if not package:
        specs = (finder.find_spec(name, None, None) for finder in sys.meta_path)
    else:
        # Finders of whole paths need the package imported; those of one folder do not.
        folders = (_place(package) or (None, None))[1] or ()
        importers = filter(None, map(pkgutil.get_importer, folders))
        specs = (importer.find_spec(name) for importer in importers)
    spec = next(filter(None, specs), None)
    return None if spec is None else (spec.origin, spec.submodule_search_locations)


def _is_own(file: str | None) -> bool:
    """Say whether a file is neither of Python nor of an installed distribution."""
    if file is None or INSTALLED & set(Path(file).parts) or not Path(file).is_file():
        return False
    library = (sysconfig.get_path("stdlib"), sysconfig.get_path("platstdlib"))
    return not any(Path(file).is_relative_to(folder) for folder in library)


@cache
def _parsed(name: str, file: Path, _state: tuple[int, ...]) -> tuple[str, list[str]]:
    """Return the digest of a module's code, and what it imports, for this state of the file."""
    content = file.read_bytes()
    try:
        tree = ast.parse(content) if file.suffix == ".py" else None
    except SyntaxError:  # imported in a function that has not been called
        tree = None
    if tree is None:  # or a compiled library
        return hashlib.sha256(content).hexdigest(), []
    package = name if file.name == "__init__.py" else name.rpartition(".")[0]
    return hashlib.sha256(repr(_structure(tree)).encode()).hexdigest(), [*_imports(tree, package)]


def _structure(node: Any) -> Any:
    """Return a syntax tree without what does not run: comments, layout, docstrings, line numbers.

    Empty fields are left out, so that Python versions that add fields give the same.
    """
    if isinstance(node, list):
        return [_structure(part) for part in node if not _is_docstring(part)]
    if not isinstance(node, ast.AST):
        return node
    fields = [(name, value) for name, value in ast.iter_fields(node) if value not in (None, [])]
    return (type(node).__name__, *((name, _structure(value)) for name, value in fields))


def _is_docstring(node: Any) -> bool:
    is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    return is_text and isinstance(node.value.value, str)


def _imports(tree: ast.AST, package: str) -> Iterator[str]:
    """Names that a module of `package` may import, with the packages that they lie in."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield from _with_packages(alias.name)
        elif isinstance(node, ast.ImportFrom):
            relative = "." * node.level + (node.module or "")
            base = importlib.util.resolve_name(relative, package) if node.level else relative
            yield from _with_packages(base)
            yield from (f"{base}.{alias.name}" for alias in node.names)


def _with_packages(name: str) -> Iterator[str]:
    """Return a dotted name and all its beginnings: importing a module runs its packages first."""
    parts = name.split(".")
    yield from (".".join(parts[: n + 1]) for n in range(len(parts)))
