"""The cores of this machine, and how threads of several processes share them.

A thread of OpenMP that has done its part of an operation waits for the others, first in a loop and
then asleep. The loop is faster while each thread has a core, and slower where another program uses
one: the loop then takes the core of the thread that it waits for. `rgbt.WAITING` lets threads loop
for a fraction of a millisecond, in place of several (GNU) or of 200 (Intel, LLVM): a run alone is
about as fast, and two to three times slower beside another program, in place of 25 times
(`tests.benchmarks.bench_beside_other_work`).
"""

from __future__ import annotations

import os

import rgbt


def usable_cores() -> int:
    """Count the cores that this process may use, >= 1; quotas of CPU time do not count."""
    if hasattr(os, "sched_getaffinity"):  # Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def sleep_while_waiting() -> None:
    """Let the threads of processes that start from now on sleep at once, unless the user decides.

    For several processes that compute at the same time: two runs on two cores took 34 s in place
    of 51. A run alone is faster with `rgbt.WAITING`.
    """
    if all(os.environ.get(name) == value for name, value in rgbt.WAITING.items()):
        os.environ.update(dict.fromkeys(rgbt.WAITING, "0"))
