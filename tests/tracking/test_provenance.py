"""Provenance: inside a checkout, outside of one, and without secrets."""

from __future__ import annotations

import json
import platform
import subprocess
import time
from pathlib import Path

import pytest

from rgbt.tracking import provenance as module
from rgbt.tracking.provenance import command_line, provenance, without_passwords


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


def test_code_of_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = tmp_path / "code.py"
    code.write_text("a = 1\n")
    assert module._code(code)["git_commit"] is None
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
    monkeypatch.setenv("PATH", "")
    assert module._code(code)["git_commit"] is None, "without git"


@pytest.mark.parametrize(
    ("text", "safe"),
    [
        ("uri=postgresql://me:secret@host/db x", "uri=postgresql://me:***@host/db x"),
        ("a=postgresql://me:se/cr@t@host/db b=1", "a=postgresql://me:***@host/db b=1"),
        (
            "postgresql://host/db?user=me&password=secret&x=1",
            "postgresql://host/db?user=me&password=***&x=1",
        ),
        ("postgresql://u:123/abc@h/db", "postgresql://u:***@h/db"),
        ("x=://:pw@h", "x=://:***@h"),
        ("http://:pw@h:5000", "http://:***@h:5000"),
        ("https://ghp_abc@github.com/a/b", "https://***@github.com/a/b"),
        ("git+https://tok@github.com/a", "git+https://***@github.com/a"),
        ("redis://tok@h", "redis://***@h"),
        ("mysql+pymysql://u:p@ss:w/rd@h/db", "mysql+pymysql://u:***@h/db"),
        ("postgresql://u:p%40w@h?sslpassword=abc&x=1", "postgresql://u:***@h?sslpassword=***&x=1"),
        (
            "http://x?uri=postgresql%3A%2F%2Fu%3Apw%40h",
            "http://x?uri=postgresql%3A%2F%2Fu%3A***%40h",
        ),
        ("x%26password%3Dabc", "x%26password%3D***"),
        ("host=h password=abc user=u", "host=h password=*** user=u"),
        ("password = abc", "password = ***"),
        (r"password='a b\'c' user=u", "password=*** user=u"),
        ("MLFLOW_TRACKING_PASSWORD=abc python", "MLFLOW_TRACKING_PASSWORD=*** python"),
        ("MLFLOW_TRACKING_TOKEN=abc", "MLFLOW_TRACKING_TOKEN=***"),
        ("PGPASSWORD=abc", "PGPASSWORD=***"),
        ("AWS_SECRET_ACCESS_KEY=abc", "AWS_SECRET_ACCESS_KEY=***"),
        ("http://h/?token=abc", "http://h/?token=***"),
        ("api_key=abc", "api_key=***"),
        (
            '{"uri": "postgresql://u:p@h", "m": "a@b"}',
            '{"uri": "postgresql://u:***@h", "m": "a@b"}',
        ),
    ],
)
def test_passwords_are_hidden(text: str, safe: str) -> None:
    assert without_passwords(text) == safe
    assert without_passwords(safe) == safe


@pytest.mark.parametrize(
    "text",
    [
        *("http://host:5000/a", "http://host:5000/a?m=x@y", "http://127.0.0.1:5000/#/runs/x@y"),
        *("sqlite:////a/b@c.db", "sqlite:///a:b@c.db", "file:///data/x@2", "s3://bucket/a@b"),
        *("git@github.com:x/y", "ssh://git@github.com/x", "write to me@lab.org, please"),
        *("camera@consistency.view.camera=synth", "model@x=mfnet", "epoch=3@step", "a/b:c@d"),
        *("postgresql://me@h/db", "postgresql://h:5432/db", "hydra.searchpath=[file:///conf@v2]"),
        *("num_tokens=100", "mask_token=0.5", "model.token=4", "the password: it is", "tokens=5"),
    ],
)
def test_what_is_no_password_is_kept(text: str) -> None:
    assert without_passwords(text) == text


def test_a_password_that_the_shell_quotes_is_hidden() -> None:
    words = ["python", "-m", "rgbt.run", "tracking.uri=postgresql://u:a'b@h", "x='password=a b'"]
    assert "a'" not in (line := command_line([words[0], "password='a b'", *words[1:3]]))
    assert line == "python 'password=***' -m rgbt.run"


@pytest.mark.parametrize(
    "text", ["://" * 2000, "x://" + "a:" * 5000, "password" * 3000, "a" * 50000]
)
def test_hiding_takes_no_time_on_hostile_texts(text: str) -> None:
    begin = time.process_time()
    without_passwords(text)
    assert time.process_time() - begin < 1
