"""The list of commands, and the code that parses their options and sets their exit codes.

Exit codes: 0 done, 1 the run failed or a check found problems, 2 the input was wrong, 129, 130 and
143 stopped by SIGHUP, Ctrl-C and SIGTERM, 141 nobody reads stdout. A failure prints one message on
stderr.
"""

from __future__ import annotations

import inspect
import os
import select
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from rgbt.checks import InputError, RunError, nearest, without_controls
from rgbt.config.options import help_text, parse, readable_paths, with_home
from rgbt.files.atomic import check_writable
from rgbt.runtime.signals import Stopped, answered, ending_command

T = TypeVar("T")
HELP = ("-h", "--help")


class Entry(NamedTuple):
    """A command: what ``python -m`` runs, and one line about it."""

    module: str
    about: str


COMMANDS = {
    "run": Entry("rgbt.run", "train one configuration; with -m: a grid or a search"),
    "evaluate": Entry("rgbt.evaluate", "score a run, or weights from a file"),
    "predict": Entry("rgbt.predict", "predict class maps and overlays of images, or pseudo-labels"),
    "consistency": Entry("rgbt.consistency", "measure the temporal consistency (TC, CA) of a run"),
    "robustness": Entry("rgbt.robustness", "score a run under missing, noisy or occluded images"),
    "profile": Entry("rgbt.profile", "measure speed, memory, parameters and FLOPs of networks"),
    "reproduce": Entry("sweeps.reproduce", "run a published table; new: write your own"),
    "claims": Entry("sweeps.claims", "print the claims of the papers with their verdicts"),
    "study": Entry("sweeps.study", "report a search, also while it runs"),
    "report": Entry("sweeps.report", "write pages of finished runs, tables and claims"),
    "compare": Entry("analysis.compare", "compare two methods: differences, intervals, p-values"),
    "details": Entry("analysis.details", "show boundary, calibration, distance and size scores"),
    "score": Entry("analysis.score", "score predictions of any method by region"),
    "spatial": Entry("analysis.spatial", "measure the statistics of a data set by region"),
    "figures": Entry("analysis.figures.__main__", "draw a figure of the papers"),
    "check": Entry("rgbt.data.check", "validate a whole data set and report its problems"),
    "align": Entry("rgbt.align", "align RGB and thermal images, or two videos in time"),
    "export": Entry("rgbt.export", "write a network as ONNX, compared with the network"),
    "weights": Entry("rgbt.weights", "inspect a file of weights, or export the weights of a run"),
    "archive": Entry("analysis.archive", "keep the results of runs in the repository"),
    "sync": Entry("rgbt.tracking.sync", "send run folders to MLflow"),
    "ui": Entry("rgbt.tracking.ui", "open MLflow at the runs of a folder"),
    "doctor": Entry("rgbt.doctor", "show what this installation has, for a bug report"),
    "masks": Entry("rgbt.maskers.sketch", "draw examples of a masker"),
}


def exit_code(work: Callable[[], int | None], *, catch_interrupt: bool = True) -> int:
    """Run `work` and return its exit code. In a grid, Ctrl-C is not caught: it ends all points."""
    try:
        with ending_command():
            return work() or 0
    except (InputError, RunError) as error:
        return say(str(error), 2 if isinstance(error, InputError) else 1)
    except KeyboardInterrupt as stop:
        if not catch_interrupt:
            raise
        if isinstance(stop, Stopped):
            return say(str(stop), stop.code)
        return say("interrupted; rerun the command to resume.", 130)  # a second Ctrl-C
    except Exception as error:
        library = type(error).__module__.partition(".")[0]
        if library == "submitit":  # a job that was lost, or reached its time limit
            return say(str(error), 1)
        if library in ("hydra", "omegaconf"):
            from rgbt.config.overrides import hydra_sentence  # --help does not wait for Hydra

            words = [word for word in sys.argv[1:] if not word.startswith("-")]
            return say(hydra_sentence(error, words), 2)
        if isinstance(error, OSError):
            return _code_of(error)
        if type(error).__name__ == "OutOfMemoryError":  # of torch, which --help does not import
            advice = "Use smaller images or batches, or trainer.accelerator=cpu"
            return say(f"{'. '.join(str(error).split('. ')[:2])}. {advice}.", 2)
        raise


def _is_unread() -> bool:
    """Whether the program that reads stdout has ended, as in ``rgbt doctor | head -n 5``."""
    state = select.poll()
    state.register(sys.stdout.fileno(), 0)
    return bool(state.poll(0))


def _code_of(error: OSError) -> int:
    """Say what the system refused, and return the exit code."""
    if isinstance(error, BrokenPipeError) and _is_unread():
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes at its end
        return 141
    file = str(error.filename or "a file")
    return say(f"{_with_setting(file)}: {error.strerror or error}.", 2)


def _with_setting(file: str) -> str:
    """Return a path after the word of the command line that names it, or a folder above it."""
    found, path = "", Path(file).absolute()
    for word in sys.argv[1:]:
        value = word.partition("=")[2]
        named = value and path.is_relative_to(Path(with_home(value)).absolute())
        found = word if named and len(word) > len(found) else found
    return found if found.endswith(f"={file}") else f"{found}: {file}".removeprefix(": ")


def name_of(module: str) -> str:
    """Return how a user types the command of a module: "rgbt check" of "rgbt.data.check"."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    module = spec.name if module == "__main__" and spec else module
    names = {entry.module: f"rgbt {name}" for name, entry in COMMANDS.items()}
    return names.get(module, module)


def say(sentence: str, code: int) -> int:
    """Print a message on stderr and return `code`."""
    with suppress(OSError):  # output may go to a file on a disk that is full
        sys.stdout.flush()
    # Names of files and words of damaged files may hold anything.
    sys.stderr.write(f"rgbt: {without_controls(sentence)}\n")
    sys.stderr.flush()
    return code


@dataclass(frozen=True)
class PlainCommand(Generic[T]):
    """``entry = PlainCommand(Options, main)``; called, it reads ``sys.argv`` and leaves.

    Attributes:
        options: frozen dataclass that declares the options.
        main: gets the options and all other words, overrides; its docstring is the help text.
        heeds: keys of the configuration that take effect, each with all below it; None: all.
        name: as it is typed; "": as `COMMANDS` names its module.
        first: option that the first word sets if it has no ``=``.
    """

    options: type[T]
    main: Callable[[T, list[str]], int | None]
    heeds: Sequence[str] | None = None
    name: str = ""
    first: str = ""

    def __call__(self) -> None:
        """Run with the words of ``sys.argv``; a mistake is one sentence on stderr."""
        words = sys.argv[1:]
        if set(words) & set(HELP):
            usage = f"{self.name or name_of(self.main.__module__)} {self.first.upper()}".strip()
            about = inspect.getdoc(self.main) or ""
            sys.stdout.write(f"{help_text(usage, self.options, about, self.first)}\n")
            sys.exit(0)
        with answered(), self._searching(words):
            code = exit_code(lambda: self.run(words))
        sys.exit(code)

    def _searching(self, words: Sequence[str]) -> AbstractContextManager[None]:
        """Use the search path in `words`; without Hydra for a command that composes nothing."""
        if self.heeds is not None and not self.heeds:
            return nullcontext()
        from rgbt.config.compose import searching  # --help does not wait for Hydra

        return searching(words)

    def run(self, words: Sequence[str]) -> int | None:
        """Parse `words` (see `rgbt.config.options.parse`) and do it."""
        if self.first and words and "=" not in words[0] and not words[0].startswith("-"):
            words = [f"{self.first}={words[0]}", *words[1:]]
        options, overrides = parse(self.options, words, self.heeds)
        out = vars(options).get("out")
        if isinstance(out, Path):  # before the work whose result it is for
            check_writable(f"out={out}", out.parent if out.suffix else out)
        return self.main(options, readable_paths(overrides))


@dataclass(frozen=True)
class CommandGroup:
    """A command with subcommands by name; `default` runs if the first word is none of them."""

    about: str
    commands: Mapping[str, PlainCommand[Any]]
    default: PlainCommand[Any] | None = None

    def __call__(self) -> None:
        """Run the command that ``sys.argv`` names; leaves by ``sys.exit``."""
        name = "".join(sys.argv[1:2])
        if name in self.commands:
            del sys.argv[1]
        command = self.commands.get(name, self.default)
        if command is not None:
            command()
        elif name not in HELP:
            sys.exit(say(f"'{name}' is not a command; {nearest(name, self.commands)}.", 2))
        sys.stdout.write(f"{self.about.strip()}\n")
        sys.exit(0)
