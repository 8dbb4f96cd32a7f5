"""Runs as submitit jobs: processes of this machine, and scripts for a stand-in of SLURM."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("submitit")

from rgbt.checks import InputError
from sweeps.worker import submitit_executor
from sweeps.worker.submitit_executor import FAILED, SubmititExecutor, SubmititJob
from tests.sweeps import fake_slurm
from tests.sweeps.fakes import is_alive, until

WORK = """
import os, signal, sys, time
from pathlib import Path
here, word, *rest = sys.argv[1:]
begun = Path(here, f"{word}.begun")
begun.open("a").write(f"{os.getpid()} {os.getppid()}\\n")
print("this is", word, os.environ.get("COLOUR"), flush=True)
print("warning", file=sys.stderr)
if "last" in rest and len(begun.read_text().splitlines()) == 1:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
while "last" in rest and len(begun.read_text().splitlines()) == 1:
    time.sleep(0.02)
while "wait" in rest and not Path(here, f"{word}.go").exists():
    time.sleep(0.02)
Path(here, f"{word}.end").touch()
code = int(rest[-1])
os.kill(os.getpid(), -code) if code < 0 else sys.exit(code)
"""


class Place:
    """A folder with the module `work`, jobs of it, and the files it leaves."""

    def __init__(self, folder: Path, options: Mapping[str, Any]) -> None:
        self.folder = folder
        (folder / "work.py").write_text(WORK)
        self.executor = SubmititExecutor(folder / "jobs", options)

    def start(self, word: str, *rest: str) -> SubmititJob:
        path = os.pathsep.join(filter(None, (str(self.folder), os.environ.get("PYTHONPATH"))))
        environment = {"COLOUR": "red", "PYTHONPATH": path}
        return self.executor.start(
            ("work", str(self.folder), word, *rest), environment, self.log(word)
        )

    def log(self, word: str) -> Path:
        return self.folder / "logs" / f"{word}.log"

    def begun(self, word: str) -> list[tuple[int, int]]:
        """(process, its parent) of each time the command was begun."""
        path = self.folder / f"{word}.begun"
        lines = path.read_text().splitlines() if path.exists() else []
        return [(int(line.split()[0]), int(line.split()[1])) for line in lines]


@pytest.fixture
def place(tmp_path: Path) -> Place:
    return Place(tmp_path, {"cluster": "local"})


def code(job: SubmititJob) -> int | None:
    until(lambda: job.poll() is not None, "the end of a job")
    return job.poll()


def began(place: Place, word: str) -> tuple[int, int]:
    return until(lambda: place.begun(word), f"the begin of {word}")[0]


def test_submitit_job_returns_exit_code_and_logs(place: Place) -> None:
    place.log("one").parent.mkdir()
    place.log("one").write_text("earlier\n")
    jobs = [place.start("one", "0"), place.start("two", "3"), place.start("three", "-9")]
    assert [code(job) for job in jobs] == [0, 3, -9]
    assert place.log("one").read_text() == "earlier\nthis is one red\nwarning\n"
    assert [code(job) for job in jobs] == [0, 3, -9], "told again when asked again"


def test_stop_ends_the_command_and_no_other(place: Place) -> None:
    stopped, other = place.start("stopped", "wait", "0"), place.start("other", "wait", "0")
    process, _ = began(place, "stopped")
    began(place, "other")
    stopped.stop()
    assert code(stopped) == -signal.SIGTERM
    assert not is_alive(process)
    assert other.poll() is None
    (place.folder / "other.go").touch()
    assert code(other) == 0
    other.stop()
    assert other.poll() == 0, "stopping what is finished changes nothing"


def test_submitit_killed_job_is_logged(place: Place) -> None:
    killed, other = place.start("killed", "wait", "0"), place.start("other", "wait", "0")
    process, parent = began(place, "killed")
    os.kill(parent, signal.SIGKILL)
    os.kill(process, signal.SIGKILL)
    assert code(killed) == FAILED
    assert "ended (no result" in place.log("killed").read_text()
    began(place, "other")
    (place.folder / "other.go").touch()
    assert code(other) == 0


def signalled(place: Place) -> SubmititJob:
    """A job that got submitit's signal, which SLURM sends before it takes the node away."""
    job = place.start("long", "last", "0")
    process, parent = began(place, "long")
    status = Path(f"/proc/{process}/status").read_text()
    blocked = int(status.partition("SigBlk:")[2].split()[0], 16)
    assert blocked >> (signal.SIGUSR2 - 1) & 1, "SLURM signals every process of a job"
    os.kill(parent, signal.SIGUSR2)
    return job


@pytest.mark.parametrize("timeout_min", [600, 5], ids=["pre-emption", "time limit"])
def test_submitit_preempted_command_is_requeued(tmp_path: Path, timeout_min: int) -> None:
    place = Place(tmp_path, {"cluster": "local", "timeout_min": timeout_min})
    assert code(signalled(place)) == 0
    assert len(place.begun("long")) == 2
    assert not is_alive(place.begun("long")[0][0])


def test_a_job_that_reached_its_limit_too_often_fails(tmp_path: Path) -> None:
    options = {"cluster": "local", "timeout_min": 5, "max_num_timeout": 0}
    place = Place(tmp_path, options)
    assert code(signalled(place)) == FAILED
    assert len(place.begun("long")) == 1
    assert not is_alive(place.begun("long")[0][0])
    assert "timed-out too many times" in place.log("long").read_text()


def test_gpus_of_this_machine_stay_visible(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "7")
    shown = "import os; print('gpus', os.environ.get('CUDA_VISIBLE_DEVICES'))"
    (place.folder / "gpus.py").write_text(shown)
    path = os.pathsep.join(filter(None, (str(place.folder), os.environ.get("PYTHONPATH"))))
    for pinned, expected in (({}, "gpus 7\n"), ({"CUDA_VISIBLE_DEVICES": "3"}, "gpus 3\n")):
        log = place.log(expected.strip())
        job = place.executor.start(("gpus",), {"PYTHONPATH": path, **pinned}, log)
        assert code(job) == 0
        assert log.read_text() == expected


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"cluster": "slrum"}, "did you mean 'slurm'"),
        ({"cluster": "local", "partition": "gpu"}, "'submitit.partition' is not an option of clus"),
        ({"cluster": "slurm", "partitoin": "gpu"}, "did you mean 'partition'"),
        ({"cluster": "slurm", "slurm_gpus_per_nod": 1}, "did you mean 'gpus_per_node'"),
        ({"cluster": "slurm", "nodes": 2}, "'submitit.nodes' is not an option"),
        ({"cluster": "slurm", "partition": "gpu"}, "submitit.timeout_min has no value"),
        ({"cluster": "slurm", "timeout_min": 60}, "this machine has no `srun`"),
        ({"cluster": "local", "timeout_min": "long"}, 'Parameter "timeout_min" expected type'),
    ],
)
def test_wrong_options_are_reported_in_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, Any], sentence: str
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError) as error:
        SubmititExecutor(tmp_path, options)
    assert sentence in str(error.value)


def test_debug_runs_inside_the_driver(tmp_path: Path) -> None:
    place = Place(tmp_path, {"cluster": "debug"})
    before = signal.getsignal(signal.SIGTERM)
    job, never = place.start("here", "4"), place.start("never", "0")
    assert code(job) == 4
    assert place.begun("here")[0][1] == os.getpid()
    never.stop()
    assert never.poll() == -signal.SIGTERM
    assert not place.begun("never")
    assert signal.getsignal(signal.SIGTERM) == before


class Away(SimpleNamespace):
    """A job that SLURM calls finished; its result comes when `code` is set."""

    def done(self, force_check: bool = False) -> bool:
        return True

    def exception(self) -> None:
        return None

    def result(self) -> int:
        return 5


@pytest.mark.parametrize("comes", [True, False])
def test_late_result_is_waited_for(tmp_path: Path, comes: bool) -> None:
    paths = SimpleNamespace(result_pickle=tmp_path / "result", stderr=tmp_path / "err")
    away = Away(paths=paths, job_id="8", state="OUT_OF_MEMORY")
    job = SubmititJob(away, tmp_path / "log", "slurm")
    assert job.poll() is None
    assert job.poll() is None
    if comes:
        paths.result_pickle.touch()
        assert job.poll() == 5
        assert not (tmp_path / "log").exists()
    else:
        job._patience_s = 0.0
        assert job.poll() == FAILED
        assert "(no result, state OUT_OF_MEMORY)" in (tmp_path / "log").read_text()


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    for name, value in fake_slurm.install(tmp_path / "slurm").items():
        monkeypatch.setenv(name, value)
    options = {"timeout_min": 90, "partition": "gpu", "cpus_per_task": 4, "mem_gb": 24}
    more = {"slurm_gpus_per_node": 1, "additional_parameters": {"requeue": True}}
    return Place(tmp_path, {"cluster": "slurm", **options, **more})


def state(place: Place) -> Path:
    return place.folder / "slurm" / "state"


def test_slurm_gets_a_script_with_the_options(slurm: Place) -> None:
    job = slurm.start("one", "3")
    assert code(job) == 3
    assert slurm.log("one").read_text().startswith("this is one red\n")
    script = (state(slurm) / "101.script").read_text()
    for line in ("partition=gpu", "time=90", "cpus-per-task=4", "mem=24GB", "gpus-per-node=1"):
        assert f"#SBATCH --{line}\n" in script
    for line in ("#SBATCH --requeue\n", "#SBATCH --job-name=rgbt\n", "#SBATCH --signal=USR2@90\n"):
        assert line in script
    assert " --cpus-per-task=4 " in script.partition("srun")[2], "SLURM 22.05 asks for it twice"


def test_submitit_refused_job_is_logged(slurm: Place) -> None:
    (state(slurm) / "refuse").write_text("gqu")
    job = slurm.start("one", "0")
    assert job.poll() == FAILED
    assert "not accepted: sbatch: error: invalid partition" in slurm.log("one").read_text()
    job.stop()
    (state(slurm) / "refuse").unlink()
    assert code(slurm.start("two", "0")) == 0


def test_slurm_gives_the_gpus(slurm: Place) -> None:
    with pytest.raises(InputError, match="gpus_per_node=1"):
        slurm.executor.start(("work",), {"CUDA_VISIBLE_DEVICES": "1"}, slurm.log("one"))


@pytest.mark.slow
def test_slurm_stop_cancels_and_waits_for_the_end(
    slurm: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sweeps.worker.submitit_executor.ASK_S", 0.2)
    job, other = slurm.start("one", "wait", "0"), slurm.start("two", "wait", "0")
    job._patience_s = 0.5
    process, _ = began(slurm, "one")
    job.stop()
    assert code(job) == -signal.SIGTERM
    assert not is_alive(process)
    assert "state CANCELLED" in slurm.log("one").read_text()
    began(slurm, "two")
    (slurm.folder / "two.go").touch()
    assert code(other) == 0


def test_job_removed_by_slurm_has_no_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A result would end the job for submitit, and SLURM would queue it again in vain."""
    waited: list[float] = []
    monkeypatch.setenv("SUBMITIT_EXECUTOR", "slurm")
    monkeypatch.setattr(submitit_executor.time, "sleep", waited.append)
    (tmp_path / "kill.py").write_text("import os, signal; os.kill(os.getppid(), signal.SIGTERM)")
    words = ("kill",)
    task = submitit_executor.Command(words, {}, str(tmp_path / "log"), str(tmp_path))
    task()
    assert waited == [submitit_executor.KILL_S]
    monkeypatch.setenv("SUBMITIT_EXECUTOR", "local")
    task()
    assert waited == [submitit_executor.KILL_S]
