"""How long threads wait in a loop: set before torch is loaded, inherited, never over the user's."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import rgbt

ROOT = Path(__file__).resolve().parents[1]
NAMES = (*rgbt.WAITING, "OMP_WAIT_POLICY")
PRINTED = "import os, json; print(json.dumps(dict(os.environ)))"


def variables(code: str, **given: str) -> dict[str, str]:
    """What a new Python process has of the variables, after this code."""
    kept = {name: value for name, value in os.environ.items() if name not in NAMES}
    command = [sys.executable, "-c", f"{code}; {PRINTED}"]
    done = subprocess.run(command, env=kept | given, capture_output=True, check=True, cwd=ROOT)
    found = json.loads(done.stdout)
    return {name: found[name] for name in NAMES if name in found}


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"GOMP_SPINCOUNT": "7"},
        {"KMP_BLOCKTIME": "200"},
        {"OMP_WAIT_POLICY": "ACTIVE"},
        {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0"},
    ],
)
def test_variables_of_the_user_are_kept(given: dict[str, str]) -> None:
    assert variables("import rgbt", **given) == (given or rgbt.WAITING)


def test_several_processes_sleep_unless_the_user_decides() -> None:
    code = "import rgbt.cores; rgbt.cores.sleep_while_waiting()"
    assert variables(code) == {"GOMP_SPINCOUNT": "0", "KMP_BLOCKTIME": "0"}
    assert variables(code, GOMP_SPINCOUNT="7") == {"GOMP_SPINCOUNT": "7"}


def read_by_openmp(*words: str, folder: Path) -> set[str]:
    """The spin counts that OpenMP itself prints as read, in these words of Python and its children.

    Skips where torch is built with another OpenMP than GNU's.
    """
    kept = {name: value for name, value in os.environ.items() if name not in NAMES}
    done = subprocess.run(
        [sys.executable, *words],
        env={**kept, "OMP_DISPLAY_ENV": "verbose", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        cwd=folder,
    )
    if "GOMP_SPINCOUNT" not in done.stderr:
        assert "OPENMP DISPLAY ENVIRONMENT BEGIN" not in done.stderr.upper(), done.stderr
        pytest.skip("torch is built with another OpenMP")
    return set(re.findall(r"GOMP_SPINCOUNT = '(\w+)'", done.stderr))


@pytest.mark.slow
def test_openmp_of_a_command_has_read_the_value(tmp_path: Path) -> None:
    words = ("-m", "rgbt.run", "+experiment=mfnet", "optimizer.lr=-1")
    assert read_by_openmp(*words, folder=tmp_path) == {rgbt.WAITING["GOMP_SPINCOUNT"]}


@pytest.mark.slow
@pytest.mark.parametrize(("workers", "expected"), [(1, rgbt.WAITING["GOMP_SPINCOUNT"]), (2, "0")])
def test_openmp_of_the_runs_of_a_sweep_has_read_the_value(
    tmp_path: Path, workers: int, expected: str
) -> None:
    words = ("-c", SWEEP.format(workers=workers))
    assert read_by_openmp(*words, folder=tmp_path) == {expected}
    assert "\nThe Zen of Python" in (tmp_path / "log").read_text()


SWEEP = """
import time
from pathlib import Path
from sweeps.run.job import Work
from sweeps.run.local import LocalExecutor
executor = LocalExecutor({workers})
(job,) = executor.submit([Work("key", {{("this",): None}}, {{}}, Path("log"), Path.cwd())])
while executor.state(job) == "running":
    time.sleep(0.05)
"""


@pytest.mark.parametrize("package", ["sweeps", "analysis", "hydra_plugins"])
def test_torch_is_imported_after_rgbt(package: str) -> None:
    """Imports are sorted, so that one of torch at the top of a module comes before ours."""
    for path in (ROOT / package).rglob("*.py"):
        tops = [
            statement
            for statement in ast.parse(path.read_text()).body
            if isinstance(statement, ast.Import)
        ]
        assert "torch" not in {alias.name for statement in tops for alias in statement.names}, path


def test_usable_cores_are_those_that_the_process_may_use() -> None:
    code = "import os, rgbt.cores; os.sched_setaffinity(0, {0}); print(rgbt.cores.usable_cores())"
    if not hasattr(os, "sched_setaffinity"):
        pytest.skip("Linux only")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, cwd=ROOT)
    assert int(done.stdout) == 1
