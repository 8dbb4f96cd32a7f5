"""Jobs of this machine: real processes of a tiny command."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import pytest

from rgbt.checks import InputError
from sweeps.run import local
from sweeps.run.job import LOST, Work, failure_reason
from sweeps.run.local import LocalExecutor, check_gpus, run_command
from tests.waiting import DEADLINE_S, is_alive, until

STEPS = "tests.sweeps.steps"
ROOT = Path(local.__file__).parents[2]


@pytest.fixture(scope="module", autouse=True)
def fork_server() -> Iterator[None]:
    # Nothing here needs torch. The server is one of the whole process: later tests start their own.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(local, "PRELOADED", "json")
        patch.setattr(local, "counted_modules", lambda: [])
        yield
    forkserver._forkserver._stop()


class Executor(LocalExecutor):
    """Starts points of one step; the names of jobs."""

    def start(self, folder: Path, words: str, name: str = "log", **environment: str) -> str:
        work = Work("key", {(STEPS, *words.split()): None}, environment, folder / name, folder)
        (job,) = self.submit([work])
        return job

    def end(self, job: str) -> None:
        until(lambda: self.state(job) == "ended", "the end of a job")


@pytest.fixture
def executor() -> Iterator[Executor]:
    made = Executor(2)
    yield made
    for job in made._processes:
        made._kill_at[job] = 0.0
        made.end(job)


def pids(place: Path) -> tuple[int, int]:
    """Of the command that waits, and of its child."""
    until(place.exists, "the process to say who it is")
    mine, child = map(int, place.read_text().splitlines()[1].split())
    return mine, child


def test_nothing_stays_from_job_to_job(executor: Executor, tmp_path: Path) -> None:
    place = tmp_path / "é"
    executor.end(executor.start(tmp_path, f"tell {place}", GIVEN="it"))
    told = json.loads(place.read_text())
    assert told["argv"] == ["tell", str(place)]
    assert told["command"] == ["-m", STEPS, "tell", str(place)]
    assert (told["given"], told["folder"], told["interrupt"]) == ("it", str(tmp_path), True)
    executor.end(executor.start(tmp_path, f"tell {place}"))
    assert json.loads(place.read_text())["given"] is None
    assert (tmp_path / "log").read_text().count("said tell\nrgbt job: done\n") == 2
    assert executor.state(next(iter(executor._processes))) == "ended"


def test_slots_see_their_gpus(executor: Executor, tmp_path: Path) -> None:
    executor._gpus = ((0, 1), 2)

    def gpus(name: str) -> str:
        place = tmp_path / name
        until(place.exists, "a command")
        found = json.loads(place.read_text().splitlines()[0])["gpus"]
        assert isinstance(found, str)
        return found

    jobs = {
        name: executor.start(tmp_path, f"wait {tmp_path / name}", f"log_{name}") for name in "ab"
    }
    assert [gpus(name) for name in "ab"] == ["0,1", "2"]
    (tmp_path / "b.go").touch()
    executor.end(jobs["b"])
    jobs["c"] = executor.start(tmp_path, f"wait {tmp_path / 'c'}")
    assert gpus("c") == "2", "those of the slot that is free"
    for name in "ac":
        (tmp_path / f"{name}.go").touch()
        executor.end(jobs[name])


@pytest.mark.parametrize("ignored", ["", f" {signal.SIGTERM:d}"])
def test_cancelled_job_ends_with_all_that_it_has_started(
    executor: Executor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ignored: str
) -> None:
    job = executor.start(tmp_path, f"wait {tmp_path / 'pids'}{ignored}")
    both = pids(tmp_path / "pids")
    executor.cancel(job)
    if ignored:
        assert executor.state(job) == "running", "it has its time of grace"
        executor._kill_at[job] = 0.0
    executor.end(job)
    executor.cancel(job)  # too late, and no harm
    until(lambda: not any(map(is_alive, both)), "the end of both")
    assert failure_reason(tmp_path / "log", 0) == (LOST if ignored else "stopped by SIGTERM")


def test_command_ends_with_a_job_that_is_killed(executor: Executor, tmp_path: Path) -> None:
    """By the system that lacks memory: nobody would know of a run that goes on."""
    job = executor.start(tmp_path, f"wait {tmp_path / 'pids'}")
    mine, child = pids(tmp_path / "pids")
    os.kill(int(job), signal.SIGKILL)
    executor.end(job)
    until(lambda: not is_alive(mine), "the end of the command")
    assert failure_reason(tmp_path / "log", 0) == LOST
    os.kill(child, signal.SIGKILL)


DRIVER = """
import sys, time
from pathlib import Path
from sweeps.run import local

if __name__ == "__main__":
    local.PRELOADED, folder = "json", Path(sys.argv[1])
    try:
        words = ("tests.sweeps.steps", "wait", str(folder / "pid"))
        print(local.run_command(words, folder / "log"))
    except KeyboardInterrupt:
        print("interrupted", flush=True)
"""


@pytest.fixture
def driver(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A driver in a process group of its own, as a shell starts it."""
    (tmp_path / "a_driver.py").write_text(DRIVER)
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "a_driver.py"), str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        # Where the suite itself runs in the background of a shell, Ctrl-C is ignored and inherited.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    yield process
    process.kill()
    (tmp_path / "pid.go").touch()  # its orphan holds the pipe that is read here
    process.communicate()


def test_ctrl_c_reaches_only_the_driver(driver: subprocess.Popen[str], tmp_path: Path) -> None:
    both = pids(tmp_path / "pid")
    os.killpg(driver.pid, signal.SIGINT)  # what a terminal does
    told, _ = driver.communicate(timeout=DEADLINE_S)
    assert told == "interrupted\n"
    assert not any(map(is_alive, both))
    assert failure_reason(tmp_path / "log", 0) == "stopped by SIGTERM"


def test_run_continues_when_driver_is_killed(driver: subprocess.Popen[str], tmp_path: Path) -> None:
    pid, _ = pids(tmp_path / "pid")
    os.killpg(driver.pid, signal.SIGKILL)  # the fork server goes with it
    driver.wait()
    time.sleep(0.2)
    assert is_alive(pid)
    (tmp_path / "pid.go").touch()
    until((tmp_path / "pid.done").exists, "the orphan to finish its work")
    until(lambda: "rgbt job: done" in (tmp_path / "log").read_text(), "the end of its job")


def test_run_command_has_reason_of_failure(tmp_path: Path) -> None:
    assert run_command((STEPS, "leave", "x", "0"), tmp_path / "log") == ""
    assert run_command((STEPS, "fail", "x"), tmp_path / "log") == "ValueError: a bad day"
    assert run_command((STEPS, "leave", "x", "0"), tmp_path / "log") == ""


SERVER = """
import sys
from sweeps.run import preload
from rgbt.runs import provenance
before = provenance.code()["code"]
provenance.package_digest = lambda package: "edited since"
assert provenance.code()["code"] == before
from rgbt.runs import source_code
assert set(preload.PROGRAMS).isdisjoint(sys.modules), "executed by runs as programs"
assert {"rgbt.training.train", "sweeps.run.local"} <= set(sys.modules)
"""


@pytest.mark.slow
def test_fork_server_keeps_the_code_that_it_has_loaded() -> None:
    assert importlib.util.find_spec("sweeps.run.preload") is not None
    subprocess.run([sys.executable, "-c", SERVER], check=True, cwd=ROOT)


def test_check_gpus_refuses_hidden_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2, 3")
    given: Any
    for given in ((3, 2), ((3, 2),), None):
        check_gpus(given)
    for given, named in (((3, 5), 5), (((2, 3), (4,)), 4), ((0,), 0)):
        with pytest.raises(InputError, match=f"gpus: no GPU {named};"):
            check_gpus(given)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    with pytest.raises(InputError, match="gpus: no GPU "):
        check_gpus((0, 99))
