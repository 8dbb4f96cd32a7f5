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
from sweeps.evaluation import ExtraEvaluation
from sweeps.worker import executors
from sweeps.worker.executors import Job, LocalExecutor, check_gpus, fork_template
from sweeps.worker.template import Template
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


@pytest.fixture(scope="module", params=["fork server", "template"])
def executor(module: Path, request: pytest.FixtureRequest) -> Iterator[LocalExecutor]:
    # Nothing here needs torch. The server is one of the whole process: later tests start their own.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(executors, "PRELOADED", ())
        patch.setattr(executors, "MLFLOW", ())
        patch.setattr(executors, "own_modules", list)
        patch.setattr(executors, "_templates", [])
        if request.param == "template":
            fork_template(with_mlflow=False)
        yield LocalExecutor()
        for template in executors._templates:
            template.close()
    if request.param == "fork server":
        forkserver._forkserver._stop()


Start = Callable[..., Job]


@pytest.fixture
def start(executor: LocalExecutor, tmp_path: Path) -> Iterator[Start]:
    """Start the module; what is left of its processes is ended after the test."""
    jobs: list[Any] = []

    def run(*words: str, environment: dict[str, str] | None = None) -> Job:
        job = executor.start(("tiny_run", *words), environment or {}, tmp_path / "logs" / "log")
        jobs.append(job)
        return job

    yield run
    for job in jobs:
        if job.poll() is None:
            job._signal(signal.SIGKILL)
            code(job)


def code(job: Job) -> int | None:
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
    [
        (("leave", "x", "0"), 0),
        (("leave", "x", "3"), 3),
        (("raise", "x"), 1),
        (("kill", "x", str(int(signal.SIGKILL))), -9),
        (("kill", "x", str(int(signal.SIGSEGV))), -11),
    ],
    ids=["in order", "exit code", "exception", "killed", "crash"],
)
def test_local_job_returns_exit_code_and_logs(
    start: Start, tmp_path: Path, words: tuple[str, ...], expected: int
) -> None:
    job = start(*words)
    assert code(job) == expected
    job.stop()  # too late, and no harm
    assert job.poll() == expected
    said = (tmp_path / "logs" / "log").read_text()
    assert said.startswith(f"said {words[0]}\n")
    assert "complained\n" in said
    assert ("ValueError: a bad day" in said) == (words[0] == "raise")


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
    monkeypatch.setattr(executors, "GRACE_S", 0.0)
    job.stop()
    assert code(job) == -signal.SIGKILL
    until(lambda: not is_alive(child), "the end of the child")


DRIVER = """
import sys, time
from pathlib import Path
from sweeps.worker import executors

if __name__ == "__main__":
    sys.path.insert(0, sys.argv[1])
    executors.PRELOADED, executors.own_modules = (), list
    if sys.argv[3] == "template":
        executors.fork_template(with_mlflow=False)
    folder = Path(sys.argv[2])
    command = ("tiny_run", "wait", str(folder / "pid"))
    job = executors.LocalExecutor().start(command, {}, folder / "log")
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


@pytest.fixture(params=["fork server", "template"])
def driver(
    module: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> Iterator[subprocess.Popen[str]]:
    """A driver in a process group of its own, as a shell starts it."""
    (tmp_path / "a_driver.py").write_text(DRIVER)
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "a_driver.py"), str(module), str(tmp_path), request.param],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(Path(executors.__file__).parents[2])},
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


def test_template_that_ended_fails_the_start_and_ends_the_wait(module: Path) -> None:
    template = Template((), lambda: None)
    process = template.start(time.sleep, (600,), ())
    assert process.exitcode is None
    os.kill(template._pid, signal.SIGKILL)
    os.waitpid(template._pid, 0)
    with pytest.raises(OSError, match="the process that starts runs has ended"):
        template.start(time.sleep, (600,), ())
    assert process.exitcode is None, "the run continues"
    os.kill(process.pid, signal.SIGKILL)
    until(lambda: process.exitcode == 255, "the end of a process without a parent")


def test_template_imports_modules_before_it_forks(module: Path, tmp_path: Path) -> None:
    (module / "late.py").write_text("NUMBER = 1\n")
    template = Template((), lambda: None)
    try:
        for name in ("first", "second"):
            process = template.start(_write_number, (str(tmp_path / name),), ("late", "no_such"))
            until(lambda job=process: job.exitcode is not None, "its end")
            (module / "late.py").write_text("NUMBER = 2\n")
    finally:
        template.close()
    assert [(tmp_path / name).read_text() for name in ("first", "second")] == ["1", "1"]


def _write_number(path: str) -> None:
    import late

    Path(path).write_text(str(late.NUMBER))


def test_preloaded_modules_exist_and_commands_are_not_among_them() -> None:
    """A misspelt name would be left out in silence, and every run would take seconds longer."""
    names = (*executors.PRELOADED, *executors.MLFLOW, executors.PRELOADED_LAST)
    assert all(importlib.util.find_spec(name) is not None for name in names)
    evaluations = (ExtraEvaluation(), ExtraEvaluation(frames="aligned"))
    called = {"rgbt.run", *(evaluation.command[0] for evaluation in evaluations)}
    assert called == set(executors.COMMANDS)
    assert not called & set(executors.own_modules())


@pytest.mark.parametrize(
    ("shown", "gpus", "sentence"),
    [
        ("2,3", (3, 5), "there is no GPU 5, CUDA_VISIBLE_DEVICES=2,3 shows the GPUs"),
        ("", (0,), "there is no GPU 0, CUDA_VISIBLE_DEVICES= shows no GPU; omit gpus."),
        (None, (0, 99), "there is no GPU "),
        ("2,3", (3, 2), None),
        ("2,3", ((3, 2),), None),
        ("2,3", ((2, 3), (4,)), "gpus=[[2, 3], [4]]: there is no GPU 4"),
        ("2,3", None, None),
    ],
)
def test_check_gpus_refuses_hidden_ones(
    monkeypatch: pytest.MonkeyPatch,
    shown: str | None,
    gpus: tuple[int | tuple[int, ...], ...] | None,
    sentence: str | None,
) -> None:
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if shown is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", shown)
    if sentence is None:
        check_gpus(gpus)
        return
    with pytest.raises(InputError) as error:
        check_gpus(gpus)
    assert sentence in str(error.value)
