"""Process 0 of several that train one run: it decides and writes, and the others follow.

It works through the pipeline (`rgbt.training.pipeline`) as a process alone does. It sends the key
of each run that is to be trained to the others, which wait for it (`rgbt.training.follow`). So what
depends on files, such as which upstream runs are finished, is decided once. With one process,
nothing here has an effect.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rgbt.checks import InputError
from rgbt.processes import agreed, collected, num_processes
from rgbt.runs.run_spec import RunSpec

NO_MORE = ""
"""Sent instead of a key: there is no further run to train."""

_training: list[str] = []
"""Key of the run that all processes train now; after an error the processes cannot work together
again."""


@contextmanager
def training_together(spec: RunSpec) -> Iterator[Callable[[], None]]:
    """Within it, the other processes train `spec` too, once the yielded function is called.

    Until then they set up the training. Without the call they discard it.

    Raises:
        InputError: the set-up of another process failed; raised by the yielded function.
    """
    if num_processes() == 1:
        yield lambda: None
        return

    def start() -> None:
        _training.append(spec.key)
        agreed(True)
        for number, reason in enumerate(collected("")):
            if reason:
                raise InputError(f"process {number} of {num_processes()}: {reason}")

    agreed(spec.key)
    try:
        yield start
    except Exception:
        if not _training:
            agreed(False)
        raise
    _training.clear()


def is_training_together() -> bool:
    """Whether the other processes train a run now, so that an error ends the command."""
    return bool(_training)


def dismiss() -> None:
    """End the other processes, which wait for a run to train."""
    if not _training:
        agreed(NO_MORE)
