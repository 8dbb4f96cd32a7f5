"""Read the configuration of a stored run without executing code that it names.

A ``_target_`` can name any callable, and building the node would run it. A stored configuration
may therefore name only the targets of ``conf/`` inside `rgbt`, and what modules define that the
user names with ``trust=``. Everything else is refused before it is imported.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError, split_list
from rgbt.config.component import constructor
from rgbt.config.compose import conf_dir, groups, top_level
from rgbt.files.yaml_files import read_yaml

NAMED = re.compile(r"_target_:\s*[\"']?(rgbt\.[\w.]+)", re.ASCII)
DOTTED = re.compile(r"[a-z_]\w*(\.[a-z_]\w*)*", re.IGNORECASE | re.ASCII)

# Target that executes code of the folder in its setting `checkout`.
EXTERNAL = "rgbt.models.external.network.ExternalNetwork"

# The key of a setting or group; what in any value acts; what in that of a group is a place.
KEY = re.compile(r"[a-z_]\w*([./][\w-]+)*", re.IGNORECASE | re.ASCII)
ACTS = re.compile(r"\$\{(?!px:\d+\})|_target_|\]\(|://")
PLACE = re.compile(r"^[\"']?[/~]|(^|/)\.\.(/|$)")

FOLDERS = ("/", "~", "./", "../")  # beginnings of a trusted folder; all else names a module


def load_config(path: Path, trust: Collection[str] = (), group: str = "") -> DictConfig:
    """Return a stored configuration whose objects may be built (see `check_targets`)."""
    settings = read_settings(path)
    check_targets(settings, trust, str(path), group)
    return OmegaConf.create(settings)


def read_settings(path: Path) -> dict[str, Any]:
    """Read the plain values of a stored configuration (see `settings_of`); nothing is built."""
    return settings_of(read_yaml(path), str(path))


def settings_of(plain: Any, source: str) -> dict[str, Any]:
    """Return `plain`; InputError: it is no mapping with texts as keys, or has an interpolation."""
    if not isinstance(plain, dict):
        raise InputError(f"{source}: expected a mapping of keys and values, got {_shown(plain)}.")
    for key, value in _walk(plain):
        if isinstance(value, str) and "${" in value:
            raise InputError(f"{source}: '{_shown(key)}' is an interpolation: {_shown(value)}.")
    for key in top_level()[0]:
        if key in plain and not isinstance(plain[key], dict):
            raise InputError(f"{source}: '{key}' must be a mapping with `_target_`.")
    return plain


def check_targets(
    settings: Mapping[str, Any], trust: Collection[str], source: str, group: str = ""
) -> None:
    """Refuse targets that are neither shipped nor trusted, wherever they are in `settings`.

    `trust` has modules, single targets and folders of checkouts; `source` is for messages; only the
    files of the folder `group` of ``conf/``, such as "masker", say what is shipped.
    """
    folders = [Path(word).expanduser().resolve() for word in trust if word.startswith(FOLDERS)]
    for key, checkout in checkouts(settings).items():
        folder = Path(checkout).expanduser().resolve()
        if not any(folder.is_relative_to(trusted) for trusted in folders):
            raise InputError(
                f"{source}: '{_shown(key)}' is {_shown(checkout)}, whose code would be executed. "
                f"If you trust it, add trust={_shown(str(folder))}; or set {_shown(key)}=..."
            )
    for key, target in targets(settings).items():
        if isinstance(target, str) and (target in shipped_targets(group) or target in trust):
            continue
        what = f"{source}: '{_shown(key)}' names {_shown(target)}, which"
        if not isinstance(target, str) or not _is_inside(target, trust):
            module = str(target).rpartition(".")[0]
            is_own = module.split(".")[0] not in sys.stdlib_module_names
            hint = f" If you trust that code, add trust={module}."
            hint = hint if is_own and DOTTED.fullmatch(module) else ""
            raise InputError(f"{what} no file of conf/{group} names.{hint}")
        # A trusted module may have imported what others define: os.system.
        named = constructor(target, "_target_")
        home = str(getattr(named, "__module__", None) or type(named).__module__)
        if not _is_inside(home, trust):
            raise InputError(f"{what} is defined in {home}. If you trust it, add {home} to trust=.")


def targets(settings: Any) -> dict[str, Any]:
    """Return every ``_target_`` by its dotted key, inside lists too."""
    return {key: value for key, value in _walk(settings) if key.rpartition(".")[2] == "_target_"}


def checkouts(settings: Any) -> dict[str, str]:
    """Return every folder whose code `EXTERNAL` would execute, by its dotted key."""
    found = dict(_walk(settings))
    folders = {}
    for key, value in found.items():
        checkout = f"{key.rpartition('.')[0]}.checkout".lstrip(".")
        if value == EXTERNAL and checkout in found:
            folders[checkout] = str(found[checkout])
    return folders


def check_words(words: Iterable[str], source: str) -> None:
    """Refuse stored words of a command that could do more than choose a file or set a value.

    Such words are shown for the user to type; none is ever composed. InputError names the word.
    """
    for word in words:
        key, equals, value = word.lstrip("+~").partition("=")
        is_plain = KEY.fullmatch(key) and (equals or word.startswith("~"))
        is_hydra = key.split(".")[0].split("/")[0] == "hydra"
        is_place = key.partition("/")[0] in groups() and PLACE.search(value)
        acts = is_hydra or key == "trust" or key.endswith(".checkout") or ACTS.search(word)
        if not is_plain or is_place or acts or not word.isprintable():
            raise InputError(f"{source}: the word {_shown(word)} is not one of a setting.")


def parse_trust(text: str) -> tuple[str, ...]:
    """Return the modules and folders (see `FOLDERS`) of ``trust=my.module,/code/GMNet``."""
    words = split_list(text, "modules") if text else []
    for word in words:
        if not DOTTED.fullmatch(word) and not word.startswith(FOLDERS):
            raise InputError(f"trust: expected names of modules or folders, got '{word}'.")
    return tuple(words)


@cache
def shipped_targets(group: str = "") -> frozenset[str]:
    """Return the targets inside `rgbt` that files of ``conf/`` (of ``conf/<group>/``) name."""
    files = (conf_dir() / group).rglob("*.yaml")
    return frozenset(name for path in files for name in NAMED.findall(path.read_text()))


def _walk(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted key and value of everything below `node`, at most 50 levels deep."""
    parts = dict(enumerate(node)) if isinstance(node, list) else node
    for key, value in parts.items() if isinstance(parts, Mapping) else ():
        if not isinstance(key, str | int):  # a number is a value of a label, in `dataset.ids`
            raise InputError(f"'{_shown(path)}': the key {_shown(key)} is not text.")
        dotted = f"{path}.{key}" if path else str(key)
        yield dotted, value
        yield from _walk(value, dotted)


def _is_inside(name: str, modules: Collection[str]) -> bool:
    return any(f"{name}.".startswith(f"{module}.") for module in modules)


def _shown(value: Any) -> str:
    """Cut a text of a stranger's, without its control characters."""
    return ascii(value).strip("'\"")[:100]
