"""A command that ends itself between two writes: ``python -m tests.dying "after last.pt 2" ...``.

Names are those of files as they get their final one, by rename; "before" is the moment
with the temporary file written and flushed. "-" ends nothing. Pictures are left out.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from tests.commands import without_pictures


def die_at(instant: str) -> None:
    """Kill this process before or after the n-th time that a file gets its name."""
    seen: Counter[str] = Counter()

    def reached(now: str, target: Any) -> None:
        event = f"{now} {Path(target).name}"
        seen[event] += 1
        if f"{event} {seen[event]}" == instant:
            os.kill(os.getpid(), signal.SIGKILL)

    def named(make: Any) -> Any:
        def do(source: Any, target: Any, **more: Any) -> None:
            reached("before", target)
            make(source, target, **more)
            reached("after", target)

        return do

    os.replace = named(os.replace)


if __name__ == "__main__":
    _, instant, module, *words = sys.argv
    if instant != "-":
        die_at(instant)
    sys.argv = [module, *words]
    with without_pictures():
        runpy.run_module(module, run_name="__main__", alter_sys=True)
