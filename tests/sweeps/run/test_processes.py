"""Real processes of a tiny module, started as runs are."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import pytest

from rgbt.checks import InputError
from sweeps.run import processes
from sweeps.run.processes import (
    LocalExecutor,
    LocalJob,
    check_gpus,
    failure_reason,
    run_command,
)
from tests.sweeps.fakes import DEADLINE_S, is_alive, until

MODULE = """
import json, os, signal, subprocess, sys, time
from pathlib import Path

assert __name__ == "__main__"
what, place = sys.argv[1], Path(sys.argv[2])
print("said", what, flush=True)
print("complained", file=sys.stderr, flush=True)

def note(text):
    place.with_suffix(".new").write_text(text)
    place.with_suffix(".new").rename(place)

if what == "tell":
    facts = {
        "argv": sys.argv[1:],
        "command": sys.orig_argv[1:],
        "given": os.environ.get("GIVEN"),
        "folder": os.getcwd(),
        "session": os.getsid(0) == os.getpid(),
        "interrupt": signal.getsignal(signal.SIGINT) is signal.default_int_handler,
    }
    place.write_text(json.dumps(facts))
if what == "leave":
    sys.exit(int(sys.argv[3]))
if what == "raise":
    raise ValueError("a bad day")
if what == "kill":
    os.kill(os.getpid(), int(sys.argv[3]))
if what in ("stay", "stubborn"):
    ignore = "signal.signal(signal.SIGTERM, signal.SIG_IGN);" if what == "stubborn" else ""
    exec(ignore)
    code = f"import signal, time; {ignore} time.sleep(600)"
    note(f"{os.getpid()} {subprocess.Popen([sys.executable, '-c', code]).pid}")
    time.sleep(600)
if what == "wait":
    note(str(os.getpid()))
    while not place.with_suffix(".go").exists():
        time.sleep(0.01)
    place.with_suffix(".done").touch()
"""


@pytest.fixture(scope="module")
def module(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with the module ``tiny_run``, which processes can import."""
    folder = tmp_path_factory.mktemp("modules")
    (folder / "tiny_run.py").write_text(MODULE)
    sys.path.insert(0, str(folder))
    yield folder
    sys.path.remove(str(folder))


@pytest.fixture(scope="module")
def executor(module: Path) -> Iterator[LocalExecutor]:
    # Nothing here needs torch. The server is one of the whole process: later tests start their own.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(processes, "PRELOADED", "json")
        yield LocalExecutor()
    forkserver._forkserver._stop()


Start = Callable[..., LocalJob]


@pytest.fixture
def start(executor: LocalExecutor, tmp_path: Path) -> Iterator[Start]:
    """Start the module; what is left of its processes is ended after the test."""
    jobs: list[Any] = []

    def run(*words: str, environment: dict[str, str] | None = None) -> LocalJob:
        job = executor.start(("tiny_run", *words), environment or {}, tmp_path / "logs" / "log")
        jobs.append(job)
        return job

    yield run
    for job in jobs:
        if job.poll() is None:
            job._signal(signal.SIGKILL)
            code(job)


def code(job: LocalJob) -> int | None:
    until(lambda: job.poll() is not None, "the end of a process")
    return job.poll()


def pids(place: Path) -> tuple[int, ...]:
    until(place.exists, "the process to say who it is")
    return tuple(map(int, place.read_text().split()))


def test_local_executor_passes_arguments_and_environment(start: Start, tmp_path: Path) -> None:
    place = tmp_path / "facts"
    assert code(start("tell", str(place), "a b=[1,2]", environment={"GIVEN": "it"})) == 0
    assert json.loads(place.read_text()) == {
        "argv": ["tell", str(place), "a b=[1,2]"],
        "command": ["-m", "tiny_run", "tell", str(place), "a b=[1,2]"],
        "given": "it",
        "folder": str(Path.cwd()),
        "session": True,
        "interrupt": True,
    }
    assert "GIVEN" not in os.environ
    assert code(start("tell", str(place))) == 0
    assert json.loads(place.read_text())["given"] is None, "nothing stays from run to run"
    assert (tmp_path / "logs" / "log").read_text().count("said tell") == 2, "the log is appended to"


@pytest.mark.parametrize(
    ("words", "expected"),
    [("leave x 0", 0), ("leave x 3", 3), ("raise x", 1), ("kill x 9", -9), ("kill x 11", -11)],
)
def test_local_job_returns_exit_code_and_logs(
    start: Start, tmp_path: Path, words: str, expected: int
) -> None:
    job = start(*words.split())
    assert code(job) == expected
    job.stop()  # too late, and no harm
    assert job.poll() == expected
    said = (tmp_path / "logs" / "log").read_text()
    assert said.startswith(f"said {words.split()[0]}\n")
    assert "complained\n" in said
    assert ("ValueError: a bad day" in said) == (words == "raise x")


def test_stop_ends_process_with_its_children(start: Start, tmp_path: Path) -> None:
    job = start("stay", str(tmp_path / "pids"))
    mine, child = pids(tmp_path / "pids")
    assert job.poll() is None
    job.stop()
    assert code(job) == -signal.SIGTERM
    until(lambda: not is_alive(mine) and not is_alive(child), "the end of both")


def test_stop_kills_after_grace_with_children(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = start("stubborn", str(tmp_path / "pids"))
    _, child = pids(tmp_path / "pids")
    job.stop()
    assert job.poll() is None, "it has its time of grace"
    monkeypatch.setattr(processes, "GRACE_S", 0.0)
    job.stop()
    assert code(job) == -signal.SIGKILL
    until(lambda: not is_alive(child), "the end of the child")


DRIVER = """
import sys, time
from pathlib import Path
from sweeps.run import processes

if __name__ == "__main__":
    sys.path.insert(0, sys.argv[1])
    processes.PRELOADED = "json"
    folder = Path(sys.argv[2])
    command = ("tiny_run", "wait", str(folder / "pid"))
    job = processes.LocalExecutor().start(command, {}, folder / "log")
    try:
        while True:
            job.poll()
            time.sleep(0.01)
    except KeyboardInterrupt:
        print("interrupted", job.poll(), flush=True)
        job.stop()
        while job.poll() is None:
            time.sleep(0.01)
        print("stopped", job.poll(), flush=True)
"""


@pytest.fixture
def driver(module: Path, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A driver in a process group of its own, as a shell starts it."""
    (tmp_path / "a_driver.py").write_text(DRIVER)
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "a_driver.py"), str(module), str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(Path(processes.__file__).parents[2])},
        # Where the suite itself runs in the background of a shell, Ctrl-C is ignored and inherited.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    yield process
    process.kill()
    (tmp_path / "pid.go").touch()  # its orphan holds the pipe that is read here
    process.communicate()


def test_ctrl_c_reaches_only_the_driver(driver: subprocess.Popen[str], tmp_path: Path) -> None:
    (pid,) = pids(tmp_path / "pid")
    os.killpg(driver.pid, signal.SIGINT)  # what a terminal does
    told, _ = driver.communicate(timeout=DEADLINE_S)
    assert told.splitlines() == ["interrupted None", "stopped -15"]
    assert not is_alive(pid)


def test_run_continues_when_driver_is_killed(driver: subprocess.Popen[str], tmp_path: Path) -> None:
    (pid,) = pids(tmp_path / "pid")
    os.killpg(driver.pid, signal.SIGKILL)  # the fork server goes with it
    driver.wait()
    time.sleep(0.2)
    assert is_alive(pid)
    (tmp_path / "pid.go").touch()
    until((tmp_path / "pid.done").exists, "the orphan to finish its work")
    until(lambda: not is_alive(pid), "its end")


def test_run_command_has_reason_of_failure(executor: LocalExecutor, tmp_path: Path) -> None:
    assert run_command(("tiny_run", "leave", "x", "0"), tmp_path / "log") == ""
    assert run_command(("tiny_run", "raise", "x"), tmp_path / "log") == "ValueError: a bad day"


SERVER = """
import sys
from sweeps.run import preload
from rgbt.runs import provenance
before = provenance.code()["code"]
provenance.package_digest = lambda package: "edited since"
assert provenance.code()["code"] == before
from rgbt.runs import source_code
assert set(preload.PROGRAMS).isdisjoint(sys.modules), "executed by runs as programs"
assert "rgbt.training.train" in sys.modules
"""


@pytest.mark.slow
def test_fork_server_keeps_the_code_that_it_has_loaded() -> None:
    assert importlib.util.find_spec(processes.PRELOADED) is not None
    subprocess.run([sys.executable, "-c", SERVER], check=True)


TRACEBACK = """\
Traceback (most recent call last):
  File "run.py", line 1, in <module>
    train()
torch.cuda.OutOfMemoryError: CUDA out of memory. Tried to allocate 2 GiB
See the documentation.
"""


@pytest.mark.parametrize(
    ("code", "text", "said"),
    [
        (1, "warning\nrgbt: masker.sigma_div must be positive.\n", "masker.sigma_div must be"),
        (1, TRACEBACK, "torch.cuda.OutOfMemoryError: CUDA out of memory. Tried to allocate 2 GiB"),
        (1, f"{TRACEBACK}rgbt: the loss is not finite.\n", "the loss is not finite."),
        (1, "step 1\rfull \udcff disk\n", "full \ufffd disk"),
        (1, "ValueError: " + "x" * 5000, "ValueError: " + "x" * 288),
        (3, "", "it ended with exit code 3 and no output; see"),
        (-9, "rgbt: x", "stopped by SIGKILL"),
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


def test_check_gpus_refuses_hidden_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2, 3")
    for gpus in ((3, 2), ((3, 2),), None):
        check_gpus(gpus)
    for gpus, named in (((3, 5), 5), (((2, 3), (4,)), 4), ((0,), 0)):
        with pytest.raises(InputError, match=f"gpus: no GPU {named};"):
            check_gpus(gpus)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    with pytest.raises(InputError, match="gpus: no GPU "):
        check_gpus((0, 99))
