"""Reading a run while it trains, and the reason why a process ended."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rgbt.runs.folder import RunFolder
from sweeps.worker.run_monitor import (
    MetricsReader,
    failure_reason,
    signal_lock_holder,
)
from tests.sweeps.fakes import held_by_another

TRACEBACK = """\
Traceback (most recent call last):
  File "run.py", line 1, in <module>
    train()
torch.cuda.OutOfMemoryError: CUDA out of memory. Tried to allocate 2 GiB
See the documentation.
"""


def test_lines_come_once_and_whole(tmp_path: Path) -> None:
    follower = MetricsReader(tmp_path / "run")
    assert follower.new_lines() == []
    run = RunFolder(tmp_path / "run")
    run.append(1, "train", {"loss": 2.0})
    run.append(2, "val", {"mIoU": 0.5, "class/car": math.nan})
    seen = follower.new_lines()
    assert [(line.step, line.kind) for line in seen] == [(1, "train"), (2, "val")]
    assert seen[1].values["mIoU"] == 0.5
    assert math.isnan(seen[1].values["class/car"])
    assert follower.step == 2
    assert follower.new_lines() == []

    text = json.dumps({"step": 3, "kind": "val", "time": 0.0, "values": {"mIoU": 0.6}})
    with (run.path / "metrics.jsonl").open("a") as file:
        file.write(text[:20])
        file.flush()
        assert follower.new_lines() == [], "half a line"
        file.write(text[20:] + "\n")
    assert [line.step for line in follower.new_lines()] == [3]
    assert follower.step == 3


def test_a_run_that_resumes_is_read_from_its_begin(tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    follower = MetricsReader(tmp_path)
    for step in (2, 4, 6):
        run.append(step, "val", {"mIoU": 0.1})
    assert len(follower.new_lines()) == 3
    run.truncate_after(2)
    run.append(4, "val", {"mIoU": 0.2})
    assert [line.step for line in follower.new_lines()] == [2, 4]
    assert follower.step == 4


@pytest.mark.parametrize(
    ("code", "text", "said"),
    [
        (1, "warning\nrgbt: masker.sigma_div must be positive.\n", "masker.sigma_div must be"),
        (1, TRACEBACK, "torch.cuda.OutOfMemoryError: CUDA out of memory. Tried to allocate 2 GiB"),
        (1, f"KeyboardInterrupt\n{TRACEBACK}".replace("Memory", "Time"), "torch.cuda.OutOfTimeErr"),
        (1, f"{TRACEBACK}rgbt: the loss is not finite.\n", "the loss is not finite."),
        (1, "step 1\rstep 2\rfull disk\n", "full disk"),
        (1, "rgbt: first\nrgbt: second\n", "second"),
        (1, "\udcff\udcfe broken\n", "\ufffd\ufffd broken"),
        (1, "ValueError: " + "x" * 5000, "ValueError: " + "x" * 288),
        (3, "", "it ended with exit code 3 and no output; see"),
        (-9, "rgbt: x", "stopped by SIGKILL (the system kills processes that use too much memory)"),
        (-11, "rgbt: x", "stopped by SIGSEGV"),
        (-99, "rgbt: x", "stopped by signal 99"),
    ],
)
def test_failure_reason_is_last_message_or_signal(
    tmp_path: Path, code: int, text: str, said: str
) -> None:
    before = "rgbt: an old mistake é\n".encode()
    log = tmp_path / "run.log"
    log.write_bytes(before + text.encode(errors="surrogateescape"))
    reason = failure_reason(code, log, len(before))
    assert reason.startswith(said)
    assert len(reason) <= max(300, len(f"{said} {log}"))
    assert "exit code 3" in failure_reason(3, tmp_path / "no.log", 0)


def test_signal_lock_holder_stops_process(tmp_path: Path) -> None:
    with held_by_another(tmp_path) as process:
        signal_lock_holder(tmp_path, signal.SIGTERM)
        assert process.wait() == -signal.SIGTERM


def test_lock_holder_on_another_machine_is_not_signalled(tmp_path: Path) -> None:
    signal_lock_holder(tmp_path, signal.SIGTERM)  # nothing there
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        (tmp_path / "lock").write_text(f"process {process.pid} on not-{os.uname().nodename}")
        signal_lock_holder(tmp_path, signal.SIGTERM)
        (tmp_path / "lock").write_text("another process")
        signal_lock_holder(tmp_path, signal.SIGTERM)
        assert process.poll() is None
        process.communicate(b"\n")
        assert process.returncode == 0
    finally:
        process.kill()
