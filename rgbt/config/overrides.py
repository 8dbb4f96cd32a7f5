"""Say in one sentence what is wrong with the overrides of a command."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra._internal.utils import get_args_parser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rgbt.checks import InputError, nearest, split_list
from rgbt.config.component import build
from rgbt.config.compose import OWN_FOLDERS, SEARCH_PATH, compose, groups, own_folders, top_level

# Groups that are not in the defaults list; a command adds them with a plus.
ADDED = ("experiment", "search", "debug")

# Launchers that are not installed with rgbt, and what is to be done.
LAUNCHERS = {
    "submitit_slurm": "it needs pip install 'rgbt[slurm]'",
    "submitit_local": "it needs pip install 'rgbt[slurm]'",
    "joblib": "its n_jobs is hydra.sweeper.workers",
}


def words_of_run(overrides: Sequence[str]) -> list[str]:
    """Return the arguments with which another process runs the configuration of `overrides`."""
    found = [word for word in sys.argv[1:] if word.startswith(f"{SEARCH_PATH}=")]
    return [*found, *overrides]


@contextmanager
def composing(overrides: Sequence[str]) -> Iterator[None]:
    """Turn errors of Hydra or OmegaConf about `overrides` into an InputError."""
    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        raise InputError(hydra_sentence(error, overrides)) from error


def built(node: str, overrides: Sequence[str]) -> Any:
    """Build the object of one node, such as "dataset"; InputError: its settings are refused."""
    with composing(overrides):
        return build(compose(overrides)[node])


def check_words(words: Sequence[str]) -> None:
    """Refuse an unknown option, on which Hydra prints its usage, and a missing search path."""
    options: set[str] = set()
    for action in get_args_parser()._actions:
        options.update(action.option_strings)
    for word in words:
        key, _, value = word.partition("=")
        if word.startswith("="):  # Hydra raises an error of Python
            raise InputError(f"'{word}': expected KEY=VALUE.")
        if word.startswith("-") and key not in options:
            raise InputError(f"'{word}' is not an option; write settings as KEY=VALUE.")
        for folder in split_list(value, "folders") if key == SEARCH_PATH else ():
            scheme, _, path = folder.strip("'\"").rpartition("://")
            if scheme in ("", "file") and not Path(path).is_dir():
                raise InputError(f"'{word}': the folder {path} does not exist.")


def hydra_sentence(error: Exception, overrides: Sequence[str]) -> str:
    """Return the message for overrides that Hydra or OmegaConf refused."""
    text = " ".join(str(error.__cause__ or error).split())
    if isinstance(error, OverrideParseException):
        reason = text.partition(" See https://")[0] if "=" in error.override else ""
        return f"'{error.override}': {reason or 'expected KEY=VALUE'}."
    if isinstance(error, MissingConfigException):
        return _missing_file_sentence(error)
    if of_resolver := re.search(r"InputError raised while .*?: (.*?)( full_key:.*)?$", text):
        return of_resolver[1]
    if unknown := re.search(r"Key '[^']+' is not in struct full_key: (\S+)", text):
        others = [word for word in overrides if word.lstrip("+~").partition("=")[0] != unknown[1]]
        try:
            config = compose(others)
        except (HydraException, OmegaConfBaseException):  # another mistake, or lists of a grid
            config = compose([])
        return f"'{unknown[1]}' is not a key of the configuration; {near_key(unknown[1], config)}."
    absent = re.search(r"Could not override '([^']+)'", str(error))
    if absent and absent[1] in ADDED:
        return f"'{absent[1]}' needs a plus: +{absent[1]}=NAME."
    return f"{' '.join(str(error).split()).rstrip('.')}."


def _missing_file_sentence(error: MissingConfigException) -> str:
    """Name the nearest file or group instead of the one that does not exist."""
    group, _, name = (error.missing_cfg_file or "").rpartition("/")
    if not error.options:
        return f"there is no group '{group or name}'; {nearest(group or name, groups())}."
    if group == "hydra/launcher" and name in LAUNCHERS:
        return f"hydra/launcher={name}: {LAUNCHERS[name]}."
    own = "" if own_folders() else f" For your own files set {SEARCH_PATH} or {OWN_FOLDERS}."
    return f"there is no {group} '{name}'; {nearest(name, error.options)}.{own}"


def near_key(key: str, config: DictConfig, names: Sequence[str] = ()) -> str:
    """Name the nearest keys: in the same node; of a key at the top, in all nodes and `names`."""
    parent, _, last = key.rpartition(".")
    if parent:
        node = OmegaConf.select(config, parent)
        return nearest(last, map(str, node)) if node else f"'{parent}' has no keys"
    sizes = ("scale", "recipe")  # they set keys of the other nodes
    found = []
    for name in map(str, config):
        node = config[name]
        if OmegaConf.is_dict(node) and name not in sizes and key in node:
            found.append(f"{name}.{key}")
    return f"did you mean {' or '.join(found)}" if found else nearest(key, {*names, *config})


def check_key(word: str, names: Sequence[str]) -> None:
    """Refuse a word without a dot that is neither a key of the configuration nor of `names`."""
    key = word.lstrip("+~").partition("=")[0]
    nodes, values = top_level()
    known = (*ADDED, *nodes, *values)
    if key not in known and not word.startswith("+") and not set(key) & set("./@"):
        hint = near_key(key, compose([]), names)
        raise InputError(f"'{key}' is not an option of this command; {hint}.")
