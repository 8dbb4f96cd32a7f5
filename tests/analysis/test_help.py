"""The help of the commands imports no heavy library, and what they do imports no torch."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.analysis.test_compare import FAST, pair, saved

HEAVY = ("torch", "matplotlib", "mlflow", "pandas", "scipy", "PIL", "cv2")
SCRIPT = f"""
import importlib, sys

def run(module, *words):
    sys.argv = ["rgbt", *words]
    try:
        importlib.import_module(module).entry()
    except SystemExit as left:
        assert not left.code

for name in ("compare", "score", "spatial"):
    run(f"analysis.{{name}}", "--help")
print(sorted(set({HEAVY}) & set(sys.modules)))
counts, fast = words_of[:2], words_of[2:]
run("analysis.compare", *counts, *fast)
run("analysis.score", f"counts={{counts[0][2:]}}", "resamples=0")
run("analysis.archive", "check", "archive=none")
run("analysis.figures.__main__", "figure=multihead/fig3", "out=curves.svg")
run("sweeps.report", "runs_dir=none", "archive=none", "out=report")
print("torch" in sys.modules)
"""


@pytest.mark.slow
def test_commands_wait_for_no_heavy_library(tmp_path: Path) -> None:
    words = [*saved(tmp_path, *pair()), *FAST]
    script = f"words_of = {words}\n{SCRIPT}"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "\n[]\n" in done.stdout
    assert done.stdout.strip().endswith("False")
    for line in ("  regions      number of regions", "rgbt score [option=value ...]"):
        assert line in done.stdout
    assert "one of: ring, vertical, horizontal (default: ring)" in done.stdout
