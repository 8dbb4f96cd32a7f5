"""Commands whose arguments are all Hydra overrides, and messages for overrides that are refused."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rgbt.checks import InputError, nearest, split_list
from rgbt.config.component import build
from rgbt.config.compose import (
    OWN_FOLDERS,
    SEARCH_PATH,
    check_keys,
    compose,
    composed,
    conf_dir,
    groups,
    own_folders,
    register_resolvers,
    searching,
    top_level,
)
from rgbt.config.options import readable_paths
from rgbt.config.plain_command import exit_code
from rgbt.runtime.group import taking_part
from rgbt.runtime.signals import answered

MULTIRUN = ("-m", "--multirun")

# Groups that are not in the defaults list; a command adds them with a plus.
ADDED = ("experiment", "search", "debug")

Main = Callable[[DictConfig, list[str]], int | None]


def command(*, sweeper: str = "basic") -> Callable[[Main], Callable[[], None]]:
    """Make ``main(config, overrides)`` a command that is called with Hydra overrides.

    Grids, searches and Hydra's own options (``--cfg job``) are left to Hydra. Every point of a grid
    runs, also after one that failed; `sweeper` runs them, unless ``hydra/sweeper=`` is given.
    """

    def decorate(main: Main) -> Callable[[], None]:
        codes: list[int] = []

        def checked(config: DictConfig, words: Sequence[str]) -> int | None:
            check_keys(config)
            overrides = [w for w in words if not w.lstrip("+~").startswith(("hydra.", "hydra/"))]
            return main(config, overrides)

        def point(config: DictConfig) -> None:
            words = HydraConfig.get().overrides.task
            codes.append(exit_code(lambda: checked(config, words), catch_interrupt=False))

        def run(words: list[str]) -> int | None:
            check_words(words)
            if not any(word.startswith("-") for word in words):
                config, is_search = composed(words)
                if not is_search:
                    return checked(config, words)
            if not any(word.startswith("hydra/sweeper=") for word in words):
                first = (n for n, word in enumerate(words) if "=" in word and word[0] != "-")
                words.insert(next(first, len(words)), f"hydra/sweeper={sweeper}")
            # argparse takes overrides on one side of an option only, and people write -m anywhere.
            sys.argv[1:] = sorted(words, key=lambda word: word not in MULTIRUN)
            os.environ["HYDRA_FULL_ERROR"] = "1"  # otherwise Hydra prints its own errors and exits
            register_resolvers()
            config_dir = str(conf_dir())
            hydra.main(version_base="1.3", config_path=config_dir, config_name="config")(point)()
            return None

        @wraps(main)
        def entry() -> None:
            codes.clear()
            words = readable_paths(sys.argv[1:])
            with taking_part(), answered(), searching(words):
                code = max([exit_code(lambda: run(words)), *codes])
            sys.exit(code)

        return entry

    return decorate


def words_of_run(overrides: Sequence[str]) -> list[str]:
    """Arguments with which another process runs the configuration of these `overrides`."""
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
    """The object of one node, such as "dataset"; InputError where its settings are refused."""
    with composing(overrides):
        return build(compose(overrides)[node])


def check_words(words: Sequence[str]) -> None:
    """Refuse an unknown option, on which Hydra prints its usage, and a missing search path."""
    options = {each for action in get_args_parser()._actions for each in action.option_strings}
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
    """The message for overrides that Hydra or OmegaConf refused."""
    text = " ".join(str(error.__cause__ or error).split())
    if isinstance(error, OverrideParseException):
        reason = text.partition(" See https://")[0] if "=" in error.override else ""
        return f"'{error.override}': {reason or 'expected KEY=VALUE'}."
    if isinstance(error, MissingConfigException):
        group, _, name = (error.missing_cfg_file or "").rpartition("/")
        if not error.options:
            return f"there is no group '{group or name}'; {nearest(group or name, groups())}."
        own = "" if own_folders() else f" For your own files set {SEARCH_PATH} or {OWN_FOLDERS}."
        return f"there is no {group} '{name}'; {nearest(name, error.options)}.{own}"
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


def near_key(key: str, config: DictConfig, names: Sequence[str] = ()) -> str:
    """The nearest keys: in the same node; of a key at the top, also in all nodes and of `names`."""
    parent, _, last = key.rpartition(".")
    if parent:
        node = OmegaConf.select(config, parent)
        return nearest(last, map(str, node)) if node else f"'{parent}' has no keys"
    sizes = ("scale", "recipe")  # they set keys of the other nodes
    nodes = [n for n in map(str, config) if OmegaConf.is_dict(config[n]) and n not in sizes]
    inner = " or ".join(f"{node}.{key}" for node in nodes if key in config[node])
    return f"did you mean {inner}" if inner else nearest(key, {*names, *map(str, config)})


def check_key(word: str, names: Sequence[str]) -> None:
    """Refuse a word without a dot that is neither a key of the configuration nor of `names`."""
    key = word.lstrip("+~").partition("=")[0]
    known = (*ADDED, *(each for keys in top_level() for each in keys))
    if key not in known and not word.startswith("+") and not set(key) & set("./@"):
        hint = near_key(key, compose([]), names)
        raise InputError(f"'{key}' is not an option of this command; {hint}.")
