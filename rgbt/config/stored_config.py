"""Read the configuration of a stored run without executing code that it names.

A ``_target_`` can name any callable, and building the node would run it. A stored configuration
may therefore name only the targets of ``conf/`` inside `rgbt`, and the content of modules that the
user names with ``trust=``. Everything else is refused before it is imported. Classes and functions
of `rgbt` that no file of ``conf/`` names are refused as well: some of them write files. Overrides
on the command line follow Hydra's rules (`rgbt.config.component`).
"""

from __future__ import annotations

import re
import sys
from collections.abc import Collection, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError, split_list
from rgbt.config.component import constructor
from rgbt.config.compose import conf_dir, top_level
from rgbt.files.yaml_files import read_yaml

NAMED = re.compile(r"_target_:\s*[\"']?(rgbt\.[\w.]+)", re.ASCII)
DOTTED = re.compile(r"[a-z_]\w*(\.[a-z_]\w*)*", re.IGNORECASE | re.ASCII)
LONGEST_SHOWN = 100

EXTERNAL = "rgbt.models.external.network.ExternalNetwork"
"""Target that executes code of the folder in its setting `checkout`."""

FOLDERS = ("/", "~", "./", "../")
"""Beginnings of a trusted folder; everything else is the name of a module."""


def load_config(path: Path, trust: Collection[str] = ()) -> DictConfig:
    """A stored configuration whose objects may be built (see `check_targets`)."""
    settings = read_settings(path)
    check_targets(settings, trust, str(path))
    return OmegaConf.create(settings)


def read_settings(path: Path) -> dict[str, Any]:
    """Plain values of a stored configuration, from which nothing is built.

    Raises:
        InputError: not readable within the budget (`rgbt.files.yaml_files`), or see `settings_of`.
    """
    return settings_of(read_yaml(path), str(path))


def settings_of(plain: Any, source: str) -> dict[str, Any]:
    """`plain`, where it can be a stored configuration.

    Raises:
        InputError: not a mapping with text as keys, a node that is not a mapping, or an
            interpolation: a configuration is resolved when it is stored.
    """
    if not isinstance(plain, dict):
        raise InputError(f"{source}: expected a mapping of keys and values, got {_shown(plain)}.")
    for key, value in _walk(plain):
        if isinstance(value, str) and "${" in value:
            raise InputError(
                f"{source}: '{_shown(key)}' is {_shown(value)}; a stored configuration must not "
                "contain interpolations. Replace it with its value."
            )
    for key in top_level()[0]:
        if key in plain and not isinstance(plain[key], dict):
            raise InputError(f"{source}: '{key}' must be a mapping with `_target_`.")
    return plain


def check_targets(
    settings: Mapping[str, Any], trust: Collection[str], source: str, group: str = ""
) -> None:
    """Refuse targets that are neither shipped nor trusted, wherever they are in `settings`.

    Args:
        settings: plain values.
        trust: modules (or single targets) and folders of checkouts that the user trusts.
        source: where the settings come from, for messages.
        group: a folder of ``conf/`` that alone says what is shipped, such as "masker".

    Raises:
        InputError: naming source, key and target, and what to type.
    """
    for key, checkout in checkouts(settings).items():
        if not _is_below(checkout, trust):
            raise InputError(
                f"{source}: '{_shown(key)}' is {_shown(checkout)}, and opening the run executes "
                "the code in that folder. If you know this code and trust the author of the "
                f"configuration, add trust={_shown(checkout)}, or name your own checkout with "
                f"{_shown(key)}=..."
            )
    shipped = shipped_targets(group)
    for key, target in targets(settings).items():
        if isinstance(target, str) and (target in shipped or target in trust):
            continue
        home = None  # the module that defines it, where a trusted one is imported for it
        if isinstance(target, str) and _is_inside(target, trust):
            named = constructor(target, "_target_")
            home = str(getattr(named, "__module__", None) or type(named).__module__)
        if home is None or not _is_inside(home, trust):
            raise InputError(_refusal(source, key, target, home, group))


def targets(settings: Any) -> dict[str, Any]:
    """Every ``_target_`` by its dotted key, inside lists too."""
    return {key: value for key, value in _walk(settings) if key.rpartition(".")[2] == "_target_"}


def checkouts(settings: Any) -> dict[str, str]:
    """Every folder whose code `EXTERNAL` would execute, by its dotted key."""
    found = dict(_walk(settings))
    nodes = (key.rpartition(".")[0] for key, each in found.items() if each == EXTERNAL)
    keys = (f"{node}.checkout".lstrip(".") for node in nodes)
    return {key: str(found[key]) for key in keys if key in found}


def parse_trust(text: str) -> tuple[str, ...]:
    """Modules and folders of ``trust=my.module,/code/GMNet``; brackets around them are allowed.

    Raises:
        InputError: a word is neither a dotted name nor a folder (`FOLDERS`).
    """
    words = split_list(text, "modules") if text else []
    for word in words:
        if not DOTTED.fullmatch(word) and not word.startswith(FOLDERS):
            raise InputError(
                f"trust={text}: expected names of your own modules or folders of checkouts, "
                "separated by commas, such as trust=my_lab, trust=my_lab.models,other or "
                f"trust=/code/GMNet; got '{word}'."
            )
    return tuple(words)


@cache
def shipped_targets(group: str = "") -> frozenset[str]:
    """Targets inside `rgbt` that files of ``conf/`` (of ``conf/<group>/``) name."""
    files = sorted((conf_dir() / group).rglob("*.yaml"))
    return frozenset(name for path in files for name in NAMED.findall(path.read_text()))


def _walk(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted key and value of everything below `node`, which is at most 50 levels deep."""
    parts = dict(enumerate(node)) if isinstance(node, list) else node
    for key, value in parts.items() if isinstance(parts, Mapping) else ():
        if not isinstance(key, str) and parts is node:
            raise InputError(f"'{_shown(path)}': the key {key!r} is not text.")
        dotted = f"{path}.{key}" if path else str(key)
        yield dotted, value
        yield from _walk(value, dotted)


def _is_inside(name: str, modules: Collection[str]) -> bool:
    return any(f"{name}.".startswith(f"{module}.") for module in modules)


def _is_below(checkout: str, trust: Collection[str]) -> bool:
    """Whether a folder is a trusted one, or below one."""
    folder = Path(checkout).expanduser().resolve()
    known = [Path(each).expanduser().resolve() for each in trust if each.startswith(FOLDERS)]
    return any(folder.is_relative_to(each) for each in known)


def _refusal(source: str, key: str, target: Any, home: str | None, group: str) -> str:
    what = f"{source}: '{_shown(key)}' names {_shown(target)}, which "
    if home is not None:
        return (
            f"{what}is defined in {home}, a module that is not trusted. If you know that code, "
            f"add {home} to trust=... (the code is executed)."
        )
    what += f"no file of conf/{group} names. " if group else "is not part of rgbt's conf/. "
    is_name = isinstance(target, str) and DOTTED.fullmatch(target) is not None
    if not is_name or target.partition(".")[0] in sys.stdlib_module_names:
        return f"{what}It is refused: the configuration was damaged, or written to execute code."
    return (
        f"{what}A configuration can execute any code that it names. If you know this code and "
        "trust the author of the configuration, add "
        f"trust={_shown(target.rpartition('.')[0] or target)}."
    )


def _shown(value: Any) -> str:
    """Text of a stranger's without control characters, cut."""
    text = ascii(value).strip("'\"") if isinstance(value, str) else ascii(value)
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}..."
