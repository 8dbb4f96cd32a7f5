"""A run confirms a claim where the commit that made it had declared its seed and the claim."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest

from rgbt.config.values import check_value
from rgbt.files.yaml_files import read_yaml
from sweeps.plan.table import Table
from tests.declarations import undeclared

TABLE = """\
paper: my
number: one
caption: c
data: nothing
confirm: [10, 11]
columns: [{name: acc, metric: pixel_accuracy}]
claims:
  - {name: first, says: Words., source: I, rows: [a], against: [b], columns: [acc],
     expected: higher}
rows: [{label: a, experiment: crm}, {label: b, experiment: baseline}]
"""


class Run:
    """What a run records of the code that made it."""

    def __init__(self, commit: str, *, is_dirty: bool = False) -> None:
        self.key = "0123456789ab"
        self.provenance = [{"git_commit": commit, "git_dirty": is_dirty}]


def commit(root: Path, text: str) -> str:
    (root / "table.yaml").write_text(text)
    name = ("-c", "user.name=a", "-c", "user.email=a@b.c")
    for words in (("init", "-q"), ("add", "."), (*name, "commit", "-qm", "x", "--allow-empty")):
        subprocess.run(["git", "-C", str(root), *words], check=True)
    command = ["git", "-C", str(root), "rev-parse", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def reason(root: Path, run: Any) -> str:
    path = root / "table.yaml"
    table = check_value(str(path), read_yaml(path), Table)
    return undeclared(root, path, table, table.claims[0], run)


@pytest.mark.parametrize(
    ("before", "expected"),
    [
        (TABLE, ""),
        (TABLE.replace("Words.", "Other words."), ""),
        (TABLE.replace("confirm: [10, 11]\n", ""), "declares the seeds ()"),
        (TABLE.replace("[10, 11]", "[10, 11, 12]"), "declares the seeds (10, 11, 12)"),
        (TABLE.replace("expected: higher", "expected: lower"), "does not declare 'first'"),
        (TABLE.replace("higher}", "higher, exploratory: true}"), "does not declare 'first'"),
        ("[]", "has no such table"),
    ],
)
def test_declaration_must_be_older_than_the_run(tmp_path: Path, before: str, expected: str) -> None:
    made_by = commit(tmp_path, before)
    commit(tmp_path, TABLE)
    found = reason(tmp_path, Run(made_by))
    assert found.endswith(expected)
    assert bool(found) == bool(expected)


def test_changed_files_and_unknown_commits_declare_nothing(tmp_path: Path) -> None:
    made_by = commit(tmp_path, TABLE)
    assert "changed files" in reason(tmp_path, Run(made_by, is_dirty=True))
    assert "has no such table" in reason(tmp_path, Run("0" * 40))
