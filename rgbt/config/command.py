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

from rgbt.checks import InputError, RunError, nearest, split_list
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
ONE_RUN = {"-r", "--run"}  # what is done without them

# Groups that are not in the defaults list; a command adds them with a plus.
ADDED = ("experiment", "search", "debug")

# Launchers that are not installed with rgbt, and what is to be done.
LAUNCHERS = {
    "submitit_slurm": "it needs pip install 'rgbt[slurm]'",
    "submitit_local": "it needs pip install 'rgbt[slurm]'",
    "joblib": "its n_jobs is hydra.sweeper.workers",
}

Main = Callable[[DictConfig, list[str]], int | None]


def command(*, sweeper: str = "basic") -> Callable[[Main], Callable[[], None]]:
    """Make ``main(config, overrides)`` a command that is called with Hydra overrides.

    Grids, searches and Hydra's own options (``--cfg job``) are left to Hydra. Every point of a grid
    runs, also after one that failed; `sweeper` runs them, unless ``hydra/sweeper=`` is given.
    """

    def decorate(main: Main) -> Callable[[], None]:
        point = Point(main)

        def run(words: list[str]) -> int | None:
            check_words(words)
            options = {word for word in words if word.startswith("-")}
            if options <= ONE_RUN:
                words = [word for word in words if word not in options]
                config, is_search = composed(words)
                if not is_search:
                    _check_launcher(words)
                    return point.checked(config, words)
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
            codes = point.begin()
            words = readable_paths(sys.argv[1:])
            with taking_part(), answered(), searching(words):
                code = max([exit_code(lambda: run(words)), *codes])
            sys.exit(code)

        return entry

    return decorate


class Point:
    """The task function of Hydra: runs one point of a grid.

    A launcher that runs points in other processes, perhaps on other machines, sends a copy of it
    there by pickle. The codes of failed points are in this process; a copy raises instead.
    """

    def __init__(self, main: Main) -> None:
        self.main = main
        self.codes: list[int] | None = None

    def begin(self) -> list[int]:
        """The list that gets the code of every point that runs in this process."""
        self.codes = []
        return self.codes

    def checked(self, config: DictConfig, words: Sequence[str]) -> int | None:
        """Call the command, without the words for Hydra itself."""
        check_keys(config)
        overrides = [w for w in words if not w.lstrip("+~").startswith(("hydra.", "hydra/"))]
        return self.main(config, overrides)

    def __call__(self, config: DictConfig) -> None:
        """Run the point that Hydra has composed; see the class."""
        words = HydraConfig.get().overrides.task
        errors: list[Exception] = []

        def work() -> int | None:
            try:
                return self.checked(config, words)
            except Exception as error:
                errors.append(error)
                raise

        code = exit_code(work, catch_interrupt=False)
        if self.codes is not None:
            self.codes.append(code)
        elif code:
            kind = InputError if code == 2 else RunError
            raise kind(str(errors[0]) if errors else f"a point ended with code {code}.")

    def __getstate__(self) -> dict[str, Any]:
        return {"main": self.main, OWN_FOLDERS: own_folders()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        # The launcher composes the point where it runs, after it has read this copy.
        self.main, self.codes = state["main"], None
        os.environ[OWN_FOLDERS] = state[OWN_FOLDERS]
        register_resolvers()


def _check_launcher(words: Sequence[str]) -> None:
    """Refuse a launcher for one run, which Hydra would ignore: the run would be trained here."""
    for word in words:
        key, _, name = word.lstrip("+").partition("=")
        if key == "hydra/launcher" and name.strip("'\"") != "basic":
            raise InputError(f"{word}: it is for several runs; add -m.")


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
        if group == "hydra/launcher" and name in LAUNCHERS:
            return f"hydra/launcher={name}: {LAUNCHERS[name]}."
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
