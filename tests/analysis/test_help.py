"""The help of the commands imports no heavy library."""

from __future__ import annotations

import subprocess
import sys

HEAVY = ("torch", "matplotlib", "mlflow", "pandas", "scipy", "PIL", "cv2")
SCRIPT = f"""
import importlib, sys
for name in ("compare", "score", "spatial"):
    sys.argv = [name, "--help"]
    try:
        importlib.import_module(f"analysis.{{name}}").entry()
    except SystemExit as left:
        assert not left.code
print(sorted(set({HEAVY}) & set(sys.modules)))
"""


def test_help_waits_for_no_heavy_library() -> None:
    words = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith("[]")
    for line in (
        "  missing      images without a prediction: refuse, or leave_out",
        "rgbt score [option=value ...]",
    ):
        assert line in done.stdout
    assert "one of: ring, vertical, horizontal (default: ring)" in done.stdout
