"""Whatever ends a command: one sentence on stderr and an exit code.

Exit codes: 0 done, 1 the run failed or a check found problems, 2 the input was wrong, 129, 130 and
143 stopped by SIGHUP, Ctrl-C and SIGTERM.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress

from rgbt.checks import InputError, RunError, without_controls
from rgbt.runtime.resources import reporting_exhaustion
from rgbt.runtime.signals import Stopped


def exit_code(work: Callable[[], int | None], *, catch_interrupt: bool = True) -> int:
    """Exit code of `work`; a user's mistake is reported in one sentence on stderr.

    Args:
        work: what to do.
        catch_interrupt: False inside a grid, where Ctrl-C ends all points and not only this one.
    """
    try:
        with reporting_exhaustion():
            return work() or 0
    except InputError as error:
        return say(str(error), 2)
    except RunError as error:
        return say(str(error), 1)
    except KeyboardInterrupt as stop:
        if not catch_interrupt:
            raise
        if isinstance(stop, Stopped):
            return say(str(stop), stop.code)
        # A second Ctrl-C.
        return say("interrupted; rerun the command to resume from its last checkpoint.", 130)
    except Exception as error:
        sentence = _of_library(error)
        if sentence is None:
            raise
        return say(sentence, 2)


def _of_library(error: Exception) -> str | None:
    """What Hydra, OmegaConf or the system refused; None of another error."""
    if type(error).__module__.partition(".")[0] in ("hydra", "omegaconf"):
        from rgbt.config.hydra_messages import hydra_sentence  # --help does not wait for Hydra

        return hydra_sentence(error, [word for word in sys.argv[1:] if not word.startswith("-")])
    if isinstance(error, FileExistsError | NotADirectoryError):
        return f"{error.filename}: a file is where a folder is needed; name another path."
    if isinstance(error, OSError):
        return f"{error.filename or 'a file'}: {error.strerror or error}."
    return None


def say(sentence: str, code: int) -> int:
    """Write a sentence to stderr; returns `code`."""
    with suppress(OSError):  # output may go to a file on a disk that is full
        sys.stdout.flush()
    # Names of files and words of damaged files may hold anything.
    sys.stderr.write(f"rgbt: {without_controls(sentence)}\n")
    return code
