"""`rgbt doctor` shows what is there and what is missing, without secrets and without a network."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from rgbt import __version__, doctor
from tests.commands import Call

ROOT = Path(__file__).resolve().parents[1]

# A Python in which nothing can be imported that rgbt needs, and which is not installed either.
BARE = """\
import sys
from importlib import metadata
MISSING = {"torch", "hydra", "omegaconf", "mlflow", "rich", "yaml", "numpy", "pydantic", "pandas"}
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in MISSING:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Missing())
metadata.distributions = lambda: []
sys.argv = ["doctor"]
from rgbt.doctor import entry
entry()
"""


def lines_of(text: str) -> dict[str, list[str]]:
    """The texts of the lines, by the word that they begin with."""
    found: dict[str, list[str]] = {}
    for line in text.splitlines():
        name, _, rest = line.partition(" ")
        found.setdefault(name, []).append(rest.strip())
    return found


@pytest.fixture(autouse=True)
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: Any) -> None:
        raise AssertionError(f"connects to {arguments}")

    monkeypatch.setattr(socket.socket, "connect", refuse)


def test_shows_versions_build_folders_and_extras(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    monkeypatch.setenv("PATH", str(tmp_path))  # no driver's program there, and no rgbt
    code, out, err = call(doctor.entry, f"runs_dir={tmp_path}")
    found = lines_of(out)
    assert (code, err, "problem" in found) == (0, "", False)
    assert found["rgbt"] == [f"{__version__} in {ROOT / 'rgbt'}"]
    assert found["torch"][0].startswith(torch.__version__)
    assert found["driver"] == ["no NVIDIA driver found"]
    assert "activate the environment" in found["command"][0]
    assert f"mlflow {metadata.version('mlflow')}" in found["packages"][0].split(", ")
    assert found["[slurm]"] == ["installed"]
    assert found["runs_dir"][0].startswith(f"{tmp_path}, ")
    assert found["MLflow"] == [f"{tmp_path}/mlflow.db, made by the first run"]
    assert list(tmp_path.iterdir()) == []


def test_passwords_are_hidden(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "https://me:geheim1@host/x")
    monkeypatch.setenv("MLFLOW_TRACKING_PASSWORD", "geheim2 and geheim4")
    for number, word in enumerate(("UC_OSS_TOKEN", "FLASK_SERVER_SECRET_KEY", "KEK_PASSPHRASE")):
        monkeypatch.setenv(f"MLFLOW_{word}", f"geheim{number}")
    _, out, err = call(doctor.entry, "uri=postgresql://me:geheim3@host/x")
    assert "MLFLOW_TRACKING_URI=https://me:***@host/x" in out
    assert "postgresql://me:***@host/x, not contacted" in out
    assert "geheim" not in out + err


def test_variables_that_rgbt_sets_are_named_as_its_own(
    call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GOMP_SPINCOUNT", "5000")
    monkeypatch.setenv("KMP_BLOCKTIME", "200")
    _, out, _ = call(doctor.entry)
    found = lines_of(out)["variable"]
    assert {"GOMP_SPINCOUNT=5000, rgbt's own value", "KMP_BLOCKTIME=200"} <= set(found)


def test_whatever_is_missing_is_a_line_and_no_traceback(tmp_path: Path) -> None:
    variables = {**os.environ, "PYTHONPATH": str(ROOT), "HOME": str(tmp_path / "gone")}
    command = [sys.executable, "-c", BARE]
    done = subprocess.run(command, cwd=tmp_path, env=variables, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (1, "")
    found = lines_of(done.stdout)
    assert "torch_build: ModuleNotFoundError: No module named 'torch'" in found["problem"]
    assert "driver" in found, "what was found before the error stays"
    assert any(re.match("not installed: .*, torch$", line) for line in found["problem"])
    assert found["[ray]"] == ["not installed: ray"]
    assert {"python", "system", "memory", "runs_dir", "cache"} <= set(found)


@pytest.mark.parametrize(
    ("build", "cards", "problem"),
    [(None, 0, "without CUDA"), ("12.8", 0, "sees no GPU"), ("12.8", 1, "")],
)
def test_driver_and_build_of_torch_are_compared(
    build: str | None,
    cards: int,
    problem: str,
    call: Call,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import torch

    program = tmp_path / "nvidia-smi"
    program.write_text("#!/bin/sh\necho 'NVIDIA H100, 560.1, 80000 MiB'\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setattr(torch.version, "cuda", build)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cards > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: cards)
    card: Any = type("Card", (), {"name": "H100", "total_memory": 85e9, "major": 9, "minor": 0})
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda index: card)
    code, out, _ = call(doctor.entry)
    found = lines_of(out)
    assert found["driver"] == ["NVIDIA H100, 560.1, 80000 MiB"]
    assert (code, len(found.get("problem", []))) == ((1, 1) if problem else (0, 0))
    assert problem in "".join(found.get("problem", []))
    assert ("GPU" in found) == (cards > 0)


def test_driver_that_fails_is_there(call: Call, tmp_path: Path, monkeypatch: Any) -> None:
    said = "Failed to initialize NVML: Driver/library version mismatch"
    program = tmp_path / "nvidia-smi"
    program.write_text(f"#!/bin/sh\necho '{said}'\nexit 18\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    assert lines_of(call(doctor.entry)[1])["driver"] == [f"nvidia-smi: {said}"]


def test_folder_that_cannot_be_written_is_a_problem(call: Call) -> None:
    code, out, _ = call(doctor.entry, "runs_dir=/proc/runs")
    assert code == 1
    assert "runs_dir=/proc/runs: cannot write" in lines_of(out)["problem"][0]
