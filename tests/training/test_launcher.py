"""The supervisor of several processes, with small scripts in place of trainings."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rgbt.training import launcher

RANK = "import os, sys, time, signal; rank = int(os.environ['RANK']); size = os.environ; "
WAIT = "time.sleep(60)"


@pytest.fixture(autouse=True)
def short_grace(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launcher, "GRACE_S", 0.5)


def launch(monkeypatch: pytest.MonkeyPatch, script: str, processes: int = 2) -> int:
    monkeypatch.setattr(launcher, "COMMAND", ("-c", RANK + script))
    return launcher.launch(processes, ["word"])


def test_launch_describes_the_processes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    names = "RANK LOCAL_RANK WORLD_SIZE LOCAL_WORLD_SIZE MASTER_ADDR RGBT_SUPERVISOR"
    script = (
        f"shown = [os.environ[name] for name in '{names}'.split()] + sys.argv[1:]; "
        f"open(r'{tmp_path}/' + str(rank), 'w').write(' '.join(shown))"
    )
    assert launch(monkeypatch, script, 3) == 0
    shown = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert shown == {str(r): f"{r} {r} 3 3 127.0.0.1 {os.getpid()} word" for r in range(3)}


def test_launch_shows_process_0_alone(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    assert launch(monkeypatch, "print('out', rank); print('err', rank, file=sys.stderr)") == 0
    assert capfd.readouterr() == ("out 0\n", "err 0\n")


@pytest.mark.parametrize(
    ("script", "code", "err"),
    [
        # Both fail alike: the message of process 0.
        ("sys.stderr.write(f'rgbt: wrong {rank}\\n'); sys.exit(2)", 2, "rgbt: wrong 0\n"),
        # Process 1 fails, and process 0 loses it: the message of process 1.
        (
            "rank and sys.stderr.write('rgbt: wrong 1\\n'); sys.exit(3 if rank else 75)",
            *(3, "rgbt: wrong 1\n"),
        ),
        # Process 1 fails, and process 0 waits for it for ever, as on GPUs.
        (
            f"rank and sys.stderr.write('rgbt: wrong 1\\n'); sys.exit(3) if rank else {WAIT}",
            *(3, "rgbt: wrong 1\n"),
        ),
        # Process 0 fails; what the others report then is a consequence.
        (
            f"rank and sys.stderr.write('lost\\n'); {WAIT} if rank else sys.exit(1)",
            *(1, ""),
        ),
    ],
)
def test_launch_reports_the_first_failure(
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    script: str,
    code: int,
    err: str,
) -> None:
    began = time.monotonic()
    assert launch(monkeypatch, script) == code
    assert capfd.readouterr().err == err
    assert time.monotonic() - began < 30, "waited for a process that waits for ever"


@pytest.mark.parametrize("killed", [0, 1])
def test_launch_names_a_killed_process(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], killed: int
) -> None:
    script = f"os.kill(os.getpid(), 9) if rank == {killed} else sys.exit(75)"
    assert launch(monkeypatch, script) == 137
    message = capfd.readouterr().err
    assert message.startswith(f"rgbt: process {killed} of 2 was stopped by SIGKILL (the system")
    assert message.count("\n") == 1


SUPERVISOR = """
import sys
from rgbt.training import launcher
launcher.GRACE_S = 0.5
launcher.COMMAND = ("-c", sys.argv[1])
sys.exit(launcher.launch(2, []))
"""


def supervise(script: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", SUPERVISOR, RANK + script])


def wait_for(path: Path) -> int:
    """The number that a process writes into a file."""
    deadline = time.monotonic() + 60
    while not path.exists() or not path.read_text():
        assert time.monotonic() < deadline, f"no {path.name}"
        time.sleep(0.01)
    return int(path.read_text())


def is_running(number: int) -> bool:
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    return "\nState:\tZ" not in Path(f"/proc/{number}/status").read_text()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_launch_passes_signals_to_process_0(tmp_path: Path, number: int) -> None:
    script = (
        f"signal.signal({int(number)}, lambda *_: sys.exit(42)); "
        f"open(r'{tmp_path}/' + str(rank), 'w').write(str(os.getpid())); {WAIT}"
    )
    supervisor = supervise(script)
    processes = [wait_for(tmp_path / name) for name in "01"]
    supervisor.send_signal(number)
    assert supervisor.wait(30) == 42
    assert not any(map(is_running, processes))


def test_processes_end_with_their_supervisor(tmp_path: Path) -> None:
    script = (
        "from rgbt.runtime.member import end_with_supervisor; end_with_supervisor(); "
        f"open(r'{tmp_path}/' + str(rank), 'w').write(str(os.getpid())); {WAIT}"
    )
    supervisor = supervise(script)
    processes = [wait_for(tmp_path / name) for name in "01"]
    supervisor.kill()
    supervisor.wait()
    deadline = time.monotonic() + 30
    while any(map(is_running, processes)):
        assert time.monotonic() < deadline, "a process outlives its supervisor"
        time.sleep(0.01)
