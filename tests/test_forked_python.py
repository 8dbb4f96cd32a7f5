"""Programs in forks do what Python does with the same words."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.forked_python import PYTHON

pytestmark = pytest.mark.slow

SHOWN = """
import os, sys
print(sys.argv, os.getcwd(), os.environ["MINE"], "LEFT" in os.environ, sys.stdin.read())
import mine
print("wrong", file=sys.stderr)
"""


@pytest.mark.parametrize(
    "ending",
    ["", "sys.exit()", "sys.exit(3)", "sys.exit('why')", "1 / 0", "os.kill(os.getpid(), 9)"],
)
def test_program_has_its_words_folder_variables_and_streams(
    ending: str, forks: dict[str, str], tmp_path: Path
) -> None:
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "mine.py").write_text("print('imported')")
    variables = {**os.environ, "PYTHONPATH": str(tmp_path / "lib"), "MINE": "é"}
    expected, found = (
        subprocess.run(
            [*python.split(), "-c", SHOWN + ending, "a b"],
            env=variables | forks,
            cwd=tmp_path,
            input="typed",
            capture_output=True,
            text=True,
        )
        for python in (sys.executable, PYTHON)
    )
    assert found.stdout == expected.stdout
    assert found.stderr.splitlines()[:1] == expected.stderr.splitlines()[:1] == ["wrong"]
    assert found.stderr.splitlines()[-1:] == expected.stderr.splitlines()[-1:]
    assert found.returncode == (70 if expected.returncode < 0 else expected.returncode)


def test_module_is_run_as_the_main_one(forks: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text("import sys; print(__name__, sys.argv[1:])")
    done = subprocess.run(
        [*PYTHON.split(), "-m", "own", "x"],
        env=os.environ | forks,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "__main__ ['x']\n"
