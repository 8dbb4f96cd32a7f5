"""Run the steps one after the other within the limit of the whole command."""

from __future__ import annotations

import json
import os
import shlex
import signal
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path

from tests.benchmarks.gpu import results
from tests.benchmarks.gpu.processes import GRACE, run
from tests.benchmarks.gpu.request import Request
from tests.benchmarks.gpu.results import FAILED, SKIPPED, STOPPED, StepResult
from tests.benchmarks.gpu.steps import NOMINAL, STEPS, Step

ROOT = Path(__file__).resolve().parents[3]

RESERVE = 2.0 + GRACE
"""Seconds kept for ending the last step and for writing the results."""

CPU_LEAST = 60.0
"""Smallest limit of a step on a CPU, whose cores may be shared: imports alone may take 20 s."""


def run_steps(request: Request, steps: Sequence[Step] = STEPS) -> list[StepResult]:
    """Run the requested steps; the results are written after each of them.

    Args:
        request: what to measure.
        steps: the table of steps.
    """
    deadline = time.monotonic() + 60 * request.minutes - RESERVE
    command = shlex.join(["python", "-m", "tests.benchmarks.gpu", *_words(request)])
    started = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    request.out.mkdir(parents=True, exist_ok=True)
    chosen = [step for step in steps if step.name in request.steps]
    found: list[StepResult] = []
    print(f"{len(chosen)} steps, at most {request.minutes:g} minutes, {request.out}", flush=True)
    for number, step in enumerate(chosen, 1):
        left = deadline - time.monotonic()
        result = StepResult(step.name, step.title, limit=round(limit_of(step, request, left), 1))
        heading = f"[{number}/{len(chosen)}] {step.name:9}"
        reason = _reason_to_skip(step, request, left)
        if reason:
            result.status, result.reason = SKIPPED, reason
        else:
            print(f"{heading} {step.title} (limit {result.limit:.0f} s)", flush=True)
            _run(step, request, result)
        found.append(result)
        print(f"{heading} {result.seconds:6.1f} s  {result.line()}", flush=True)
        results.write(request.out, command, started, found)
    print(f"results: {request.out / 'results.md'}", flush=True)
    return found


def limit_of(step: Step, request: Request, left: float) -> float:
    """Seconds that a step may take: its share of the whole, at most what is left."""
    if step.seconds is None:
        return left
    least = step.least if request.device == "cuda" else max(step.least, CPU_LEAST)
    return min(left, max(step.seconds * 60 * request.minutes / NOMINAL, least))


def _reason_to_skip(step: Step, request: Request, left: float) -> str:
    if step.needs_cuda and request.device != "cuda":
        return "it needs a GPU."
    if left < step.least:
        return f"it needs at least {step.least:.0f} s, but {max(left, 0.0):.0f} s are left."
    return ""


def _run(step: Step, request: Request, result: StepResult) -> None:
    """Run a step in a process of its own and read what it has reported."""
    out = request.out.resolve()
    log, report = out / f"{step.name}.log", out / f"{step.name}.jsonl"
    for path in (log, report):
        path.unlink(missing_ok=True)
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="rgbt_gpu_", ignore_cleanup_errors=True) as folder:
        description = Path(folder) / "request.json"
        scratch = Path(folder) / "work"
        scratch.mkdir()
        values = {
            **{"module": step.module, "device": request.device, "size": request.size},
            **{"data": None if request.data is None else str(request.data)},
            **{"folder": str(scratch), "report": str(report), "seconds": result.limit},
        }
        description.write_text(json.dumps(values))
        words = [sys.executable, "-m", "tests.benchmarks.gpu.worker", str(description)]
        code = run(words, result.limit, log, environment(os.environ), ROOT)
    result.seconds = round(time.monotonic() - began, 1)
    result.log = log.name
    result.read(report)
    if code is None:
        result.status = STOPPED
        result.reason = f"it was ended at its limit of {result.limit:.0f} s; see {log.name}."
    elif code and result.status != FAILED:
        result.status, result.reason = FAILED, f"{_ending(code)}; see {log.name}."


def environment(own: Mapping[str, str]) -> dict[str, str]:
    """Environment of a step: this repository first, and nothing that other libraries ask for."""
    paths = [str(ROOT), *([own["PYTHONPATH"]] if own.get("PYTHONPATH") else [])]
    return {
        **own,
        "PYTHONPATH": os.pathsep.join(paths),
        "PYTHONUNBUFFERED": "1",
        "OMP_WAIT_POLICY": own.get("OMP_WAIT_POLICY", "PASSIVE"),
    }


def _ending(code: int) -> str:
    """How a process ended that did not say it itself."""
    if code > 0:
        return f"its process ended with exit code {code}"
    name = signal.Signals(-code).name
    likely = " (probably the memory of the host was exhausted)" if name == "SIGKILL" else ""
    return f"its process was ended by {name}{likely}"


def _words(request: Request) -> list[str]:
    values = asdict(replace(request, steps=()))
    values["minutes"] = f"{request.minutes:g}"
    words = [f"{name}={value}" for name, value in values.items() if value not in (None, ())]
    if len(request.steps) < len(STEPS):
        words.append(f"steps={','.join(request.steps)}")
    return words
