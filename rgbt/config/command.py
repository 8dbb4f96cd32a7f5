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
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from rgbt.checks import InputError, RunError, nearest, without_controls
from rgbt.config.component import build
from rgbt.config.compose import compose, conf_dir, register_resolvers
from rgbt.config.hydra_messages import check_words, hydra_sentence
from rgbt.config.keys import check_keys
from rgbt.runtime.resources import reporting_exhaustion
from rgbt.runtime.signals import Stopped, answered

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
                code = max([_report(lambda: _compose(config_name, job, words)), *codes])
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
    check_keys(config)
    return main(config)


def _compose(config_name: str, job: Callable[[DictConfig], None], words: Sequence[str]) -> None:
    check_words(words)
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
        return _say(hydra_sentence(error, words), 2)
    except (FileExistsError, NotADirectoryError) as error:
        return _say(f"{error.filename}: a file is where a folder is needed; name another path.", 2)
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
    # Names of files and words of damaged files may hold anything.
    sys.stderr.write(f"rgbt: {without_controls(sentence)}\n")
    return code


@contextmanager
def composing(overrides: Sequence[str]) -> Iterator[None]:
    """Turn what Hydra or OmegaConf refuses about `overrides` into an InputError."""
    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        raise InputError(hydra_sentence(error, overrides)) from error


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
        return build(config[node])


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
