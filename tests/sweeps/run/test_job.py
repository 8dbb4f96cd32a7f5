"""A job: its commands, its log, signals."""

from __future__ import annotations

import json
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from rgbt.checks import InputError
from rgbt.files.atomic import holding
from sweeps.run import job as jobs
from sweeps.run.job import Job, Work, failed_before, failure_reason, how_ended, start_python
from tests.waiting import is_alive, until

STEPS = "tests.sweeps.steps"


def work_of(folder: Path, *steps: str, **environment: str) -> Work:
    """A point whose steps are these lines of words for `tests.sweeps.steps`."""
    made = dict.fromkeys((STEPS, *line.split()) for line in steps)
    return Work("key", made, environment, folder / ".logs" / "key.log", folder)


def said(work: Work) -> list[str]:
    return [line for line in work.log.read_text().splitlines() if line.startswith("rgbt job: ")]


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(jobs.__file__).parents[2]))
    monkeypatch.setattr(Job, "poll_s", 0.01)


def test_command_gets_words_folder_and_variables(tmp_path: Path) -> None:
    place = tmp_path / "größe=[1,2]"
    work = work_of(tmp_path, f"tell {place}", f"tell {tmp_path / 'other'}", GIVEN="né")
    job = pickle.loads(pickle.dumps(Job(work)))
    assert job() == 0
    told = json.loads(place.read_text())
    assert told.pop("grandparent") == str(os.getppid())
    assert told == {
        "argv": ["tell", str(place)],
        "command": ["-m", STEPS, "tell", str(place)],
        "given": "né",
        "folder": str(tmp_path),
        "gpus": os.environ.get("CUDA_VISIBLE_DEVICES"),
        "interrupt": True,
    }
    assert (tmp_path / "other").exists()
    assert said(work) == [f"rgbt job: started on {os.uname().nodename}", "rgbt job: done"]
    assert "GIVEN" not in os.environ
    assert failure_reason(work.log, 0) == failed_before(work.log) == ""


@pytest.mark.parametrize(
    ("words", "code", "reason", "is_failure"),
    [
        ("fail x", 1, "ValueError: a bad day", True),
        ("leave x 3 half", 3, "half", True),
        ("leave x 143 rgbt: stopped", 143, "stopped", False),
        ("kill x 9", -9, "stopped by SIGKILL (out of memory?)", False),
    ],
)
def test_first_step_that_fails_is_the_last(
    tmp_path: Path, words: str, code: int, reason: str, is_failure: bool
) -> None:
    work = work_of(tmp_path, words, f"tell {tmp_path / 'never'}")
    work.log.parent.mkdir()
    work.log.write_text("rgbt job: started\nrgbt: of another job\nrgbt job: exit code 1\n")
    begin = work.log.stat().st_size
    assert Job(work)() == code
    assert not (tmp_path / "never").exists()
    assert failure_reason(work.log, begin) == reason
    assert failed_before(work.log) == (reason if is_failure else "")


def in_thread(job: Job, ends: list[int]) -> threading.Thread:
    thread = threading.Thread(target=lambda: ends.append(job()))
    thread.start()
    return thread


def training(folder: Path, name: str) -> Work:
    (folder / name).mkdir(exist_ok=True)
    words = (STEPS, "train", str(folder / name / "own"))
    return Work(name, {words: folder / name}, {}, folder / f"{name}.log", folder)


@pytest.fixture
def trained(tmp_path: Path) -> Work:
    """A point whose training is that of `tests.sweeps.steps`."""
    return training(tmp_path, "a")


def run_folder(work: Work) -> Path:
    (folder,) = work.steps.values()
    assert folder is not None, "it is a training"
    return folder


def test_stopped_command_saves_and_ends(trained: Work) -> None:
    job, ends = Job(trained), list[int]()
    thread = in_thread(job, ends)
    begun = run_folder(trained) / "steps"
    until(begun.exists, "the command")
    job.is_stopped = True
    thread.join()
    assert ends == [143]
    stopped = Job(trained)
    stopped.is_stopped = True
    assert stopped() == 143
    assert begun.read_text() == "begin\n", "a job that is stopped starts nothing"


def test_two_jobs_of_a_run_train_it_once(trained: Work) -> None:
    """The second one waits for the lock, as for a command of the user."""
    ends, folder = list[int](), run_folder(trained)
    threads = [in_thread(Job(trained), ends)]
    until((folder / "steps").exists, "the command")
    threads.append(in_thread(Job(trained), ends))
    until(lambda: len(said(trained)) == 2, "the second job")
    (folder / "own.go").touch()
    for thread in threads:
        thread.join()
    assert ends == [0, 0]
    assert (folder / "steps").read_text() == "begin\n"


def test_run_that_its_holder_leaves_is_continued(trained: Work) -> None:
    ends, folder = list[int](), run_folder(trained)
    (folder / "own.go").touch()
    with holding(folder / "lock") as holder:
        assert holder is None
        thread = in_thread(Job(trained), ends)
        until(lambda: trained.log.exists() and said(trained), "the job")
        thread.join(0.2)
        assert ends == []
    thread.join()
    assert (ends, (folder / "result.json").exists()) == ([0], True)


def test_handler_may_come_when_a_command_has_ended(tmp_path: Path) -> None:
    """That of submitit waits for the command at any instant, the one of its end included."""

    def ending(work: Work, words: Sequence[str]) -> tuple[int, Callable[[], object]]:
        pid, reap = start_python(work, words)
        return pid, lambda: (reap(), job.stop())

    job = Job(work_of(tmp_path, "leave x 0"), ending)
    assert job() == 0


def test_command_ends_with_its_job(tmp_path: Path) -> None:
    place = tmp_path / "pids"
    work = work_of(tmp_path, f"wait {place}")
    pickled = tmp_path / "job"
    pickled.write_bytes(pickle.dumps(Job(work)))
    code = f"import pickle; pickle.loads(open({str(pickled)!r}, 'rb').read())()"
    process = subprocess.Popen([sys.executable, "-c", code])
    until(place.exists, "the command")
    pid, sleeper = map(int, place.read_text().splitlines()[1].split())
    process.kill()
    process.wait()
    until(lambda: not is_alive(pid), "the end of the command")
    os.kill(sleeper, signal.SIGKILL)
    assert failure_reason(work.log, 0) == jobs.LOST
    assert failed_before(work.log) == ""


def test_command_whose_job_has_ended_before_it_begins_does_nothing(tmp_path: Path) -> None:
    """A job that is queued again while it starts a command would leave it alone with the run."""
    words = ("-m", jobs.__name__, "1", STEPS, "tell", str(tmp_path / "never"))
    done = subprocess.run([sys.executable, "-P", *words], capture_output=True)
    assert (done.returncode, done.stdout, (tmp_path / "never").exists()) == (143, b"", False)


def test_signal_of_a_cluster_does_not_reach_the_command(tmp_path: Path) -> None:
    work = work_of(tmp_path, f"kill x {signal.SIGUSR2:d}", f"tell {tmp_path / 'place'}")
    assert Job(work)() == 0
    assert (tmp_path / "place").exists()


def test_error_of_a_job_is_its_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As that of submitit, which queues a job no more, and raises it in a handler."""

    def check() -> None:
        monkeypatch.undo()
        raise RuntimeError("not queued again:\ntoo many times")

    work = work_of(tmp_path, f"train {tmp_path / 'own'}")
    job = Job(work)
    monkeypatch.setattr(job, "check", check)
    with pytest.raises(RuntimeError, match="too many"):
        job()
    assert failure_reason(work.log, 0) == "not queued again: too many times"


TRACEBACK = """\
Traceback (most recent call last):
  File "run.py", line 1, in <module>
    train()
torch.cuda.OutOfMemoryError: CUDA out of memory. Tried to allocate 2 GiB
See the documentation.
"""


@pytest.mark.parametrize(
    ("end", "text", "reason"),
    [
        ("exit code 1", "warning\nrgbt: sigma_div must be positive.\n", "sigma_div must be"),
        ("exit code 1", TRACEBACK, "torch.cuda.OutOfMemoryError: CUDA out of memory. Tried to"),
        ("exit code 1", f"{TRACEBACK}rgbt: the loss is not finite.\n", "the loss is not finite."),
        ("exit code 1", "step 1\rfull \udcff disk\n", "full \ufffd disk"),
        ("exit code 1", "ValueError: " + "x" * 5000, "ValueError: " + "x" * 288),
        ("exit code 3", "", "it ended with exit code 3 and no output; see"),
        ("stopped by SIGKILL", "rgbt: x", "stopped by SIGKILL"),
        ("started on it", "rgbt: x", jobs.LOST),
        ("done", "ValueError: one that it handles", ""),
    ],
)
def test_failure_reason_is_the_last_message(
    tmp_path: Path, end: str, text: str, reason: str
) -> None:
    before = "rgbt job: started\nrgbt: an old mistake é\nrgbt job: exit code 1\n".encode()
    log = tmp_path / "run.log"
    said = f"rgbt job: started on é\n{text}\nrgbt job: {end}\n".encode(errors="surrogateescape")
    log.write_bytes(before + said)
    found = failure_reason(log, len(before))
    assert found.startswith(reason)
    assert bool(found) == bool(reason)
    assert len(found) <= max(300, len(f"{reason} {log}"))
    failed = end.startswith("exit code")
    assert failed_before(log).startswith(reason if failed else "")
    assert bool(failed_before(log)) == failed


def test_exit_codes_in_words() -> None:
    words = [how_ended(code) for code in (0, 3, -15, -99)]
    assert words == ["done", "exit code 3", "stopped by SIGTERM", "stopped by signal 99"]


def test_a_pipe_in_place_of_a_log_is_refused(tmp_path: Path) -> None:
    """It would be waited for."""
    os.mkfifo(tmp_path / "run.log")
    for read in (failed_before, lambda log: failure_reason(log, 0)):
        with pytest.raises(InputError, match="not a regular file"):
            read(tmp_path / "run.log")
