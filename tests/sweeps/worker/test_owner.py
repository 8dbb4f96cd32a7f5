"""Who works on a trial: what a driver says of itself, and when it counts as gone."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from sweeps.worker.owner import STALE_S, Owner

HOST = os.uname().nodename


@pytest.fixture
def child() -> Iterator[subprocess.Popen[str]]:
    """Another process on this machine that says who it is, and waits."""
    code = "from sweeps.worker.owner import Owner; print(Owner.this_process(), flush=True); input()"
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    yield process
    process.kill()
    process.communicate()


def test_this_process_is_alive_however_long_it_was_silent() -> None:
    me = Owner.this_process()
    assert (me.host, me.pid) == (HOST, os.getpid())
    assert me.is_alive(heartbeat=0.0)


def test_an_owner_is_read_back_from_its_text() -> None:
    assert Owner.parse(str(Owner.this_process())) == Owner.this_process()
    assert Owner.parse("node:7:12:345") == Owner("node:7", 12, "345")


def test_owner_local_process_alive_until_exit(
    child: subprocess.Popen[str],
) -> None:
    assert child.stdout is not None
    owner = Owner.parse(child.stdout.readline().strip())
    assert owner.pid == child.pid
    assert owner.is_alive(heartbeat=0.0)
    child.kill()
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    assert Path(f"/proc/{child.pid}").exists(), "still a zombie, its parent has not asked for it"
    assert not owner.is_alive(heartbeat=time.time())
    child.wait()
    assert not owner.is_alive(heartbeat=time.time())


def test_owner_reused_pid_is_not_alive() -> None:
    assert not Owner(HOST, os.getpid(), "12").is_alive(heartbeat=time.time())


def test_on_another_machine_only_the_last_sign_counts() -> None:
    other = Owner(f"not-{HOST}", os.getpid(), Owner.this_process().started)
    assert other.is_alive(time.time() - STALE_S / 2)
    assert not other.is_alive(time.time() - 2 * STALE_S)


def test_owner_unknown_depends_on_heartbeat() -> None:
    assert Owner.unknown().is_alive(time.time())
    assert not Owner.unknown().is_alive(time.time() - 2 * STALE_S)
