"""A step whose process ends by itself after one row."""

import os
import signal
from typing import Any


def measure(task: Any) -> None:
    task.row(measured=1)
    os.kill(os.getpid(), signal.SIGSEGV)
