"""A step that never ends, with a process of its own that ignores SIGTERM."""

import subprocess
import sys
import time
from typing import Any

CHILD = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(600)"


def measure(task: Any) -> None:
    child = subprocess.Popen([sys.executable, "-c", CHILD], start_new_session=True)
    task.row(child=child.pid)
    task.headline("one child")
    time.sleep(600)
