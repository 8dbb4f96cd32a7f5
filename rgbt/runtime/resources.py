"""Report a full disk or exhausted memory in one message with advice."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager

from rgbt.checks import InputError, RunError, one_line

DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
RESUME = "rerun the command to resume from the last checkpoint."
SMALLER = "lower scale.batch_size, scale.eval_batch_size, scale.crop_hw or data.num_workers"


@contextmanager
def reporting_exhaustion() -> Iterator[None]:
    """Turn what is raised on a full disk or exhausted memory into a RunError with advice."""
    try:
        yield
    except Exception as error:  # All other exceptions are raised again.
        cause: BaseException | None = error
        while cause is not None:  # PyTorch hides a full disk behind an error of its file writer
            reason = one_line(str(cause).partition("\n")[0]) or type(cause).__name__
            if isinstance(cause, OSError) and cause.errno in DISK:
                named = f"{error} " if isinstance(error, InputError) else ""
                raise RunError(f"{named}{reason}; free some space, then {RESUME}") from error
            if is_out_of_memory(cause):
                raise RunError(f"out of memory ({reason}); {SMALLER}, then {RESUME}") from error
            hidden = cause.__suppress_context__  # raised "from None": its message says it all
            cause = cause.__cause__ or (None if hidden else cause.__context__)
        raise


def is_out_of_memory(error: BaseException) -> bool:
    """Whether memory is exhausted, of the machine or of a GPU."""
    allocator = isinstance(error, RuntimeError) and "can't allocate memory" in str(error)
    is_torch = type(error).__name__ == "OutOfMemoryError" or allocator
    return is_torch or isinstance(error, MemoryError)
