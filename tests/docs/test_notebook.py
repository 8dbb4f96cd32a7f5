"""The notebook of the tutorials: its cells run in order, and its outputs can be shown.

The cells run in this process and not in a Jupyter kernel: they are plain Python, and a kernel would
cost five more packages and several seconds. To renew the outputs: ``RGBT_RUNS_DIR=runs jupyter
execute --inplace docs/tutorials/notebook.ipynb``, with the full-size runs that it names.
"""

from __future__ import annotations

import ast
import json
import re
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pytest

from rgbt.run import main
from tests.commands import short, without_pictures, words_of
from tests.conftest import write_data

pytestmark = pytest.mark.docs

NOTEBOOK = Path(__file__).resolve().parents[2] / "docs" / "tutorials" / "notebook.ipynb"
SPLITS = {
    "train": ["00001D", "00002N"],
    "val": ["00101D", "00102N"],
    "test": [f"{200 + 9 * n:05d}{'DN'[n % 2]}" for n in range(12)],  # enough for intervals
}
METHODS = ("baseline", "grbm")
LARGEST = 300_000
"""Bytes of the file."""


@pytest.fixture(scope="module")
def cells() -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(NOTEBOOK.read_text())["cells"]
    return found


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    data = write_data(tmp_path / "mf", SPLITS, (48, 64))
    for method in METHODS:
        own = () if method == "grbm" else ("masker.patch_size=null",)
        words = words_of(data, tmp_path / "runs", f"+experiment={method}", *own, *short(1))
        monkeypatch.setattr(sys, "argv", ["rgbt", *words])
        with without_pictures(), pytest.raises(SystemExit) as left:
            main()
        assert not left.value.code
    return tmp_path / "runs"


def run_cell(source: str, names: dict[str, Any]) -> Any:
    """The value of the last expression of a cell, which Jupyter shows."""
    tree = ast.parse(source)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, str(NOTEBOOK), "exec"), names)
    return last and eval(compile(ast.Expression(last.value), str(NOTEBOOK), "eval"), names)


def test_every_cell_of_the_notebook_runs(
    runs: Path, cells: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RGBT_RUNS_DIR", str(runs))
    monkeypatch.chdir(runs.parent)  # without the archive of the repository
    drawn: list[int] = []
    monkeypatch.setattr(plt, "show", lambda: drawn.append(plt.gcf().number))
    names: dict[str, Any] = {"__name__": "__main__"}
    values = [
        run_cell("".join(cell["source"]), names) for cell in cells if cell["cell_type"] == "code"
    ]
    plt.close("all")
    assert len(drawn) == 2, "the image pair and the profile"
    scores, difference, by_class = values[0], values[4], values[5]
    assert list(scores.index.get_level_values("experiment")) == sorted(METHODS)
    assert list(difference["score"][:3]) == ["mIoU", "Var", "region/1"]
    assert by_class.shape == (9, 6)


def test_outputs_of_the_notebook_are_complete_and_private(cells: list[dict[str, Any]]) -> None:
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell["outputs"]]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
    kinds = {output["output_type"] for output in outputs}
    assert kinds <= {"display_data", "execute_result"}, "no warnings and messages"
    assert NOTEBOOK.stat().st_size < LARGEST
    assert not re.search(r"(?<![\w./])/(home|root|tmp|work|Users)/", NOTEBOOK.read_text())


def test_lines_of_the_notebook_fit_a_page(cells: list[dict[str, Any]]) -> None:
    for cell in cells:
        for line in "".join(cell["source"]).splitlines():
            assert len(line) <= 100, line
