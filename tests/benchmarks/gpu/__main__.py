"""Measure everything that needs a GPU: ``python -m tests.benchmarks.gpu out=FOLDER minutes=8``.

Options: data=FOLDER (MFNet; else synthetic images), device=cuda|cpu, size=full|smoke,
steps=machine,tests,... The exit code is 0 if no step failed or was stopped, 1 if one was, and 2 for
wrong options.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence

from tests.benchmarks.gpu.request import UsageError, request_of
from tests.benchmarks.gpu.results import FAILED, STOPPED
from tests.benchmarks.gpu.runner import run_steps


def main(words: Sequence[str]) -> int:
    """Exit code of the command."""
    if {"--help", "-h"} & set(words):
        print(__doc__)
        return 0
    try:
        request = request_of(words)
    except UsageError as error:
        print(f"gpu: {error}", file=sys.stderr)
        return 2
    # Else the process of a step would live longer than this one.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        found = run_steps(request)
    except KeyboardInterrupt:
        print(f"gpu: interrupted; {request.out / 'results.md'} has the steps before.")
        return 130
    return int(any(each.status in (FAILED, STOPPED) for each in found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
