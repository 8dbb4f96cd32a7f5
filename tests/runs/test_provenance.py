"""Provenance: inside a checkout and outside of one, without secrets; results of other code."""

from __future__ import annotations

import json
import platform
import subprocess
from pathlib import Path
from typing import Any

import pytest

from rgbt.runs import provenance as module
from rgbt.runs.folder import RunFolder
from rgbt.runs.provenance import (
    checkout_of,
    command_line,
    other_code,
    package_digest,
    provenance,
    without_passwords,
)


def git(folder: Path, *arguments: str) -> None:
    who = ["-c", "user.name=t", "-c", "user.email=t@t"]
    subprocess.run(["git", "-C", str(folder), *who, *arguments], check=True, capture_output=True)


def test_provenance_is_json_and_says_where_it_ran() -> None:
    entry = provenance()
    assert json.loads(json.dumps(entry)) == entry
    assert (entry["host"], entry["python"]) == (platform.node(), platform.python_version())
    assert {"torch", "numpy", "mlflow"} <= set(entry["packages"])


def test_code_of_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = tmp_path / "part" / "code.py"
    code.parent.mkdir()
    code.write_text("a = 1\n")
    assert checkout_of(code)["git_commit"] is None
    git(tmp_path, "init", "-q")
    assert checkout_of(code)["git_commit"] is None, "not tracked: the commit says nothing of it"
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "first")
    clean = checkout_of(code)
    assert len(clean["git_commit"]) == 40
    assert (clean["git_dirty"], clean["diff"]) == (False, "")
    code.write_text("a = 2\n")
    (tmp_path / "new.py").write_text("")
    dirty = checkout_of(code)
    assert (dirty["git_commit"], dirty["git_dirty"]) == (clean["git_commit"], True)
    assert "+a = 2" in dirty["diff"]
    assert [Path(file).name for file in dirty["untracked"]] == ["new.py"]
    monkeypatch.setenv("PATH", "")
    assert checkout_of(code)["git_commit"] is None, "without git"


@pytest.mark.parametrize(
    ("text", "safe"),
    [
        ("uri=postgresql://me:secret@host/db x", "uri=postgresql://me:***@host/db x"),
        ("a=postgresql://me:se/cr@t@host/db b=1", "a=postgresql://me:***@host/db b=1"),
        ("postgresql://h/d?user=me&password=x&y=1", "postgresql://h/d?user=me&password=***&y=1"),
        ("http://:pw@h:5000", "http://:***@h:5000"),
        ("https://ghp_abc@github.com/a/b", "https://***@github.com/a/b"),
        ("git+https://tok@github.com/a", "git+https://***@github.com/a"),
        ("mysql+pymysql://u:p@ss:w/rd@h/db", "mysql+pymysql://u:***@h/db"),
        (r"password = abc password='a b\'c' user=u", "password = *** password=*** user=u"),
        ("MLFLOW_TRACKING_PASSWORD=abc python", "MLFLOW_TRACKING_PASSWORD=*** python"),
        ("AWS_SECRET_ACCESS_KEY=abc PGPASSWORD=abc", "AWS_SECRET_ACCESS_KEY=*** PGPASSWORD=***"),
        ("http://h/?token=abc api_key=x", "http://h/?token=*** api_key=***"),
        ('{"uri": "postgresql://u:p@h", "m": "a"}', '{"uri": "postgresql://u:***@h", "m": "a"}'),
    ],
)
def test_passwords_are_hidden(text: str, safe: str) -> None:
    assert without_passwords(text) == safe
    assert without_passwords(safe) == safe


KEPT = (
    *("http://host:5000/a", "http://host:5000/a?m=x@y", "http://127.0.0.1:5000/#/runs/x@y"),
    *("sqlite:////a/b@c.db", "file:///data/x@2", "s3://bucket/a@b", "git@github.com:x/y"),
    *("ssh://git@github.com/x", "postgresql://me@h/db", "model@x=mfnet", "a/b:c@d"),
    *("num_tokens=100", "mask_token=0.5", "model.token=4", "the password: it is", "tokens=5"),
)


def test_only_passwords_are_hidden_also_quoted_ones() -> None:
    assert [without_passwords(text) for text in KEPT] == [*KEPT]
    assert command_line(["python", "password='a b'", "-m"]) == "python 'password=***' -m"


NOW = {"code": "c" * 64, "git_commit": "d" * 40, "git_dirty": False, "diff": ""}
OTHER = {"code": "a" * 64, "git_commit": "b" * 40, "git_dirty": True}
SAID = "commit bbbbbbbbbb+ of 2026-11-20, now commit dddddddddd"


def made_by(tmp_path: Path, *entries: dict[str, Any]) -> Path:
    folder = RunFolder(tmp_path)
    for entry in entries:
        folder.add_provenance({"started": "2026-11-20T08:00:00+00:00", "diff": "", **entry})
    return folder.path


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        *((NOW, None), (OTHER, SAID), ({"git_commit": None}, None)),
        ({**NOW, "git_commit": "e" * 40, "git_dirty": True, "diff": "docs"}, None),
        ({"code": "a" * 64}, "code without a commit of 2026-11-20, now commit dddddddddd"),
    ],
)
def test_other_code_compares_the_source_of_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, entry: dict[str, Any], said: str | None
) -> None:
    monkeypatch.setattr(module, "code", lambda: NOW)
    assert other_code(tmp_path) is None
    assert other_code(made_by(tmp_path, entry)) == said


@pytest.mark.parametrize(
    ("steps", "is_other"),  # (0, 0): it stopped before its first checkpoint
    [((0, 0), False), ((0, 40), True), ((0, 40, 0), False), ((0, 40, 30), True)],
)
def test_other_code_counts_for_processes_that_left_something(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, steps: tuple[int, ...], is_other: bool
) -> None:
    monkeypatch.setattr(module, "code", lambda: NOW)
    for number, step in enumerate(steps):
        made_by(tmp_path, {**(NOW if number else OTHER), "from_step": step})
    assert (other_code(tmp_path) is not None) == is_other


def test_package_digest_covers_code_and_tables_wherever_they_lie(tmp_path: Path) -> None:
    def digest(place: str, **files: str) -> str:
        for name, text in {"a.py": "a = 1\n", "angles.csv": "1,2\n", **files}.items():
            (tmp_path / place).mkdir(exist_ok=True)
            (tmp_path / place / name).write_text(text)
        return package_digest(tmp_path / place)

    first = digest("one")
    assert digest("two", **{"notes.md": "more"}) == first
    others = [digest("three", **{"a.py": "a = 2\n"}), digest("four", **{"angles.csv": "1,3\n"})]
    assert len({first, *others, digest("five", **{"b.py": ""})}) == 4
