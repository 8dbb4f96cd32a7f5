"""Commands whose arguments are all Hydra overrides, and composition for the other commands.

For commands with options of their own see `rgbt.config.plain_command`.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import wraps
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.config.compose import (
    SEARCH_PATH,
    check_keys,
    compose,
    conf_dir,
    register_resolvers,
    searching,
)
from rgbt.config.config_source import parsing_once
from rgbt.config.hydra_messages import check_words, hydra_sentence
from rgbt.config.options import readable_paths
from rgbt.config.plain_command import exit_code
from rgbt.runtime.member import taking_part
from rgbt.runtime.signals import answered

MULTIRUN = ("-m", "--multirun")

Main = Callable[[DictConfig], int | None]


def command(*, sweeper: str = "basic") -> Callable[[Main], Callable[[], None]]:
    """Make ``main(config)`` a command that is called with Hydra overrides.

    The configuration is composed and checked before `main` sees it. With ``-m`` every point runs,
    also after one that failed. The decorated function takes no arguments and leaves by
    ``sys.exit``.

    Args:
        sweeper: runs the points of ``-m``, unless ``hydra/sweeper=`` is given.
    """

    def decorate(main: Main) -> Callable[[], None]:
        @wraps(main)
        def entry() -> None:
            codes: list[int] = []
            # argparse takes overrides on one side of an option only, and people write -m anywhere.
            words = readable_paths(sys.argv[1:])
            if not any(word.startswith("hydra/sweeper=") for word in words):
                first = (n for n, word in enumerate(words) if "=" in word and word[0] != "-")
                words.insert(next(first, len(words)), f"hydra/sweeper={sweeper}")
            sys.argv[1:] = sorted(words, key=lambda word: word not in MULTIRUN)

            def checked(config: DictConfig) -> int | None:
                check_keys(config)
                return main(config)

            def job(config: DictConfig) -> None:
                codes.append(exit_code(lambda: checked(config), catch_interrupt=False))

            def run() -> None:
                check_words(words)
                # Otherwise Hydra prints its own errors and exits.
                os.environ["HYDRA_FULL_ERROR"] = "1"
                # Hydra's root logger shows the INFO lines of every library.
                logging.getLogger("matplotlib").setLevel(logging.WARNING)
                register_resolvers()
                # To run, Hydra composes twice: first to learn hydra.mode. To show, as --cfg, once.
                is_shown = any(word[:1] == "-" and word not in MULTIRUN for word in words)
                with nullcontext() if is_shown else parsing_once():
                    hydra.main(
                        version_base="1.3", config_path=str(conf_dir()), config_name="config"
                    )(job)()

            with taking_part(), answered(), searching(words):
                code = max([exit_code(run), *codes])
            sys.exit(code)

        return entry

    return decorate


def words_of_run() -> list[str]:
    """Arguments with which another process runs the same configuration as this job of Hydra."""
    job = HydraConfig.get()
    if job.mode != RunMode.MULTIRUN:
        return sys.argv[1:]
    # One point of a grid: its values, and where the files of the configuration are.
    found = [word for word in job.overrides.hydra if word.startswith(f"{SEARCH_PATH}=")]
    return [*found, *job.overrides.task]


@contextmanager
def composing(overrides: Sequence[str]) -> Iterator[None]:
    """Turn errors of Hydra or OmegaConf about `overrides` into an InputError."""
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
        return build(compose(overrides)[node])
