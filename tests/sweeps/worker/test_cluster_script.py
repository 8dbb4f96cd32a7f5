"""The array script of the how-to page on clusters, run with stand-ins for its driver and SLURM."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from pathlib import Path

import pytest

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "how-to" / "cluster-and-slurm.md"
PYTHON = """#!/bin/bash
echo "$@" > $STATE/command
trap 'echo told >> $STATE/driver; exit 143' TERM
touch $STATE/begun
[ -e $STATE/short ] && exit 7
while true; do sleep 0.05; done
"""


@pytest.fixture
def script(tmp_path: Path) -> Path:
    (text,) = re.findall(r"```bash\n(#!/bin/bash\n.*?)```", DOCUMENT.read_text(), re.DOTALL)
    (tmp_path / "rgbt.sbatch").write_text(text.replace("/shared/you/rgbt", str(tmp_path)))
    programs = tmp_path / ".venv" / "bin"
    programs.mkdir(parents=True)
    (programs / "activate").write_text(f'PATH="{programs}:$PATH"\n')
    written = {"python": PYTHON, "scontrol": '#!/bin/bash\necho "$@" > $STATE/scontrol\n'}
    for name, text in written.items():
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    return tmp_path / "rgbt.sbatch"


def start(script: Path) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "STATE": str(script.parent), "SLURM_JOB_ID": "42"}
    process = subprocess.Popen(["bash", str(script)], env=environment)
    while not (script.parent / "begun").exists():
        assert process.poll() is None
        time.sleep(0.02)
    return process


def test_the_task_ends_as_its_driver_does(script: Path) -> None:
    (script.parent / "short").touch()
    environment = {**os.environ, "STATE": str(script.parent)}
    assert subprocess.run(["bash", str(script)], env=environment).returncode == 7
    command = (script.parent / "command").read_text()
    assert command.startswith("-m rgbt.run -m +search=grbm ")
    assert "hydra.sweeper.workers=1" in command


@pytest.mark.parametrize(("number", "code"), [(signal.SIGUSR1, 0), (signal.SIGTERM, 143)])
def test_the_driver_is_stopped_before_the_task_ends(
    script: Path, number: signal.Signals, code: int
) -> None:
    process = start(script)
    process.send_signal(number)
    assert process.wait(30) == code
    assert (script.parent / "driver").read_text() == "told\n"
    requeued = (script.parent / "scontrol").exists()
    assert requeued == (number == signal.SIGUSR1), "SLURM queues a pre-empted task again itself"
    assert not requeued or (script.parent / "scontrol").read_text() == "requeue 42\n"


def test_its_keys_are_those_of_the_sweeper() -> None:
    conf = DOCUMENT.parents[2] / "conf" / "hydra" / "sweeper" / "study.yaml"
    known = set(re.findall(r"^(\w+):", conf.read_text(), re.MULTILINE))
    used = set(re.findall(r"hydra\.sweeper\.(\w+)", DOCUMENT.read_text()))
    assert used
    assert used <= known
