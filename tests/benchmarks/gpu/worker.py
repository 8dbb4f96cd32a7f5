"""The process of one step: ``python -m tests.benchmarks.gpu.worker REQUEST.json``.

What it measures goes line by line to the file that the request names; what libraries print goes to
the log. The exit code is 0 unless the step failed.
"""

from __future__ import annotations

import faulthandler
import importlib
import json
import sys
import traceback
from pathlib import Path
from typing import Any

from tests.benchmarks.gpu.task import SkippedError, Task, sentence_of

BEFORE_END = 3.0
"""Seconds before the limit at which the stacks of all threads are written to the log."""


def main(path: Path) -> int:
    """Run the step of a request; 0 where it was measured or skipped."""
    request: dict[str, Any] = json.loads(path.read_text())
    faulthandler.enable()
    faulthandler.dump_traceback_later(max(1.0, request["seconds"] - BEFORE_END))
    with Path(request["report"]).open("a") as report:
        task = Task(
            device=request["device"],
            size=request["size"],
            data=None if request["data"] is None else Path(request["data"]),
            folder=Path(request["folder"]),
            seconds=request["seconds"],
            report=report,
        )
        try:
            importlib.import_module(request["module"]).measure(task)
            faulthandler.cancel_dump_traceback_later()
        except SkippedError as reason:
            task.write("skipped", str(reason))
        except Exception as error:
            traceback.print_exc()
            missing = missing_package(error)
            if missing:
                task.write("skipped", f"it needs the package {missing}, which is not installed.")
                return 0
            task.write("failed", sentence_of(error))
            return 1
    return 0


def missing_package(error: Exception) -> str | None:
    """The package of others whose import failed, if that is the error."""
    if not isinstance(error, ModuleNotFoundError) or error.name is None:
        return None
    package = error.name.partition(".")[0]
    return None if package in ("rgbt", "sweeps", "tests") else package


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
