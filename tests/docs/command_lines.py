"""Command lines of the documentation against the program: commands, options, configuration keys.

Nothing runs: options are parsed, overrides are composed, and the run that they name is specified.
"""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser

from rgbt.checks import InputError, nearest
from rgbt.config.command import check_words, composing
from rgbt.config.compose import check_keys, compose
from rgbt.config.options import parse, readable_paths
from rgbt.config.plain_command import COMMANDS, CommandGroup, PlainCommand
from tests.docs.blocks import ROOT, PageError
from tests.docs.shell import PLACEHOLDER, Line, without_runs

HELP = ("-h", "--help", "--version")
NOT_COMPOSED = ("corruption.", "weights.", "predictions.", "pretrained.", "hydra.searchpath=")
"""Words that are no overrides of one configuration: what a command reads by itself."""

FILES = {
    "python",
    "cd",
    "mkdir",
    "cp",
    "mv",
    "cat",
    "ls",
    "rm",
    "head",
    "tail",
    "find",
    "echo",
    "touch",
}
FILES |= {
    "umask",
    "wc",
    "grep",
    "sed",
    "sort",
    "tar",
    "unzip",
    "chmod",
    "export",
    "true",
    "test",
    "tree",
}
SETUP = {
    "pip",
    "pip3",
    "git",
    "source",
    "make",
    "conda",
    "uv",
    "sudo",
    "curl",
    "deactivate",
    "eval",
}
SERVERS = {
    "initdb",
    "mlflow",
    "optuna-dashboard",
    "torchrun",
    "sbatch",
    "srun",
    "squeue",
    "scancel",
    "ssh",
}
SERVERS |= {"psql", "createdb", "createuser", "pg_ctl", "initdb", "docker", "rsync", "scp", "kill"}
SERVERS |= {"nvidia-smi", "sinfo", "scontrol", "sleep", "xdg-open", "open", "jupyter", "nohup"}
LOCAL_DATA = re.compile(r"(^|[=:\[,'\"])/data/")
composed: set[tuple[str, ...]] = set()


def check_line(line: Line, needs: str, *, script: bool = False) -> None:
    """Refuse a command line that the program would refuse.

    Args:
        line: of a block of bash.
        needs: what its block is marked to need; "": nothing.
        script: whether it is part of a script, which may use any command of the shell.

    Raises:
        PageError: with the reason.
    """
    program = line.program
    if not program:
        return
    if program == "rgbt":
        try:
            check_command(line.words[1:])
        except InputError as error:
            raise PageError(line.place, str(error)) from error
    elif program == "make":
        _check_targets(line)
    elif program not in FILES | SETUP | SERVERS and not script:
        raise PageError(
            line.place,
            f"'{program}' is not a command that pages may use; a block of output is ```text, and "
            "another command is added to the lists of tests/docs/command_lines.py",
        )
    if needs or script:
        return
    if program in SERVERS:
        raise PageError(line.place, f"'{program}' cannot run in a test; {_mark('PostgreSQL')}")
    if any(LOCAL_DATA.search(word) for word in line.words) and program not in SETUP:
        raise PageError(line.place, f"the data of /data/ is not in a test; {_mark('MFNet')}")
    if line.has_placeholder and program not in SETUP:
        raise PageError(
            line.place,
            f"a word in <> or with ... cannot run; write a value, or {_mark('MFNet')}",
        )


def _mark(example: str) -> str:
    return f"write <!-- needs: {example} --> (or what it needs) on the line before the block"


def _check_targets(line: Line) -> None:
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for word in line.words[1:]:
        if "=" not in word and word not in targets:
            raise PageError(line.place, f"make has no target '{word}'; {nearest(word, targets)}")


OF_HYDRA = ("run", "check", "masks")
"""Commands whose arguments are all overrides."""


def check_command(words: Sequence[str]) -> None:
    """Refuse words behind ``rgbt`` that the program would refuse.

    Raises:
        InputError: an unknown command, option or key, or a value of a wrong type.
    """
    name, *rest = [without_runs(word) for word in words] or ["--help"]
    if name in HELP:
        return
    if name not in COMMANDS:
        raise InputError(f"'{name}' is not a command; {nearest(name, COMMANDS)}.")
    if set(rest) & {*HELP, "--cfg"}:
        return
    if name in OF_HYDRA:
        _check_overrides(rest, is_run=name == "run")
        return
    command = importlib.import_module(COMMANDS[name].module).entry
    if isinstance(command, CommandGroup):
        command, rest = _member(command, rest)
    _check_options(command, rest)


def _member(group: CommandGroup, words: list[str]) -> tuple[PlainCommand[Any], list[str]]:
    if words and words[0] in group.commands:
        return group.commands[words[0]], words[1:]
    if group.default is None:
        name = words[0] if words else ""
        raise InputError(f"expected a command, got '{name}'; {nearest(name, group.commands)}.")
    return group.default, words


def _check_options(command: PlainCommand[Any], words: list[str]) -> None:
    if command.first and words and "=" not in words[0]:
        words = [f"{command.first}={words[0]}", *words[1:]]
    words = [PLACEHOLDER.sub("1", word) for word in words]
    options, overrides = parse(command.options, words, command.heeds)
    # `sync` and `ui` compose nothing: their experiment is one of MLflow.
    experiment = getattr(options, "experiment", "") if command.heeds != () else ""
    overrides = [f"+experiment={experiment}", *overrides] if experiment else overrides
    table = next((word[6:] for word in words if word.startswith("table=")), "")
    if table and (ROOT / "sweeps/tables" / table).parent.is_dir() and "/" in table:
        from sweeps.table.load_table import load_table

        load_table(table)
    if "dataset" not in map(_key, overrides) and any(w[:8] == "dataset." for w in overrides):
        overrides = ["dataset=mfnet", *overrides]  # that of the run, the weights or the table
    _check_overrides(overrides)


def _key(word: str) -> str:
    return word.partition("=")[0]


def _check_overrides(words: Sequence[str], *, is_run: bool = False) -> None:
    """Compose overrides; of a run, check it as `rgbt run` does before it starts."""
    check_words([word for word in words if not word.startswith("hydra.searchpath=")])
    overrides = [
        word
        for word in readable_paths(words)
        if not word.startswith(("-", *NOT_COMPOSED)) and not PLACEHOLDER.search(word)
    ]
    if any(word.startswith("hydra.sweeper.") or "search=" in word for word in overrides):
        overrides = ["hydra/sweeper=study", *overrides]
    own = os.environ.get("RGBT_CONF", "")
    key = (own, str(is_run), *sorted(overrides))
    if not overrides or (key in composed and not own):
        return
    with composing(overrides):
        overrides = [_first_value(word) for word in overrides]
        config = compose(overrides)
        check_keys(config)
        if is_run and not PLACEHOLDER.search(" ".join(words)):
            from rgbt.runs.specify import specify

            specify(config, overrides)
    composed.add(key)


def _first_value(word: str) -> str:
    """An override with the first of its values, where it is a grid."""
    key, _, value = word.partition("=")
    if "," not in value and "(" not in value:
        return word
    parsed = OverridesParser.create().parse_override(word)
    if not parsed.is_sweep_override():
        return word
    return f"{key}={next(parsed.sweep_string_iterator())}"
