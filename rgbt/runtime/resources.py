"""Report a full disk or exhausted memory in one message with advice.

Libraries report both in many ways: PyTorch hides a full disk behind a RuntimeError of its file
writer, OpenCV has an error of its own for missing memory.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator
from contextlib import contextmanager

from rgbt.checks import InputError, RunError, one_line

DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
MEMORY = re.compile(
    r"out of memory|can't allocate memory|not enough memory|Insufficient memory|alloc_cpu\.cpp"
    r"|Cannot allocate memory|bad_alloc|CUDNN_STATUS_ALLOC_FAILED",
    re.IGNORECASE,
)
"""In messages of PyTorch (CPU and CUDA), OpenCV, the C++ library and the system."""

RESUME = "rerun the command to resume from the last checkpoint."


@contextmanager
def reporting_exhaustion() -> Iterator[None]:
    """Turn what is raised on a full disk or exhausted memory into a RunError with advice."""
    try:
        yield
    except Exception as error:  # All other exceptions are raised again.
        cause: BaseException | None = error
        while cause is not None:
            reason = one_line(str(cause).partition("\n")[0]) or type(cause).__name__
            if isinstance(cause, OSError) and cause.errno in DISK:
                named = f"{error} " if isinstance(error, InputError) else ""
                raise RunError(f"{named}{reason}; free some space, then {RESUME}") from error
            if is_out_of_memory(cause):
                raise RunError(
                    f"out of memory ({reason}); lower scale.batch_size, scale.eval_batch_size, "
                    f"scale.crop_hw or data.num_workers, then {RESUME}"
                ) from error
            hidden = cause.__suppress_context__  # raised "from None": its message says it all
            cause = cause.__cause__ or (None if hidden else cause.__context__)
        raise


def is_out_of_memory(error: BaseException) -> bool:
    """Whether a library reports by this error that memory is exhausted."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    is_of_library = isinstance(error, RuntimeError) or type(error).__module__.startswith("cv2")
    return is_of_library and MEMORY.search(str(error)) is not None
