"""Report a full disk or exhausted memory in one message with advice.

Libraries report both in many ways: PyTorch hides a full disk behind a RuntimeError of its file
writer, OpenCV has an error of its own for missing memory.
"""

from __future__ import annotations

import errno
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rgbt.checks import InputError, RunError, one_line

DISK = {
    errno.ENOSPC: "is full",
    errno.EDQUOT: "has no space left for this user (quota)",
    errno.EROFS: "is mounted read-only",
}

MEMORY = re.compile(
    r"out of memory|can't allocate memory|not enough memory|Insufficient memory|alloc_cpu\.cpp"
    r"|Cannot allocate memory|bad_alloc|CUDNN_STATUS_ALLOC_FAILED",
    re.IGNORECASE,
)
"""In messages of PyTorch (CPU and CUDA), OpenCV, the C++ library and the system."""

RESUME = "rerun the command to resume from the last checkpoint"


@contextmanager
def reporting_exhaustion() -> Iterator[None]:
    """Turn what is raised on a full disk or exhausted memory into a RunError.

    Raises:
        RunError: with path and free space, or with the settings that take less memory.
    """
    try:
        yield
    except Exception as error:  # All other exceptions are raised again.
        sentence = _sentence(error)
        if sentence is None:
            raise
        raise RunError(sentence) from error


def _sentence(error: BaseException) -> str | None:
    """The message about a full disk or exhausted memory, if `error` or its cause is one."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in DISK:
            return _disk_sentence(error, cause)
        if is_out_of_memory(cause):
            device = "the GPU" if "CUDA" in str(cause) else "this machine"
            reason = one_line(str(cause).partition("\n")[0]) or type(cause).__name__
            return (
                f"the memory of {device} is exhausted ({reason}); lower scale.batch_size, "
                f"scale.eval_batch_size, scale.crop_hw or data.num_workers; {RESUME}."
            )
        hidden = cause.__suppress_context__  # raised "from None": the sentence says it all
        cause = cause.__cause__ or (None if hidden else cause.__context__)
    return None


def _disk_sentence(error: BaseException, cause: OSError) -> str:
    file = cause.filename
    if isinstance(file, str):
        path = _existing(Path(file))
    else:  # of the folders that the command may write to, the one with least space left
        named = [word.partition("=")[2] for word in sys.argv[1:] if "=" in word]
        places = [Path(), Path(tempfile.gettempdir()), *(Path(each).expanduser() for each in named)]
        path = min(map(_existing, places), key=_free).resolve()
    free = f"{_free(path) / 1e6:.1f} MB free, after the unfinished file was removed"
    left = f"the disk of {path} {DISK[cause.errno or 0]} ({free})"
    if isinstance(error, InputError):  # its message names the file and the setting
        return f"{str(error).rstrip('.')}; {left}."
    return f"{left}; free some space, or name a folder on another disk; {RESUME}."


def _existing(path: Path) -> Path:
    """`path`, or the nearest folder above it that exists."""
    for each in (path, *path.parents):
        try:
            if each.exists():
                return each
        except OSError:  # no path at all: longer than a file's name may be
            continue
    return Path()


def _free(path: Path) -> int:
    return shutil.disk_usage(path).free


def is_out_of_memory(error: BaseException) -> bool:
    """Whether a library reports by this error that memory is exhausted."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    is_of_library = isinstance(error, RuntimeError) or type(error).__module__.startswith("cv2")
    return is_of_library and MEMORY.search(str(error)) is not None
