"""The command line: Hydra overrides in, one sentence and an exit code out.

Exit codes: 0 done, 1 the run failed or a check found problems, 2 the input was wrong, 129, 130 and
143 stopped by SIGHUP, Ctrl-C and SIGTERM.
"""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import wraps
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rgbt.checks import InputError, RunError, nearest
from rgbt.config import build, check, check_node, compose, conf_dir, register_resolvers
from rgbt.resources import reporting_exhaustion
from rgbt.stopping import Stopped, answered

Main = Callable[[DictConfig], int | None]


def command(
    config_name: str = "config", *, sweeper: str = "basic"
) -> Callable[[Main], Callable[[], None]]:
    """Make ``main(config)`` a command that is called with Hydra overrides.

    The configuration is composed and checked before `main` sees it. With ``-m`` every point runs,
    also after one that failed.

    Args:
        config_name: file of ``conf/`` without extension.
        sweeper: what works off the points of ``-m``, unless ``hydra/sweeper=`` is given.

    Returns:
        decorator; the decorated function takes no arguments and leaves by ``sys.exit``.
    """

    def decorate(main: Main) -> Callable[[], None]:
        @wraps(main)
        def entry() -> None:
            codes: list[int] = []
            # argparse takes overrides on one side of an option only, and people write -m anywhere.
            words = readable_paths(sys.argv[1:])
            if not any(word.startswith("hydra/sweeper=") for word in words):
                places = [n for n, word in enumerate(words) if "=" in word and word[0] != "-"]
                words.insert(places[0] if places else len(words), f"hydra/sweeper={sweeper}")
            sys.argv[1:] = sorted(words, key=lambda word: word not in ("-m", "--multirun"))

            def job(config: DictConfig) -> None:
                codes.append(_report(lambda: _checked(main, config), catch_interrupt=False))

            with answered():
                code = max([_report(lambda: _compose(config_name, job)), *codes])
            sys.exit(code)

        return entry

    return decorate


PATHS = ("model.weights", "pretrained", "dataset.root", "runs_dir", "out")


def readable_paths(words: list[str]) -> list[str]:
    """Arguments as Hydra reads them: shells keep ~ after "=", and file names hold anything.

    A path with "=", spaces or brackets (epoch=299.ckpt) is put in quotes; a comma still makes a
    grid. Names of earlier runs (experiment:NAME/last.pt) are read as they are.
    """
    found = []
    for word in words:
        key, equals, value = re.sub(r"=~(?=/|$)", f"={Path.home()}", word).partition("=")
        is_path = key in PATHS and not value.startswith("experiment:")
        if is_path and re.search(r"[=\s()\[\]{}:]", value) and value[0] not in "'\"":
            value = "'" + value.replace("'", "\\'") + "'"
        found.append(f"{key}{equals}{value}")
    return found


def task_overrides() -> list[str]:
    """Overrides of the running job as they were typed, e.g. ``["+experiment=grbm", "seed=1"]``."""
    return list(HydraConfig.get().overrides.task)


def _checked(main: Main, config: DictConfig) -> int | None:
    check(config)
    return main(config)


def _compose(config_name: str, job: Callable[[DictConfig], None]) -> None:
    # Only with this set does Hydra hand its own errors to us instead of printing them and leaving.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    # Hydra's root logger shows the INFO lines of every library.
    logging.getLogger("matplotlib").setLevel(logging.WARNING)
    register_resolvers()
    hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=config_name)(job)()


def _report(work: Callable[[], int | None], *, catch_interrupt: bool = True) -> int:
    """Exit code of `work`; a user's mistake is told in one sentence on stderr.

    Args:
        work: what to do.
        catch_interrupt: False inside a grid, where Ctrl-C ends all points and not only this one.
    """
    try:
        with reporting_exhaustion():
            return work() or 0
    except InputError as error:
        return _say(str(error), 2)
    except RunError as error:
        return _say(str(error), 1)
    except (HydraException, OmegaConfBaseException) as error:
        words = [word for word in sys.argv[1:] if not word.startswith("-")]
        return _say(_hydra_sentence(error, words), 2)
    except OSError as error:
        return _say(f"{error.filename or 'a file'}: {error.strerror or error}.", 2)
    except Stopped as stop:
        if not catch_interrupt:
            raise
        return _say(str(stop), stop.code)
    except KeyboardInterrupt:  # a second Ctrl-C
        if not catch_interrupt:
            raise
        return _say("interrupted; rerun the command to resume from its last checkpoint.", 130)


def _say(sentence: str, code: int) -> int:
    with suppress(OSError):  # output may go to a file on a disk that is full
        sys.stdout.flush()
    # Names of files and words of damaged files may hold anything, such as codes of a terminal.
    plain = "".join(each if each.isprintable() or each == "\n" else "?" for each in sentence)
    sys.stderr.write(f"rgbt: {plain}\n")
    return code


@contextmanager
def composing(overrides: Sequence[str]) -> Iterator[None]:
    """Turn what Hydra or OmegaConf refuses about `overrides` into an InputError."""
    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        raise InputError(_hydra_sentence(error, overrides)) from error


def built(node: str, overrides: Sequence[str]) -> Any:
    """The object that one node of the configuration describes, for commands that need no more.

    Args:
        node: its key, e.g. "dataset" or "tracking".
        overrides: as they were typed.

    Raises:
        InputError: overrides that Hydra refuses, or settings that the constructor does.
    """
    with composing(overrides):
        config = compose(overrides)
        check_node(config[node], node)
        return build(config[node])


def _hydra_sentence(error: Exception, overrides: Sequence[str]) -> str:
    """What Hydra or OmegaConf refused, in one sentence with the nearest known name."""
    if isinstance(error, MissingConfigException) and error.options:
        group, _, name = (error.missing_cfg_file or "").rpartition("/")
        return f"there is no {group or 'configuration'} '{name}'; {nearest(name, error.options)}."
    if isinstance(error, MissingConfigException):
        known = sorted(path.name for path in conf_dir().iterdir() if path.is_dir())
        match = re.search(r"'([^']+?)(?:/[^'/]*)?'", str(error))
        group = match.group(1) if match else "?"
        return f"there is no group '{group}'; {nearest(group, known)}."
    if isinstance(error, OverrideParseException):
        return (
            f"'{error.override}' is no override; expected key=value, with quotes around a value "
            "that holds commas, brackets or spaces: 'key=\"a, b\"'."
        )
    text = " ".join(str(error.__cause__ or error).split())
    key = re.search(r"Key '([^']+)' is not in struct full_key: (\S+)", text)
    if key:
        return _unknown_key(key.group(2), overrides)
    first = str(error).splitlines()[0].rstrip(".")
    return f"{first}; see `python -m rgbt.run --help`."


def _composed_without(full_key: str, overrides: Sequence[str]) -> DictConfig:
    """The configuration that was asked for, but for the key that it does not know."""
    others = [word for word in overrides if word.lstrip("+~").partition("=")[0] != full_key]
    try:
        return compose(others)
    except HydraException:  # a second mistake, or the comma lists of a grid
        return compose([])


def _unknown_key(full_key: str, overrides: Sequence[str]) -> str:
    sweeper = conf_dir() / "hydra" / "sweeper" / "study.yaml"
    if full_key.startswith("hydra.sweeper.") and full_key.count(".") == 2:
        settings = [str(key) for key in OmegaConf.load(sweeper) if key != "_target_"]
        last = full_key.rpartition(".")[2]
        return f"'{full_key}' is not a setting of a sweep; {nearest(last, settings)}."
    config = _composed_without(full_key, overrides)
    *parents, last = full_key.split(".")
    node: object = config
    for parent in parents:
        node = node.get(parent) if isinstance(node, DictConfig) else None
    known = [str(key) for key in node if key != "_target_"] if isinstance(node, DictConfig) else []
    return f"'{full_key}' is not a key of the configuration; {nearest(last, known)}."


def plain_command(
    own: Mapping[str, str | None], main: Callable[[dict[str, str], list[str]], int | None]
) -> Callable[[], None]:
    """Make `main` a command on something stored: ``key=value`` arguments, no configuration file.

    Args:
        own: the command's keys with their defaults; None: must be given.
        main: gets the values by key, and all other ``key=value`` arguments as Hydra overrides.

    Returns:
        function without arguments that leaves by ``sys.exit``.
    """

    def entry() -> None:
        arguments = sys.argv[1:]
        if any(item in ("-h", "--help") for item in arguments):
            usage = " ".join(f"{k}=..." if v is None else f"[{k}={v}]" for k, v in own.items())
            sys.stdout.write(f"{(main.__doc__ or '').strip()}\n\nusage: {usage} [overrides]\n")
            sys.exit(0)
        with answered():
            code = _report(lambda: main(*_split(own, arguments)))
        sys.exit(code)

    return entry


def _split(own: Mapping[str, str | None], arguments: list[str]) -> tuple[dict[str, str], list[str]]:
    values = {key: value for key, value in own.items() if value is not None}
    overrides = []
    for item in arguments:
        key, equals, value = item.partition("=")
        if not equals:
            raise InputError(f"'{item}': expected key=value; {nearest(key, own)}.")
        if key in own:
            values[key] = re.sub(r"^~(?=/|$)", str(Path.home()), value)
        else:
            overrides += readable_paths([item])
    for key in own:
        if key not in values:
            raise InputError(f"'{key}' has no value; give one with {key}=...")
    return values, overrides
