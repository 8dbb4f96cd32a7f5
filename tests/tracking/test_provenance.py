"""Provenance: inside a checkout, outside of one, and without secrets."""

from __future__ import annotations

import json
import platform
import subprocess
from pathlib import Path

import pytest

from rgbt.tracking import provenance as module
from rgbt.tracking.provenance import provenance, without_passwords


def git(folder: Path, *arguments: str) -> None:
    who = ["-c", "user.name=t", "-c", "user.email=t@t"]
    subprocess.run(["git", "-C", str(folder), *who, *arguments], check=True, capture_output=True)


def test_provenance_can_be_written_as_json_and_says_where_it_ran() -> None:
    entry = provenance()
    assert json.loads(json.dumps(entry)) == entry
    assert entry["host"] == platform.node()
    assert entry["python"] == platform.python_version()
    assert {"torch", "numpy", "mlflow"} <= set(entry["packages"])
    assert entry["started"].endswith("+00:00")
    assert entry["cpu_count"] >= 1


def test_code_outside_a_checkout_has_no_commit(tmp_path: Path) -> None:
    (tmp_path / "code.py").write_text("a = 1\n")
    assert module._code(tmp_path / "code.py")["git_commit"] is None


def test_code_of_a_checkout(tmp_path: Path) -> None:
    code = tmp_path / "code.py"
    code.write_text("a = 1\n")
    git(tmp_path, "init", "-q")
    assert module._code(code)["git_commit"] is None, "not tracked: the commit says nothing of it"
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "first")
    clean = module._code(code)
    assert len(clean["git_commit"]) == 40
    assert (clean["git_dirty"], clean["diff"]) == (False, "")
    code.write_text("a = 2\n")
    (tmp_path / "new.py").write_text("")
    dirty = module._code(code)
    assert dirty["git_commit"] == clean["git_commit"]
    assert dirty["git_dirty"] is True
    assert "+a = 2" in dirty["diff"]
    assert dirty["untracked"] == ["new.py"]


def test_without_git_there_is_no_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert module._code(Path(module.__file__))["git_commit"] is None


@pytest.mark.parametrize(
    ("text", "safe"),
    [
        ("uri=postgresql://me:secret@host/db x", "uri=postgresql://me:***@host/db x"),
        ("a=postgresql://me:se/cr@t@host/db b=1", "a=postgresql://me:***@host/db b=1"),
        (
            "postgresql://host/db?user=me&password=secret&x=1",
            "postgresql://host/db?user=me&password=***&x=1",
        ),
        ("http://host:5000/a", "http://host:5000/a"),
        ("http://host:5000/a?m=x@y", "http://host:5000/a?m=x@y"),
        ("sqlite:////a/b@c.db", "sqlite:////a/b@c.db"),
    ],
)
def test_passwords_are_hidden(text: str, safe: str) -> None:
    assert without_passwords(text) == safe
