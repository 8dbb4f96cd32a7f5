"""A step that runs out of memory."""

from typing import Any


def measure(task: Any) -> None:
    raise MemoryError("CUDA out of memory. Tried to allocate 20.00 GiB\nmore lines")
