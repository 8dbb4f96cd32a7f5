"""Make a function a command whose arguments are all Hydra overrides."""

from __future__ import annotations

import inspect
import os
import re
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from functools import wraps
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from rgbt.checks import InputError, RunError
from rgbt.config.compose import (
    OWN_FOLDERS,
    check_keys,
    choices_in,
    composed,
    conf_dir,
    own_folders,
    own_paths,
    register_resolvers,
    searching,
)
from rgbt.config.options import WIDTH, readable_paths
from rgbt.config.overrides import check_words
from rgbt.config.plain_command import HELP, exit_code, name_of
from rgbt.runtime.group import taking_part
from rgbt.runtime.signals import answered

MULTIRUN = ("-m", "--multirun")
ONE_RUN = {"-r", "--run"}  # what is done without them
LAUNCHED = re.compile(r"\+*hydra/launcher=(?!['\"]?basic['\"]?$)")  # also one run is a job

CHOICES = "Choices of each group (experiment, search and debug take a plus):"
EXAMPLES = """\
A run:           rgbt run +experiment=grbm
Real data:       rgbt run +experiment=grbm dataset=mfnet dataset.root=/data/MFNet
Paper settings:  add scale=paper
A grid:          rgbt run -m +experiment=grbm masker.sigma_div=1,2,4
A search:        rgbt run -m +search=grbm
A job of SLURM:  add hydra/launcher=submitit_slurm to any of them
A table:         rgbt reproduce table=spatialseg/table3 seeds=3
A data set:      rgbt check dataset=mfnet dataset.root=/data/MFNet
To print the whole configuration of a command, add --cfg job. Rerun a command to resume it.
"""

Main = Callable[[DictConfig, list[str]], int | None]


def command(*, sweeper: str = "basic") -> Callable[[Main], Callable[[], None]]:
    """Make ``main(config, overrides)`` a command that is called with Hydra overrides.

    Grids, searches and Hydra's own options (``--cfg job``) are left to Hydra. Every point of a grid
    runs, also after one that failed; `sweeper` runs them, unless ``hydra/sweeper=`` is given.
    """

    def decorate(main: Main) -> Callable[[], None]:
        point = GridPoint(main)

        def run(words: list[str]) -> int | None:
            check_words(words)
            if set(words) & set(HELP):
                sys.stdout.write(configuration_help(main))
                return None
            options = {word for word in words if word.startswith("-")}
            if options <= ONE_RUN:
                words = [word for word in words if word not in options]
                is_launched = any(map(LAUNCHED.match, words))
                config, is_search = composed(_of_runs(words) if is_launched else words)
                if not is_launched and not is_search:
                    return point.checked(config, words)
                words += MULTIRUN[:is_launched]  # one job is a study of one point
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


class GridPoint:
    """The task function of Hydra: runs one point of a grid.

    A launcher that runs points in other processes, perhaps on other machines, sends a copy of it
    there by pickle. The codes of failed points are in this process; a copy raises instead.
    """

    def __init__(self, main: Main) -> None:
        self.main = main
        self.codes: list[int] | None = None

    def begin(self) -> list[int]:
        """Return the list that gets the code of every point that runs in this process."""
        self.codes = []
        return self.codes

    def checked(self, config: DictConfig, words: Sequence[str]) -> int | None:
        """Call the command, without the words for Hydra itself."""
        check_keys(config)
        return self.main(config, _of_runs(words))

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


def configuration_help(main: Main) -> str:
    """Return the text of ``--help`` of a command whose words are all overrides.

    Hydra lists the same choices in three times as long, for it composes the configuration first.
    """
    folders = [conf_dir(), *(Path(path.removeprefix("file://")) for path in own_paths())]
    choices: dict[str, set[str]] = {}
    for group, files in ((g, f) for folder in folders for g, f in _groups_of(folder)):
        choices.setdefault(group, set()).update(files)
    fill = textwrap.TextWrapper(
        WIDTH, subsequent_indent="    ", break_on_hyphens=False, break_long_words=False
    ).fill
    lines = [fill(f"  {group}: {', '.join(sorted(choices[group]))}") for group in sorted(choices)]
    usage = f"usage: {name_of(main.__module__)} [group=choice ...] [key=value ...]"
    about, listed = inspect.getdoc(main) or "", "\n".join(lines)
    return f"{about}\n\n{usage}\n\n{CHOICES}\n{listed}\n\n{EXAMPLES}"


def _groups_of(folder: Path) -> Iterator[tuple[str, set[str]]]:
    """Yield the groups in a folder of configuration files, with their choices; not Hydra's own."""
    for path in folder.rglob("*"):
        group = path.relative_to(folder).as_posix()
        if path.is_dir() and group.partition("/")[0] != "hydra" and (found := choices_in(path)):
            yield group, found


def _of_runs(words: Sequence[str]) -> list[str]:
    """Return the overrides that are not for Hydra itself."""
    return [word for word in words if not word.lstrip("+~").startswith(("hydra.", "hydra/"))]
