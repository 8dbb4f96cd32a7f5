"""What is wrong with the words of a command line, in one sentence.

Hydra's own messages name neither the key that was meant nor what to type.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rgbt.checks import InputError, nearest, split_list
from rgbt.config.compose import compose, conf_dir, flatten
from rgbt.config.keys import top_level

ADDED = ("experiment", "search", "debug")
"""Groups of which the configuration holds no file by itself: they are added with a plus."""

OPTIONS = (
    *("-m", "--multirun", "-h", "--help", "--hydra-help", "--version", "-r", "--run"),
    *("-c", "--cfg", "--resolve", "-p", "--package", "-i", "--info", "-sc", "--shell-completion"),
    *("-cp", "--config-path", "-cn", "--config-name", "-cd", "--config-dir"),
    "--experimental-rerun",
)
"""Those of Hydra's command line."""


def check_words(words: Sequence[str]) -> None:
    """Refuse words that Hydra would read as something else, or leave aside with a warning.

    Args:
        words: of the command line, after the name of the command.

    Raises:
        InputError: an unknown option, a list of seeds, a folder of configurations that is missing.
    """
    for word in words:
        key, equals, value = word.partition("=")
        if word.startswith("-") and key not in OPTIONS:
            name = key.lstrip("-")
            raise InputError(
                f"'{word}' is no option; a setting is written as {_typed(name, value or '...')}."
            )
        if key == "seed" and value.startswith("["):
            seeds = ",".join(split_list(value, "seeds"))
            raise InputError(f"'{word}': a run has one seed; several are a grid: -m seed={seeds}.")
        if key == "hydra.searchpath":
            _check_folders(word, value)


def _check_folders(word: str, value: str) -> None:
    for place in split_list(value, "folders"):
        scheme, _, rest = place.strip("'\"").rpartition("://")
        if scheme in ("", "file") and not Path(rest).is_dir():
            raise InputError(
                f"'{word}': there is no folder {rest}; name an existing one with its whole path, "
                "'hydra.searchpath=[file:///my/conf]'."
            )


def _typed(key: str, value: str) -> str:
    return f"+{key}={value}" if key in ADDED else f"{key}={value}"


def hydra_sentence(error: Exception, overrides: Sequence[str]) -> str:
    """What Hydra or OmegaConf refused, in one sentence with the nearest known name.

    Args:
        error: as raised.
        overrides: as they were typed.
    """
    if isinstance(error, MissingConfigException) and error.options:
        group, _, name = (error.missing_cfg_file or "").rpartition("/")
        return f"there is no {group or 'configuration'} '{name}'; {nearest(name, error.options)}."
    if isinstance(error, MissingConfigException):
        match = re.search(r"'([^']+?)(?:/[^'/]*)?'", str(error))
        group = match.group(1) if match else "?"
        return f"there is no group '{group}'; {nearest(group, _groups())}."
    if isinstance(error, OverrideParseException):
        return _no_override(str(error.override))
    text = " ".join(str(error.__cause__ or error).split())
    key = re.search(r"Key '([^']+)' is not in struct full_key: (\S+)", text)
    if key:
        return _unknown_key(key.group(2), overrides)
    return _of_the_defaults(str(error).splitlines()[0].rstrip("."), overrides)


def _groups() -> list[str]:
    return sorted(path.name for path in conf_dir().iterdir() if path.is_dir())


def _no_override(word: str) -> str:
    name = word.lstrip("+~").partition("=")[0]
    files = [group for group in _groups() if (conf_dir() / group / f"{name}.yaml").is_file()]
    expected = "key=value, with quotes around a value that holds commas, brackets or spaces: "
    expected += "'key=\"a, b\"'"
    if name in _groups():
        expected = _typed(name, "NAME")
    elif files:
        expected = " or ".join(_typed(group, name) for group in files)
    return f"'{word}' is no override; expected {expected}."


def _of_the_defaults(first: str, overrides: Sequence[str]) -> str:
    """Messages on files that are chosen, and on several values."""
    several = re.search(r"Ambiguous value for argument '([^']+)'", first)
    if several:
        return (
            f"'{several[1]}' names several values, which is a grid: add -m; quotes make one value "
            "of it: 'key=\"a, b\"'."
        )
    absent = re.search(r"Could not override '([^']+)'", first)
    if absent and absent[1] in ADDED:
        word = next((each for each in overrides if each.startswith(f"{absent[1]}=")), absent[1])
        return f"'{word}' needs a plus: +{word}."
    twice = re.search(r"Multiple values for ([^.]+)\. .*override [^:]+: ([^']+)'", first)
    if twice and twice[1] in ADDED:
        return f"+{twice[1]}= may be given once; leave one of them out."
    if twice:
        return f"'+{twice[1]}={twice[2]}' is written without plus: {twice[1]}={twice[2]}."
    return f"{first}; see `python -m rgbt.run --help`."


def _composed_without(full_key: str, overrides: Sequence[str]) -> DictConfig:
    """The configuration of `overrides`, but for the key that it does not know."""
    others = [word for word in overrides if word.lstrip("+~").partition("=")[0] != full_key]
    try:
        return compose(others)
    except HydraException:  # a second mistake, or the comma lists of a grid
        return compose([])


def _unknown_key(full_key: str, overrides: Sequence[str]) -> str:
    sweeper = conf_dir() / "hydra" / "sweeper" / "study.yaml"
    *parents, last = full_key.split(".")
    if full_key.startswith("hydra.sweeper.") and full_key.count(".") == 2:
        settings = [str(key) for key in OmegaConf.load(sweeper) if key != "_target_"]
        return f"'{full_key}' is not a setting of a sweep; {nearest(last, settings)}."
    config = _composed_without(full_key, overrides)
    if full_key == "dataset.root" and "cache_dir" in config.dataset:
        return (
            "'dataset.root' is not a key of an embedded data set; name the data set that lies "
            "there: dataset=mfnet (or pst900, kp, freiburg, folder) dataset.root=..."
        )
    node: object = config
    for parent in parents:
        node = node.get(parent) if isinstance(node, DictConfig) else None
    known = [str(key) for key in node if key != "_target_"] if isinstance(node, DictConfig) else []
    inner = [] if parents else _below(config, last)
    hint = f"did you mean {' or '.join(inner)}?" if inner else f"{nearest(last, known)}."
    return f"'{full_key}' is not a key of the configuration; {hint}"


def top_level_keys() -> tuple[str, ...]:
    """What a word without a dot may name: keys of the configuration, and groups that are added."""
    nodes, values = top_level()
    return (*nodes, *values, *ADDED)


def key_hint(key: str, names: Sequence[str]) -> str:
    """What may be meant by a word that is neither an option nor a key of the configuration.

    Args:
        key: as typed, without a dot.
        names: options of the command.
    """
    inner = _below(compose([]), key)
    return (
        f"did you mean {' or '.join(inner)}" if inner else nearest(key, [*names, *top_level()[0]])
    )


def _leaves(config: DictConfig) -> list[str]:
    try:
        return list(flatten(config))
    except OmegaConfBaseException:  # values that must be given are missing
        return []


def _below(config: DictConfig, last: str) -> list[str]:
    """Keys of nodes that end in `last`, other than those of sizes that others take up."""
    return [
        key
        for key in _leaves(config)
        if key.rpartition(".")[2] == last and key.partition(".")[0] not in ("scale", "recipe")
    ]
