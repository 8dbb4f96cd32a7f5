"""Runs as submitit jobs: processes of this machine, and scripts for a stand-in of SLURM."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("submitit")

from rgbt.checks import InputError
from sweeps.worker import submitit_executor
from sweeps.worker.processes import Job
from sweeps.worker.submitit_executor import FAILED, Command, SubmititExecutor
from tests.sweeps import fake_slurm
from tests.sweeps.fakes import is_alive, until

WORK = """
import os, signal, sys, time
from pathlib import Path
here, word, *rest = sys.argv[1:]
Path(here, f"{word}.begun").open("a").write(f"{os.getpid()} {os.getppid()}\\n")
print("this is", word, os.environ.get("COLOUR"), flush=True)
print("warning", file=sys.stderr)
while "wait" in rest and not Path(here, f"{word}.go").exists():
    time.sleep(0.02)
code = int(rest[-1])
os.kill(os.getpid(), -code) if code < 0 else sys.exit(code)
"""


class Place:
    """A folder with the module `work`, jobs of it, and the files it leaves."""

    def __init__(self, folder: Path, options: Mapping[str, Any]) -> None:
        self.folder = folder
        (folder / "work.py").write_text(WORK)
        self.executor = SubmititExecutor(folder / "jobs", options)

    def start(self, word: str, *rest: str) -> Job:
        path = os.pathsep.join(filter(None, (str(self.folder), os.environ.get("PYTHONPATH"))))
        environment = {"COLOUR": "red", "PYTHONPATH": path}
        words = ("work", str(self.folder), word, *rest)
        return self.executor.start(words, environment, self.log(word))

    def log(self, word: str) -> Path:
        return self.folder / "logs" / f"{word}.log"

    def begun(self, word: str) -> tuple[int, int]:
        """(process, its parent) of a command that has begun."""
        path = self.folder / f"{word}.begun"
        until(lambda: path.exists() and path.read_text(), f"the begin of {word}")
        process, parent = map(int, path.read_text().split())
        return process, parent


@pytest.fixture
def place(tmp_path: Path) -> Place:
    return Place(tmp_path, {"cluster": "local"})


def code(job: Job) -> int | None:
    until(lambda: job.poll() is not None, "the end of a job")
    return job.poll()


def test_submitit_job_returns_exit_code_and_logs(place: Place) -> None:
    place.log("one").parent.mkdir()
    place.log("one").write_text("earlier\n")
    jobs = [place.start("one", "0"), place.start("two", "3"), place.start("three", "-9")]
    assert [code(job) for job in jobs] == [0, 3, -9]
    assert place.log("one").read_text() == "earlier\nthis is one red\nwarning\n"


def test_stop_ends_the_command_and_no_other(place: Place) -> None:
    stopped, other = place.start("stopped", "wait", "0"), place.start("other", "wait", "0")
    process, _ = place.begun("stopped")
    place.begun("other")
    stopped.stop()
    assert code(stopped) == -signal.SIGTERM
    until(lambda: not is_alive(process), "the end of the command")
    assert other.poll() is None
    (place.folder / "other.go").touch()
    assert code(other) == 0
    other.stop()
    assert other.poll() == 0, "stopping what is finished changes nothing"


def test_gpus_of_this_machine_stay_visible(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "7")
    shown = "import os; print('gpus', os.environ.get('CUDA_VISIBLE_DEVICES'))"
    (place.folder / "gpus.py").write_text(shown)
    log = place.log("gpus")
    assert code(place.executor.start(("gpus",), {"PYTHONPATH": str(place.folder)}, log)) == 0
    assert log.read_text() == "gpus 7\n"


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"cluster": "slrum"}, "slrum"),
        ({"cluster": "local", "partition": "gpu"}, "local_partition"),
        ({"cluster": "slurm", "partition": "gpu"}, "timeout_min"),
        ({"cluster": "slurm", "timeout_min": 60}, "srun"),
    ],
)
def test_wrong_options_are_refused_with_their_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, Any], named: str
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match=rf"^submitit.*{named}"):
        SubmititExecutor(tmp_path, options)


SLURM = {
    **{"cluster": "slurm", "timeout_min": 90, "partition": "gpu", "cpus_per_task": 4},
    **{"slurm_gpus_per_node": 1, "additional_parameters": {"requeue": True}},
}


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    for name, value in fake_slurm.install(tmp_path / "slurm").items():
        monkeypatch.setenv(name, value)
    return Place(tmp_path, SLURM)


def state(place: Place) -> Path:
    return place.folder / "slurm" / "state"


def test_slurm_gets_a_script_with_the_options(slurm: Place) -> None:
    assert code(slurm.start("one", "3")) == 3
    assert slurm.log("one").read_text().startswith("this is one red\n")
    script = (state(slurm) / "101.script").read_text()
    for option in ("partition=gpu", "time=90", "cpus-per-task=4", "gpus-per-node=1", "requeue"):
        assert f"#SBATCH --{option}\n" in script
    assert "#SBATCH --job-name=rgbt\n" in script
    assert " --cpus-per-task=4 " in script.partition("srun")[2], "SLURM 22.05 asks for it twice"
    with pytest.raises(InputError, match="slurm_partitoin"):
        SubmititExecutor(slurm.folder, {**SLURM, "partitoin": "gpu"})


def test_refused_and_lost_jobs_fail(slurm: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="gpus_per_node=1"):
        slurm.executor.start(("work",), {"CUDA_VISIBLE_DEVICES": "1"}, slurm.log("one"))
    monkeypatch.setattr("submitit.SlurmJob._results_timeout_s", 0)
    (state(slurm) / "silent").touch()  # its node fails
    assert code(slurm.start("one", "0")) == FAILED
    assert "NODE_FAIL" in slurm.log("one").read_text()
    (state(slurm) / "refuse").write_text("gqu")
    job = slurm.start("two", "0")
    assert job.poll() == FAILED
    assert "not accepted: sbatch: error: invalid partition" in slurm.log("two").read_text()
    job.stop()


def test_command_ended_by_slurm_has_no_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A result would end the job for submitit, and SLURM would queue it again in vain."""
    waited: list[float] = []
    monkeypatch.setattr(submitit_executor.time, "sleep", waited.append)
    (tmp_path / "ended.py").write_text("import os, signal; os.kill(os.getpid(), signal.SIGTERM)")
    task = Command(("ended",), {"PYTHONPATH": str(tmp_path)}, str(tmp_path / "log"))
    assert task.checkpoint().function == task, "queued again, it is the same"
    for cluster, times in (("local", 0), ("slurm", 1)):
        monkeypatch.setenv("SUBMITIT_EXECUTOR", cluster)
        assert task() == -signal.SIGTERM
        assert len(waited) == times
