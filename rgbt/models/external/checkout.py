"""Import the modules of a checkout so that they meet no other module of the same name.

The authors' packages are called `models`, `model` or `utils`, and several of them are needed in one
process. Inside `Checkout.imported` the folder is first on ``sys.path`` and its modules are in
``sys.modules``; outside, neither is. Each checkout is imported once per process.
"""

from __future__ import annotations

import importlib.util
import io
import logging
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cached_property
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

from rgbt.checks import InputError

KEPT = {"torch", "numpy", "rgbt", *sys.stdlib_module_names}
"""Modules that a file of the same name in a checkout never replaces."""

Stubs = Mapping[str, Mapping[str, str]]
"""Module that is not installed -> its attributes -> "module:object" that each of them is."""

_imported: dict[Checkout, dict[str, ModuleType]] = {}
"""Modules of each checkout that this process has imported."""


@dataclass(frozen=True)
class Checkout:
    """A checkout of an author's repository.

    Attributes:
        folder: that is put on ``sys.path``.
        empty_packages: packages of the checkout whose ``__init__.py`` is not executed.
        stubs: see `Stubs`, as tuples: (module, ((attribute, object), ...)).
    """

    folder: Path
    empty_packages: tuple[str, ...] = ()
    stubs: tuple[tuple[str, tuple[tuple[str, str], ...]], ...] = ()

    @classmethod
    def at(
        cls, checkout: str, root: str, empty_packages: tuple[str, ...], stubs: Stubs
    ) -> Checkout:
        """The checkout in the folder `checkout`, of which `root` is put on the path.

        Raises:
            InputError: no such folder, one outside of the checkout, or no folder of an empty
                package.
        """
        place = Path(checkout).expanduser()
        folder = place / root
        if not folder.resolve().is_relative_to(place.resolve()):  # the user trusts `checkout`
            raise InputError(
                f"model.root={root} leads out of model.checkout={checkout}; name a folder in it."
            )
        if not folder.is_dir():
            raise InputError(
                f"model.checkout={checkout}: the folder {folder} does not exist; name the folder "
                "of the author's repository, and with model.root=... a folder in it."
            )
        for name in empty_packages:
            if not folder.joinpath(*name.split(".")).is_dir():
                raise InputError(
                    f"model.empty_packages: {folder} has no package '{name}'; name packages of the "
                    "checkout."
                )
        frozen = tuple((name, tuple(sorted(each.items()))) for name, each in sorted(stubs.items()))
        return cls(folder.resolve(), tuple(empty_packages), frozen)

    @cached_property
    def names(self) -> frozenset[str]:
        """Names of the modules and packages at the top of the folder."""
        files = {path.stem for path in self.folder.glob("*.py")}
        folders = (path for path in self.folder.iterdir() if path.is_dir())
        return frozenset(files | {each.name for each in folders if next(each.rglob("*.py"), None)})

    def holds(self, name: str) -> bool:
        """Whether there is a file for a module of this dotted name."""
        place = self.folder.joinpath(*name.split("."))
        return place.with_name(f"{place.name}.py").is_file() or (place / "__init__.py").is_file()

    def has(self, module: ModuleType) -> bool:
        """Whether a module belongs to the checkout: its file, or where a package is searched."""
        file = getattr(module, "__file__", None)
        places = [file] if file else list(getattr(module, "__path__", ()))
        return any(f"{place}/".startswith(f"{self.folder}/") for place in places)

    @contextmanager
    def imported(self) -> Iterator[None]:
        """Within it, modules of the checkout can be imported; afterwards nothing of it is left.

        What its code prints, logs and warns is dropped. Modules of installed packages stay.
        """
        before = dict(sys.modules)
        stubs = self._stubs()  # looked for before the checkout is on the path
        for name in before:
            if name.partition(".")[0] in self.names - KEPT:
                del sys.modules[name]
        sys.modules.update(_imported.get(self) or {**self._packages(), **stubs})
        path, writes = list(sys.path), sys.dont_write_bytecode
        sys.path.insert(0, str(self.folder))
        sys.dont_write_bytecode = True
        try:
            with _quiet():
                yield
            _imported[self] = self._own_modules(stubs)
        finally:
            self._take_out(before, stubs)
            sys.path[:], sys.dont_write_bytecode = path, writes

    def _own_modules(self, stubs: Mapping[str, ModuleType]) -> dict[str, ModuleType]:
        named = sys.modules.items()
        return {name: each for name, each in named if name in stubs or self.has(each)}

    def _take_out(self, before: Mapping[str, ModuleType], stubs: Mapping[str, ModuleType]) -> None:
        """Remove the modules of the checkout, and put back those that they had replaced."""
        own = self._own_modules(stubs)
        for name in list(sys.modules):
            if name in own or name.partition(".")[0] in self.names - KEPT:
                del sys.modules[name]
        sys.modules.update({name: each for name, each in before.items() if name not in sys.modules})
        for place in list(sys.path_importer_cache):
            if Path(place).is_relative_to(self.folder):
                del sys.path_importer_cache[place]

    def _packages(self) -> dict[str, ModuleType]:
        """The empty packages, which find their modules but execute no ``__init__.py``."""
        found = {}
        for name in self.empty_packages:
            spec = ModuleSpec(name, None, is_package=True)
            spec.submodule_search_locations = [str(self.folder.joinpath(*name.split(".")))]
            found[name] = importlib.util.module_from_spec(spec)
        return found

    def _stubs(self) -> dict[str, ModuleType]:
        """Stand-ins of modules that are not installed, with the packages that they lie in.

        Packages of the checkout stay its own, also where a stub lies in them.
        """
        found: dict[str, ModuleType] = {}
        for name, attributes in self.stubs:
            if _is_installed(name):
                continue
            parts = name.split(".")
            for length in range(1, len(parts) + 1):
                package = ".".join(parts[:length])
                own = package != name and self.folder.joinpath(*parts[:length]).is_dir()
                if package not in found and not own and not _is_installed(package):
                    found[package] = _Stub(package)
            for attribute, target in attributes:
                setattr(found[name], attribute, _object(target))
        return found


class _Stub(ModuleType):
    """A package that is not installed; every attribute that it lacks is a `_Placeholder`."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.__path__: list[str] = []
        self.__spec__ = ModuleSpec(name, None, is_package=True)  # torch asks for it

    def __getattr__(self, key: str) -> Any:
        if key.startswith("__"):
            raise AttributeError(key)
        return _Placeholder()


class _Placeholder:
    """Something of a package that is not installed; as a decorator it changes nothing."""

    def __getattr__(self, key: str) -> Any:
        if key.startswith("__"):
            raise AttributeError(key)
        return self

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """The first argument where that is a class or function, as of a decorator."""
        decorated = len(arguments) == 1 and not keywords and callable(arguments[0])
        return arguments[0] if decorated else self


def _is_installed(name: str) -> bool:
    """Whether a module can be found; for one inside a package, the package is imported."""
    try:
        return sys.modules.get(name) is not None or importlib.util.find_spec(name) is not None
    except Exception:  # its package is not installed, or cannot be imported
        return False


def _object(target: str) -> Any:
    """The object "module:name" of an installed package, for a stub.

    Raises:
        InputError: not of this form, or there is no such object.
    """
    module, _, name = target.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(
            f"model.stubs: cannot import '{target}' ({error}); expected module:object of an "
            "installed package."
        ) from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Drop what the code prints and warns, and take its handlers from the root of the log."""
    root, dropped = logging.getLogger(), io.StringIO()
    handlers, level = list(root.handlers), root.level
    try:
        with redirect_stdout(dropped), redirect_stderr(dropped), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        root.handlers[:] = handlers
        root.setLevel(level)
