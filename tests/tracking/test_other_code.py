"""Results of other code: what is compared, and which processes a result comes from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rgbt.files.budgets import SEAL
from rgbt.tracking import other_code as module
from rgbt.tracking.other_code import other_code, warn_of_result, warn_of_steps
from rgbt.tracking.provenance import package_digest
from rgbt.tracking.run_folder import RunFolder

NOW = {"code": "c" * 64, "git_commit": "d" * 40, "git_dirty": False, "diff": ""}
OTHER = {"code": "a" * 64, "git_commit": "b" * 40, "git_dirty": True}
SAID = "commit bbbbbbb with uncommitted changes of 2026-11-20, now ddddddd"


@pytest.fixture(autouse=True)
def now(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "code", lambda: NOW)


def made_by(tmp_path: Path, *entries: dict[str, Any]) -> Path:
    folder = RunFolder(tmp_path)
    for entry in entries:
        folder.add_provenance({"started": "2026-11-20T08:00:00+00:00", "diff": "", **entry})
    return folder.path


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        (NOW, None),
        ({**NOW, "git_commit": "e" * 40, "git_dirty": True, "diff": "docs"}, None),
        (OTHER, SAID),
        ({"code": "a" * 64}, "code aaaaaaa of 2026-11-20, now ddddddd"),
        (
            {**NOW, "code": "a" * 64},
            "commit ddddddd of 2026-11-20, now with other uncommitted changes",
        ),
        # Of before the digest was noted.
        ({**NOW, "code": None}, None),
        ({**OTHER, "code": None}, SAID),
        (
            {**NOW, "code": None, "git_dirty": True, "diff": "-a\n+b\n"},
            "commit ddddddd with uncommitted changes of 2026-11-20, "
            "now with other uncommitted changes",
        ),
        ({"git_commit": None}, None),
    ],
)
def test_other_code_compares_the_source_of_the_package(
    tmp_path: Path, entry: dict[str, Any], said: str | None
) -> None:
    assert other_code(made_by(tmp_path, entry)) == said


@pytest.mark.parametrize(
    ("steps", "is_other"),
    [
        ((0, 0), False),  # it stopped before its first checkpoint
        ((0, 40), True),
        ((0, 40, 0), False),
        ((0, 40, 30), True),
    ],
)
def test_other_code_counts_for_processes_that_left_something(
    tmp_path: Path, steps: tuple[int, ...], is_other: bool
) -> None:
    folder = RunFolder(tmp_path)
    for number, step in enumerate(steps):
        folder.add_provenance({**(NOW if number else OTHER), "diff": ""})
        folder.begin_at(step)
    entries = json.loads((folder.path / "provenance.json").read_text())
    assert all(SEAL in entry for entry in entries), "the note keeps the check sums"
    assert (other_code(folder.path) is not None) == is_other


def test_other_code_of_a_run_without_provenance_is_unknown(tmp_path: Path) -> None:
    assert other_code(tmp_path) is None


def test_warnings_say_what_made_it_and_what_to_type(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = made_by(tmp_path, OTHER)
    warn_of_result(folder)
    warn_of_steps(folder, 40)
    assert capsys.readouterr().err == (
        f"rgbt: this result was made by other code ({SAID}). fresh=true trains the run "
        "again and keeps the old result.\n"
        f"rgbt: warning: the first 40 steps were trained by other code ({SAID}). To train all "
        f"steps with the present code, remove {folder} and rerun the command.\n"
    )
    same = made_by(tmp_path / "same", NOW)
    warn_of_result(same)
    warn_of_steps(same, 40)
    assert capsys.readouterr().err == ""


def test_package_digest_is_of_code_and_tables_wherever_they_lie(tmp_path: Path) -> None:
    def digest(place: str, **files: str) -> str:
        for name, text in {"a.py": "a = 1\n", "angles.csv": "1,2\n", **files}.items():
            (tmp_path / place).mkdir(exist_ok=True)
            (tmp_path / place / name).write_text(text)
        return package_digest(tmp_path / place)

    first = digest("one")
    assert digest("two", **{"notes.md": "more"}) == first
    others = [digest("three", **{"a.py": "a = 2\n"}), digest("four", **{"angles.csv": "1,3\n"})]
    assert len({first, *others, digest("five", **{"b.py": ""})}) == 4
