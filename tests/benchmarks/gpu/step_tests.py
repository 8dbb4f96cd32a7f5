"""The tests marked gpu, on the device."""

from __future__ import annotations

import importlib.util
import os
import re
import sys
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path

from tests.benchmarks.gpu.device import checked
from tests.benchmarks.gpu.processes import run
from tests.benchmarks.gpu.runner import ROOT
from tests.benchmarks.gpu.task import SkippedError, Task

MARK = re.compile(r"mark\.gpu\b|\bON_DEVICE\b|@on_device\b")
SMOKE = ("tests/on_device/test_draws.py",)
"""With size=smoke: all of them take as long as the other steps together."""


def measure(task: Task) -> None:
    """Run them, one row for each that failed or was skipped, and one row of sums."""
    if importlib.util.find_spec("pytest") is None:
        raise SkippedError("it needs the package pytest, which is not installed.")
    checked(task.device)
    # Collecting all tests of the repository would take longer than running these.
    files = SMOKE if task.smoke else files_with_mark()
    report, log = task.folder / "tests.xml", task.folder / "tests.log"
    words = [sys.executable, "-m", "pytest", "-m", "gpu", "-q", "--tb=short", "--no-header"]
    words += ["-p", "no:cacheprovider", f"--junitxml={report}", *files]
    environment = {**os.environ, "RGBT_TEST_DEVICE": task.device}
    code = run(words, task.left() - 4, log, environment, ROOT)
    print(log.read_text())
    if code is None:
        raise TimeoutError(f"the tests did not end; the last lines of {log.name} say which ran")
    counts = _report(task, report) if report.is_file() else Counter()
    task.headline(
        f"{counts['passed']} passed, {counts['failed']} failed, {counts['skipped']} skipped"
    )
    if code not in (0, 5) or counts["failed"] or not counts["passed"]:
        raise AssertionError(f"pytest ended with {code}; {counts['failed']} tests failed")


def files_with_mark() -> list[str]:
    """Files of tests in which one is marked gpu, relative to the repository."""
    return sorted(
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "tests").rglob("test_*.py")
        if MARK.search(path.read_text()) and "benchmarks" not in path.parts
    )


def _report(task: Task, report: Path) -> Counter[str]:
    """Write the rows of a JUnit file; how many tests passed, failed and were skipped."""
    counts: Counter[str] = Counter()
    for case in ET.parse(report).iter("testcase"):
        found = next((each for each in case if each.tag in ("failure", "error", "skipped")), None)
        result = "passed" if found is None else "skipped" if found.tag == "skipped" else "failed"
        counts[result] += 1
        if found is not None:
            name = f"{case.get('classname', '')}::{case.get('name', '')}"
            lines = (found.get("message") or "no message").splitlines()
            task.row(test=name, result=result, message=lines[0][:200])
    task.row(test="all", **{key: counts[key] for key in ("passed", "failed", "skipped")})
    return counts
