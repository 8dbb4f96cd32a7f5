"""Reading a run as it grows, and saying why a process ended."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rgbt.tracking.run_folder import RunFolder
from sweeps.worker.run_monitor import (
    MetricsReader,
    failure_reason,
    signal_lock_holder,
    training_seconds,
)
from tests.sweeps.fakes import finish, held_by_another

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


def log_of(tmp_path: Path, text: str, before: str = "") -> tuple[Path, int]:
    path = tmp_path / "run.log"
    path.write_text(before + text)
    return path, len(before.encode())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("warning\nrgbt: masker.sigma_div must be positive, got -1.\n", "masker.sigma_div must be"),
        (TRACEBACK, "torch.cuda.OutOfMemoryError: CUDA out of memory. Tried to allocate 2 GiB"),
        ("KeyboardInterrupt\n" + TRACEBACK.replace("Memory", "Time"), "torch.cuda.OutOfTimeError"),
        ("step 1\rstep 2\rfull disk\n", "full disk"),
        ("rgbt: first\nrgbt: second\n", "second"),
    ],
)
def test_the_reason_is_taken_from_what_the_process_said(
    tmp_path: Path, text: str, said: str
) -> None:
    assert failure_reason(1, *log_of(tmp_path, text)).startswith(said)


def test_a_long_message_is_cut(tmp_path: Path) -> None:
    assert len(failure_reason(1, *log_of(tmp_path, "ValueError: " + "x" * 5000))) == 300


def test_what_an_earlier_process_said_is_no_reason(tmp_path: Path) -> None:
    log, start = log_of(tmp_path, "", before="rgbt: an old mistake é\n")
    said = failure_reason(3, log, start)
    assert said.startswith("it ended with exit code 3 and no output")
    assert str(log) in said
    assert "exit code 3" in failure_reason(3, tmp_path / "no.log", 0)


def test_bytes_that_are_no_text_do_no_harm(tmp_path: Path) -> None:
    (tmp_path / "log").write_bytes(b"\xff\xfe broken\n")
    assert "broken" in failure_reason(1, tmp_path / "log", 0)


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (-9, "stopped by SIGKILL (the system kills what takes too much memory)"),
        (-11, "stopped by SIGSEGV"),
        (-15, "stopped by SIGTERM"),
        (-64, "stopped by SIGRTMAX"),
        (-99, "stopped by signal 99"),
    ],
)
def test_a_signal_is_named(tmp_path: Path, code: int, said: str) -> None:
    assert failure_reason(code, *log_of(tmp_path, "rgbt: a remark\n")) == said


def test_failure_reason_prefers_last_rgbt_message(
    tmp_path: Path,
) -> None:
    text = TRACEBACK.replace("torch.cuda.OutOfMemoryError", "ConnectionError")
    log = log_of(tmp_path, text + "rgbt: the loss at step 7 is not finite; lower optimizer.lr.\n")
    assert failure_reason(1, *log) == "the loss at step 7 is not finite; lower optimizer.lr."


def test_signal_lock_holder_stops_process(tmp_path: Path) -> None:
    with held_by_another(tmp_path) as process:
        signal_lock_holder(tmp_path, signal.SIGTERM)
        assert process.wait() == -signal.SIGTERM


def test_a_holder_on_another_machine_is_left_alone(tmp_path: Path) -> None:
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


def test_a_holder_that_is_gone_already_needs_no_stop(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", "pass"])
    process.wait()
    (tmp_path / "lock").write_text(f"process {process.pid} on {os.uname().nodename}")
    signal_lock_holder(tmp_path, signal.SIGTERM)


def test_seconds_are_known_of_finished_runs_alone(tmp_path: Path) -> None:
    assert training_seconds(tmp_path) is None
    finish(tmp_path)
    assert training_seconds(tmp_path) == 2.5
    (tmp_path / "result.json").write_text("{}")
    assert training_seconds(tmp_path) is None
