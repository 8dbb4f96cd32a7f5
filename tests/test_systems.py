"""A system without what POSIX alone has: what needs it is refused by name, the rest works.

No test runs on Windows. What it lacks is hidden after other libraries are imported, which on Linux
use it themselves.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

HIDE = """
import asyncio, getpass, multiprocessing.forkserver, os, pkgutil, signal, sys
import cv2, hydra, lightning_fabric, matplotlib, mlflow, numpy, optuna, rich, scipy, torch
import torch.utils.data

for name in ("fcntl", "resource", "pwd", "grp", "termios", "posix"):
    sys.modules[name] = None
for name in ("fork", "register_at_fork", "uname", "getuid", "sysconf", "killpg", "setsid", "waitid",
             "getloadavg", "sched_getaffinity", "O_NOFOLLOW", "pread", "pwrite"):
    delattr(os, name)
for name in ("SIGHUP", "SIGKILL", "SIGUSR1", "SIGUSR2", "pthread_sigmask", "sigtimedwait"):
    delattr(signal, name)
"""

TRY = """
import importlib
import rgbt, sweeps, analysis
for package in (rgbt, sweeps, analysis):
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if not module.name.endswith(("__main__", "ray_tasks", "submitit_jobs")):
            importlib.import_module(module.name)
from pathlib import Path
from rgbt import __main__, api, doctor
from rgbt.checks import InputError
from rgbt.data.loaders import _blocked
from rgbt.files.atomic import write_atomic
from rgbt.tracking import ui
from sweeps.run.local import LocalExecutor

write_atomic(Path("file"), b"content")
with _blocked(0):
    print(Path("file").read_text())
print(*(name for name, _ in doctor.machine(doctor.Options())))
for refused in (
    LocalExecutor, _blocked(2).__enter__, lambda: ui.main(ui.Options(), []), __main__.main
):
    try:
        refused()
    except InputError as error:
        print(error)
"""
LINES = (
    "content",
    "rgbt command python system",
    "hydra/launcher=basic, which forks the runs of a sweep, needs os.fork",
    "data.num_workers=2 needs signal.pthread_sigmask",
    "rgbt ui, which ends MLflow's server with its workers, needs os.killpg",
)
RUN = ("run", "+experiment=grbm", "+debug=smoke", "tracking=none")


def test_what_needs_posix_is_refused_in_one_line_and_the_rest_is_imported(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HIDE + TRY, *RUN]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    advice = ", which Linux does not have; use Linux, macOS or WSL."
    expected = [f"{line}{advice if 'needs' in line else ''}" for line in LINES]
    assert done.stdout.splitlines() == expected, done.stderr[-2000:]
    # The command with the words, which is the last one that is called.
    (last,) = [line for line in done.stderr.splitlines() if "needs" in line]
    assert last.endswith(f"/lock needs fcntl{advice}")
    assert "Traceback" not in done.stderr
    assert done.returncode == 2
