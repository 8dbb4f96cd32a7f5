"""Error messages for a command line that Hydra refuses or would misread.

Hydra's own messages name neither the intended key nor the correct command.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra._internal.utils import get_args_parser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rgbt.checks import InputError, nearest, split_list
from rgbt.config.compose import (
    SEARCH_PATH,
    available,
    compose,
    conf_dir,
    flatten,
    groups,
    own_folders,
    top_level,
)

ADDED = ("experiment", "search", "debug")
"""Groups that are not in the defaults list; a command adds them with a plus."""

OF_RESOLVER = "InputError raised while resolving interpolation: "
"""What OmegaConf writes before the message of a resolver of ours."""


def check_words(words: Sequence[str]) -> None:
    """Refuse words of a command that Hydra would misread or ignore with a warning.

    Raises:
        InputError: an unknown option, a list of seeds, `seeds` as a value, a folder of
            configurations that is missing.
    """
    options = {each for action in get_args_parser()._actions for each in action.option_strings}
    for word in words:
        key, _, value = word.partition("=")
        if word.startswith("-") and key not in options:
            typed = _typed(key.lstrip("-"), value or "...")
            raise InputError(f"'{word}' is not an option; write settings as {typed}.")
        if key == "seed" and value.startswith("["):
            seeds = ",".join(split_list(value, "seeds"))
            raise InputError(
                f"'{word}': a run has one seed; for several runs use a grid: -m seed={seeds}."
            )
        if key == "seeds":
            raise InputError(
                f"'{word}': 'seeds' is a mapping; set the seed of one source "
                f"(seeds.order={value}), or that of the run (seed={value})."
            )
        for folder in split_list(value, "folders") if key == SEARCH_PATH else ():
            scheme, _, path = folder.strip("'\"").rpartition("://")
            if scheme in ("", "file") and not Path(path).is_dir():
                raise InputError(
                    f"'{word}': the folder {path} does not exist; give the absolute path of an "
                    "existing folder: 'hydra.searchpath=[file:///my/conf]'."
                )


def _typed(key: str, value: str) -> str:
    return f"+{key}={value}" if key in ADDED else f"{key}={value}"


def hydra_sentence(error: Exception, overrides: Sequence[str]) -> str:
    """The message for overrides that Hydra or OmegaConf refused, with the nearest known name."""
    if isinstance(error, MissingConfigException):
        missing = error.missing_cfg_file or ""
        group, _, name = missing.rpartition("/")
        if error.options:
            what = f"there is no {group or 'configuration'} '{name}'"
            return f"{what}; {nearest(name, error.options)}.{own_folder_hint()}"
        group = group or missing
        return f"there is no group '{group}'; {nearest(group, groups())}."
    if isinstance(error, OverrideParseException):
        return _no_override(str(error.override))
    text = " ".join(str(error.__cause__ or error).split())
    _, is_own, sentence = text.partition(OF_RESOLVER)
    if is_own:
        return re.sub(r" full_key:.*", "", sentence)
    key = re.search(r"Key '([^']+)' is not in struct full_key: (\S+)", text)
    if key:
        return _unknown_key(key[2], overrides)
    return _of_the_defaults(str(error).splitlines()[0].rstrip("."), overrides)


def own_folder_hint() -> str:
    """How to name a folder of the user's own files, where the command has none."""
    if own_folders():
        return ""
    return (
        f" To use your own file, add '{SEARCH_PATH}=[file:///my/conf]' or set RGBT_CONF=/my/conf."
    )


def _no_override(word: str) -> str:
    name = word.lstrip("+~").partition("=")[0]
    known = groups()
    expected = " or ".join(_typed(each, name) for each in known if name in available(each))
    if name in known:
        expected = _typed(name, "NAME")
    expected = expected or (
        "key=value, with quotes around a value that holds commas, brackets or spaces: "
        "'key=\"a, b\"'"
    )
    return f"'{word}' is not a valid override; expected {expected}."


def _of_the_defaults(first: str, overrides: Sequence[str]) -> str:
    """Messages about files of groups and about lists of values."""
    several = re.search(r"Ambiguous value for argument '([^']+)'", first)
    if several:
        return (
            f"'{several[1]}' holds several values. Add -m to run a grid, or quote them as one "
            "value: 'key=\"a, b\"'."
        )
    sizes = re.search(r"'\$\{by_scale:(.*)\}'", first)
    if sizes:
        return (
            f"the experiment supports only these scales: {sizes[1]}; choose the file yourself "
            "with group=NAME."
        )
    absent = re.search(r"Could not override '([^']+)'", first)
    if absent and absent[1] in ADDED:
        word = next((each for each in overrides if each.startswith(f"{absent[1]}=")), absent[1])
        return f"'{word}' needs a plus: +{word}."
    twice = re.search(r"Multiple values for ([^.]+)\. .*override [^:]+: ([^']+)'", first)
    if twice and twice[1] in ADDED:
        return f"+{twice[1]}= is given more than once; remove all but one."
    if twice:
        return f"remove the plus from '+{twice[1]}={twice[2]}': {twice[1]}={twice[2]}."
    return f"{first}; see `python -m rgbt.run --help`."


def _unknown_key(full_key: str, overrides: Sequence[str]) -> str:
    *parents, last = full_key.split(".")
    if parents == ["hydra", "sweeper"]:
        sweeper = OmegaConf.load(conf_dir() / "hydra" / "sweeper" / "study.yaml")
        return f"'{full_key}' is not a setting of a sweep; {nearest(last, _settings(sweeper))}."
    others = [word for word in overrides if word.lstrip("+~").partition("=")[0] != full_key]
    try:
        config = compose(others)
    except HydraException:  # another mistake, or the comma lists of a grid
        config = compose([])
    if full_key == "dataset.root" and "cache_dir" in config.dataset:
        return (
            "'dataset.root' is not a key of an embedded data set. Choose the data set that the "
            "folder contains: dataset=mfnet (or pst900, kp, freiburg, mvseg, video, folder) "
            "dataset.root=..."
        )
    for word in overrides:  # an empty mapping, such as model.stubs={pandas: {}}
        key = word.partition("=")[0]
        if full_key.startswith(f"{key}.") and not OmegaConf.select(config, key):
            return f"'{word}' adds keys and needs a plus: '+{word}'."
    node = OmegaConf.select(config, ".".join(parents)) if parents else config
    if node is None:
        return (
            f"'{full_key}' is not a key of the configuration, because {'.'.join(parents)} is null; "
            f"choose a file of {parents[0]}= that sets it."
        )
    known = _settings(node)
    hint = f"{nearest(last, known)}." if parents else _key_hint(config, last, known)
    return f"'{full_key}' is not a key of the configuration; {hint}"


def check_key(word: str, names: Sequence[str]) -> None:
    """Refuse a word without a dot that is not a key of the configuration: a misspelt option.

    `names` are the options of the command.
    """
    key = word.lstrip("+~").partition("=")[0]
    nodes, values = top_level()
    if key in (*nodes, *values, *ADDED) or word.startswith("+") or set(key) & set("./@"):
        return
    hint = _key_hint(compose([]), key, [*names, *nodes])
    raise InputError(f"'{key}' is not an option of this command; {hint}")


def _settings(node: Any) -> list[str]:
    return [str(key) for key in node if key != "_target_"] if OmegaConf.is_dict(node) else []


def _key_hint(config: DictConfig, name: str, known: Sequence[str]) -> str:
    """Keys of nodes that end in `name`, other than those of sizes; else the nearest of `known`."""
    try:
        leaves = list(flatten(config))
    except OmegaConfBaseException:  # values that must be given are missing
        leaves = []
    inner = [
        key
        for key in leaves
        if key.rpartition(".")[2] == name and key.partition(".")[0] not in ("scale", "recipe")
    ]
    return f"did you mean {' or '.join(inner)}?" if inner else f"{nearest(name, known)}."
