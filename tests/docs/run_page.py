"""Follow a page as its reader does, in an empty folder, with trainings of two steps."""

from __future__ import annotations

import importlib
import io
import os
import shutil
import subprocess
import sys
import traceback
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from rgbt.config.plain_command import COMMANDS
from tests.docs.blocks import Block, Page, PageError
from tests.docs.command_lines import FILES, HELP, OF_HYDRA, SETUP
from tests.docs.printed import difference
from tests.docs.reader_folder import expanded, export, forget_modules, write_titled
from tests.docs.shell import Line, is_compound, lines_of, without_runs

Call = Callable[..., tuple[int, str, str]]

SMOKE = ("+debug=smoke", "trainer.accelerator=cpu", "trainer.threads=1")
"""Overrides that make a training take seconds."""

ENOUGH = "dataset.num_test=12"
"""Images without which no two methods are compared; of a page that compares."""

RESAMPLING = ("compare", "score", "spatial")
"""Commands whose intervals need fewer resamples here."""

COMPARING = ("rgbt compare", "rgbt figures", "compare(")

NAMED = {word.lstrip("+") for word in (*SMOKE, ENOUGH)}
"""What the groups of runs are called after them."""

SIZES = ("trainer.max_steps", "trainer.eval_every", "trainer.checkpoint_every", "scale.max_steps")
SIZES += ("scale.eval_every", "scale.batch_size", "data.batch_size", "+debug")
"""Overrides of a page that these replace."""

STORE = ("rgbt report", "rgbt sync", "rgbt study", "mlflow", "tracking")
"""Words of a page that reads the MLflow store; elsewhere nothing is sent to it."""

MAX_SECONDS = 300
"""Of one command that is not part of this project."""


@dataclass
class Reader:
    """Follows one page.

    Attributes:
        page: to follow.
        folder: where; empty at first.
        call: calls an entry of a command in this process: exit code, stdout, stderr.
        variables: of the environment, undone at the end.
        make_run: puts a finished run into a folder of runs, for a page that begins with one.
        quick: leave out what starts processes of its own, and what reads their results.
        names: what the Python blocks of the page share.
    """

    page: Page
    folder: Path
    call: Call
    variables: pytest.MonkeyPatch
    make_run: Callable[[Path], None]
    quick: bool = False
    names: dict[str, Any] = field(default_factory=lambda: {"__name__": "__main__"})
    ran: int = 0

    def follow(self) -> int:
        """Do what every block says, in order; returns how many commands and Python blocks ran.

        Raises:
            PageError: a command or a block that fails, with page and line.
        """
        for block in self.page.blocks:
            if block.title:
                write_titled(block, self.folder)
            elif block.needs:
                continue
            elif block.language == "python":
                self._python(block)
            elif block.language == "bash":
                self._bash(block)
        return self.ran

    def _python(self, block: Block) -> None:
        text = "\n" * block.line + self._with_run(block.text, block.place())
        printed = io.StringIO()
        try:
            with redirect_stdout(printed):
                exec(compile(text, self.page.name, "exec"), self.names)
        except (Exception, SystemExit) as error:
            raise PageError(block.place(), traceback.format_exc(limit=-3)) from error
        differs = difference(block.answer, printed.getvalue()) if block.answer else ""
        # Scores of a training are other ones here: it has two steps.
        if differs and not Path("runs").exists():
            raise PageError(block.place(), differs)
        self.ran += 1

    def _bash(self, block: Block) -> None:
        if is_compound(block):
            self._shell(block.place(), block.text)
            return
        lines = lines_of(block)
        for number, line in enumerate(lines):
            self._line(line, block, shown=block.shown if number == len(lines) - 1 else "")

    def _line(self, line: Line, block: Block, *, shown: str) -> None:
        if line.program in ("export", ""):
            export(line, self.folder, self.variables)
        elif line.program == "cd":
            self.folder = (self.folder / line.words[1]).resolve()
            self.variables.chdir(self.folder)
            self.variables.syspath_prepend(str(self.folder))
        elif line.program == "rgbt" and line.alone:
            self._command(line, shown)
        elif line.program in FILES or not line.alone:
            number = int(line.place.rpartition(":")[2]) - block.line
            text = block.text.splitlines()[number - 1 :]
            last = next(n for n, each in enumerate(text) if not each.endswith("\\"))
            self._shell(line.place, "\n".join(text[: last + 1]))
        elif line.program not in SETUP:
            raise PageError(line.place, f"'{line.program}' cannot run in a test; mark the block")

    def _command(self, line: Line, shown: str) -> None:
        words = [expanded(self._with_run(word, line.place), self.folder) for word in line.words[1:]]
        if not words or set(words) & {*HELP, "--cfg"}:
            return
        name, *rest = words
        if self.quick and (name == "compare" or _starts_others(name, rest)):
            return
        module = importlib.import_module(COMMANDS[name].module)
        entry = module.main if name in OF_HYDRA else module.entry
        for variable, value in line.variables.items():
            self.variables.setenv(variable, expanded(value, self.folder))
        rest = [_group_names(word) for word in rest]
        code, out, err = self.call(entry, *self._small(name, rest))
        forget_modules(self.folder)
        for variable in line.variables:
            self.variables.delenv(variable)
        typed = f"rgbt {' '.join(words)}"
        # A page may show a mistake with the sentence that answers it.
        if code and not (shown and shown in " ".join(err.split())):
            ending = "\n".join(f"{out}\n{err}".strip().splitlines()[-12:])
            expected = f", expected the sentence '{shown}...'" if shown else ""
            raise PageError(line.place, f"{typed}: exit code {code}{expected}\n{ending}")
        self.ran += 1

    def _small(self, name: str, words: list[str]) -> list[str]:
        """The words of a command, with the sizes of a smoke test."""
        is_table = name == "reproduce" and words[:1] != ["new"]
        if name == "run" or (is_table and "dry_run=true" not in words):
            words = [word for word in words if word.partition("=")[0] not in SIZES]
            words += SMOKE
            is_embedded = all(w.startswith("dataset=synth") for w in words if w[:8] == "dataset=")
            if is_embedded and any(word in self.page.text for word in COMPARING):
                words.append(ENOUGH)
            if not any(word in self.page.text for word in STORE):
                words.append("tracking=none")
            if "hydra.sweeper.trials" in " ".join(words) or "+search=" in " ".join(words):
                words = [w for w in words if not w.startswith("hydra.sweeper.trials=")]
                words.append("hydra.sweeper.trials=2")
        if is_table:
            words = ["seeds=1" if word.startswith("seeds=") else word for word in words]
        if name in RESAMPLING:
            words = [
                *(word for word in words if not word.startswith("resamples=")),
                "resamples=100",
            ]
        return words

    def _with_run(self, text: str, place: str) -> str:
        """`text` with the newest run of the page for every ``runs/<key>``."""
        if without_runs(text) == text:
            return text
        runs = Path("runs")
        if not any(runs.glob("*/result.json")):
            self.make_run(runs)
        finished = sorted(runs.glob("*/result.json"), key=lambda path: path.stat().st_mtime)
        if not finished:
            raise PageError(place, "no run of this page has finished")
        return without_runs(text, f"runs/{finished[-1].parent.name}")

    def _shell(self, place: str, text: str) -> None:
        """Run lines in a shell, as they are: sizes of trainings cannot be changed in there."""
        if "rgbt run" in text and "debug=smoke" not in text:
            raise PageError(place, "a training in a loop or a pipe needs +debug=smoke, or a mark")
        script = self.folder / ".bin" / "rgbt"
        script.parent.mkdir(exist_ok=True)
        script.write_text(f'#!/bin/sh\nexec {sys.executable} -m rgbt "$@"\n')
        script.chmod(0o755)
        path = os.pathsep.join([str(script.parent), str(Path(sys.executable).parent)])
        environment = {**os.environ, "PATH": f"{path}{os.pathsep}{os.environ['PATH']}"}
        done = subprocess.run(
            ["bash", "-e", "-c", self._with_run(text, place)],
            **{"cwd": self.folder, "env": environment, "timeout": MAX_SECONDS},
            **{"capture_output": True, "text": True, "check": False},
        )
        if done.returncode:
            raise PageError(place, f"exit code {done.returncode}: {done.stderr[-1500:]}")
        self.ran += 1


def _starts_others(name: str, words: list[str]) -> bool:
    """Whether a command trains in processes of its own."""
    is_table = name == "reproduce" and words[:1] != ["new"] and "dry_run=true" not in words
    return is_table or (name == "run" and bool({"-m", "--multirun"} & set(words)))


def _group_names(word: str) -> str:
    """The groups of runs that an option names, as runs of the sizes of a smoke test call them."""
    key, _, value = word.partition("=")
    if key not in ("a", "b", "runs") or not Path("runs").is_dir():
        return word
    stored = {" ".join(w for w in group.split(" ") if w not in NAMED): group for group in groups()}
    pieces = [(label, stored.get(name, name)) for label, name in map(_labelled, value.split(","))]
    return f"{key}={','.join(label + name for label, name in pieces)}"


def groups() -> list[str]:
    from analysis.results import groups_in

    return groups_in("runs")


def _labelled(piece: str) -> tuple[str, str]:
    """ "label:run" as "label:" and "run"."""
    label, colon, name = piece.rpartition(":")
    return label + colon, name


def copied(source: Path) -> Callable[[Path], None]:
    """What puts a copy of the runs in `source` into a folder."""

    def make(runs: Path) -> None:
        shutil.copytree(source, runs, dirs_exist_ok=True)

    return make
