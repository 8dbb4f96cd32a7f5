"""Timing of the benchmarks: calls alternate, so that other load on the machine affects all of them.

Import it before torch: threads that wait must not count as work.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
from numpy.typing import NDArray

Call = Callable[[], object]


def seconds(call: Call) -> tuple[float, float]:
    """CPU seconds of all threads, and wall seconds."""
    cpu, wall = time.process_time(), time.perf_counter()
    call()
    return time.process_time() - cpu, time.perf_counter() - wall


def in_turns(
    calls: Mapping[str, Call],
    rounds: int,
    *,
    warm: bool = True,
    timer: Callable[[Call], tuple[float, float]] = seconds,
) -> dict[str, NDArray[np.float64]]:
    """(rounds, 2) CPU and wall seconds of every call, after one that does not count."""
    if warm:
        for call in calls.values():
            call()
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            found[name].append(timer(call))
    return {name: np.array(pairs) for name, pairs in found.items()}


def medians(calls: Mapping[str, Call], rounds: int) -> dict[str, tuple[float, float]]:
    """Medians over rounds: CPU seconds, wall seconds."""
    timed = in_turns(calls, rounds)
    return {name: tuple(np.median(pairs, axis=0).tolist()) for name, pairs in timed.items()}


def in_process(module: str, *words: str) -> dict[str, Any]:
    """What `python -m module words` prints as JSON in its last line; {"failed": why} if it fails.

    A process of its own has a peak memory of its own.
    """
    call = [sys.executable, "-m", module, *words]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    if done.returncode:
        return {"failed": done.stderr.strip().splitlines()[-1]}
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found
