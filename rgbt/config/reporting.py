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
    except OSError as error:  # Hydra's error of a missing configuration file is one, too
        return say(_of_hydra(error) or _of_file(error), 2)
    except Stopped as stop:
        if not catch_interrupt:
            raise
        return say(str(stop), stop.code)
    except KeyboardInterrupt:  # a second Ctrl-C
        if not catch_interrupt:
            raise
        return say("interrupted; rerun the command to resume from its last checkpoint.", 130)
    except Exception as error:
        sentence = _of_hydra(error)
        if sentence is None:
            raise
        return say(sentence, 2)


def _of_file(error: OSError) -> str:
    if isinstance(error, FileExistsError | NotADirectoryError):
        return f"{error.filename}: a file is where a folder is needed; name another path."
    return f"{error.filename or 'a file'}: {error.strerror or error}."


def _of_hydra(error: Exception) -> str | None:
    """What Hydra or OmegaConf refused; None of another error. Neither is imported for this."""
    package = type(error).__module__.partition(".")[0]
    if package not in ("hydra", "omegaconf"):
        return None
    from rgbt.config.hydra_messages import hydra_sentence

    return hydra_sentence(error, [word for word in sys.argv[1:] if not word.startswith("-")])


def say(sentence: str, code: int) -> int:
    """Write a sentence to stderr; returns `code`."""
    with suppress(OSError):  # output may go to a file on a disk that is full
        sys.stdout.flush()
    # Names of files and words of damaged files may hold anything.
    sys.stderr.write(f"rgbt: {without_controls(sentence)}\n")
    return code
