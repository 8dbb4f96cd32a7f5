"""Clusters of this machine for tests: SLURM of one node, and Ray of two nodes with a GPU each."""

from __future__ import annotations

import getpass
import os
import secrets
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from tests.sweeps.servers import free_port

START_S = 60.0
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun")
CORES = 8

# No root, no cgroups, no accounting: everything is below one folder, and listens on loopback. A job
# that is queued again waits until its credential has expired, which takes 120 s by default.
CONFIGURATION = """\
ClusterName=tests
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=15
CredType=cred/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
KillWait=15
SchedulerParameters=sched_interval=2
SlurmdParameters=config_overrides
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory=16000 State=UNKNOWN
PartitionName=tests Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


@contextmanager
def slurm() -> Iterator[None]:
    """A SLURM of our own, which the environment names and which ends with the block.

    One that runs here is left alone. Processes of the tests have one each, and share nothing.
    """
    path = os.pathsep.join((os.environ.get("PATH", ""), "/usr/sbin", "/usr/local/sbin"))
    missing = [name for name in PROGRAMS if not shutil.which(name, path=path)]
    if missing:
        pytest.skip(f"SLURM is not installed ({missing[0]}): apt-get install slurm-wlm munge")
    folder = Path(tempfile.mkdtemp(prefix="rgbt-slurm-", dir="/tmp"))
    with ExitStack() as stack, pytest.MonkeyPatch.context() as patch:
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        patch.setenv("PATH", path)
        patch.setenv("SLURM_CONF", str(folder / "slurm.conf"))
        try:
            _start(folder, stack)
        except (OSError, subprocess.SubprocessError, TimeoutError) as error:
            log = folder / "slurmctld.log"
            said = log.read_text().splitlines()[-1:] if log.exists() else ""
            pytest.skip(f"SLURM does not start here: {error} {said}")
        yield
        subprocess.run(["scancel", f"--user={getpass.getuser()}"], check=False)


def _start(folder: Path, stack: ExitStack) -> None:
    """Start munge and both daemons of SLURM; `stack` stops them."""
    for name in ("state", "spool"):
        (folder / name).mkdir()
    folder.chmod(0o755)  # munge refuses a socket that others cannot reach
    key, host = folder / "munge.key", os.uname().nodename.partition(".")[0]
    key.write_bytes(secrets.token_bytes(128))
    key.chmod(0o400)
    ports = (free_port(), free_port())
    text = CONFIGURATION.format(
        host=host, ports=ports, user=getpass.getuser(), folder=folder, cores=CORES
    )
    (folder / "slurm.conf").write_text(text)
    files = {"socket": "socket", "key-file": "key", "pid-file": "pid", "log-file": "log"}
    munge = [f"--{name}={folder}/munge.{end}" for name, end in files.items()]
    commands = (
        ["munged", "--foreground", f"--seed-file={folder}/munge.seed", *munge],
        ["slurmctld", "-D", "-f", f"{folder}/slurm.conf"],
        ["slurmd", "-D", "-f", f"{folder}/slurm.conf", "-N", host],
    )
    for command in commands:
        process = subprocess.Popen(
            command,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        stack.callback(_stop, process)
        if command[0] == "munged":
            _wait((folder / "munge.socket").exists, "munge")
    _wait(_is_idle, "SLURM")


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    with suppress(subprocess.TimeoutExpired):
        process.wait(5)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _wait(condition: Any, what: str) -> None:
    end = time.monotonic() + START_S
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"{what} did not answer within {START_S:g} s")
        time.sleep(0.1)


def _is_idle() -> bool:
    command = ("sinfo", "--noheader", "--format=%T")
    found = subprocess.run(command, capture_output=True, text=True, timeout=30)
    return found.stdout.strip() == "idle"


@contextmanager
def ray_cluster() -> Iterator[Any]:
    """A `ray.cluster_utils.Cluster` of two nodes, each with a core and, as it says, a GPU."""
    pytest.importorskip("ray", reason="Ray is missing: pip install -e '.[dev]'")
    from ray.cluster_utils import Cluster

    before = signal.getsignal(signal.SIGTERM)  # Ray sets its own
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.delenv("RAY_ADDRESS", raising=False)
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "num_gpus": 1})
        try:
            cluster.add_node(num_cpus=1, num_gpus=1)
            yield cluster
        finally:
            cluster.shutdown()
            signal.signal(signal.SIGTERM, before)
