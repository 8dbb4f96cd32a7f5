"""A full disk and exhausted memory: one sentence, exit code 1, nothing that was saved is lost."""

from __future__ import annotations

import errno
from collections.abc import Callable

import pytest
import torch

from rgbt.checks import InputError
from rgbt.config.plain_command import PlainCommand
from tests.commands import Call, NoOptions, assert_one_sentence

SMALL_MB = 2


def raising(error: Callable[[], BaseException]) -> Callable[[], None]:
    def main(options: NoOptions, overrides: list[str]) -> None:
        raise error()

    return PlainCommand(NoOptions, main)


def full() -> OSError:
    return OSError(errno.ENOSPC, "No space left on device")


def hidden() -> BaseException:
    """As PyTorch's writer has it: an error of its own, raised while the disk's was handled."""
    error = RuntimeError("unexpected pos 2680384 vs 2680304")
    error.__context__ = full()
    return error


def silenced() -> BaseException:
    """An error whose message says it all (``from None``)."""
    error = InputError("no shared memory in /dev/shm.")
    error.__context__, error.__suppress_context__ = full(), True
    return error


def of_torch() -> BaseException:
    with pytest.raises(RuntimeError) as told:
        torch.empty(2**52, dtype=torch.uint8)
    return told.value


DISK, MEMORY = (
    "; free some space, then rerun the command",
    "data.num_workers, then rerun the command",
)


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (full, 1, DISK),
        (hidden, 1, DISK),
        (silenced, 2, "no shared memory in /dev/shm."),
        (MemoryError, 1, MEMORY),
        (of_torch, 1, MEMORY),
        (lambda: torch.OutOfMemoryError("CUDA out of memory. Tried 2 GiB.\nSee"), 1, MEMORY),
        (lambda: InputError("\x1b[31mfolder\x07/a: is missing."), 2, "?[31mfolder?/a: is missing."),
    ],
)
def test_what_is_exhausted_is_one_message(call: Call, error, code: int, said: str) -> None:
    found, _, err = call(raising(error))
    assert found == code
    assert_one_sentence(err, said)


def test_other_errors_stay_errors(call: Call) -> None:
    with pytest.raises(RuntimeError, match="mat1 and mat2"):
        call(raising(lambda: RuntimeError("mat1 and mat2 shapes cannot be multiplied")))
