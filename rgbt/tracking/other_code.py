"""Detect whether a run was made by other code than the present code.

The key of a run does not hold the code of this package: every change of it would hide all
results. Instead each process records its code (`rgbt.tracking.provenance`), and commands that show
a result compare.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rgbt.tracking.provenance import code
from rgbt.tracking.run_files import read_provenance
from rgbt.tracking.terminal import info, warn

COMMIT_LENGTH = 7


def other_code(folder: Path) -> str | None:
    """A description of a run's code, if it differs from that of this process; else None.

    Compared is the digest of the package's source, so that changed documents and tests are no
    other code. Of runs that did not note it: the commit and the uncommitted changes. None as well
    where neither is known.

    Returns:
        such as "commit abc1234 of 2026-11-20, now def5678 with uncommitted changes".
    """
    now = code()
    for entry in _contributing(read_provenance(folder / "provenance.json")):
        if _differs(folder, entry, now):
            same = entry.get("git_commit") and entry["git_commit"] == now["git_commit"]
            present = _version(now).removeprefix("commit ")
            present = "with other uncommitted changes" if same else present
            return f"{_version(entry)} of {str(entry.get('started'))[:10]}, now {present}"
    return None


def warn_of_result(folder: Path) -> None:
    """Report that a finished run was made by other code."""
    made_by = other_code(folder)
    if made_by is not None:
        info(
            f"this result was made by other code ({made_by}). fresh=true trains the run again and "
            "keeps the old result."
        )


def warn_of_steps(folder: Path, step: int) -> None:
    """Report that a run that resumes was trained by other code before."""
    made_by = other_code(folder)
    if made_by is not None:
        warn(
            f"the first {step} steps were trained by other code ({made_by}). To train all steps "
            f"with the present code, remove {folder} and rerun the command."
        )


def _contributing(entries: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Entries of the processes that the state of a run comes from.

    What a process did after the step at which a later one began is not in the state.
    """
    found: list[Mapping[str, Any]] = []
    kept_until = math.inf
    for entry in reversed(entries):
        begin = entry.get("from_step")  # None: of before it was noted
        if (begin or 0) < kept_until:
            found.insert(0, entry)
        kept_until = kept_until if begin is None else min(kept_until, begin)
    return found


def _differs(folder: Path, entry: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    if entry.get("code"):
        return bool(entry["code"] != now["code"])
    if not entry.get("git_commit") or not now["git_commit"]:
        return False
    path = folder / str(entry["diff"]) if entry.get("diff") else None
    diff = path.read_text() if path is not None and path.is_file() else ""
    is_known = path is None or path.is_file()
    return bool(entry["git_commit"] != now["git_commit"] or (is_known and diff != now["diff"]))


def _version(entry: Mapping[str, Any]) -> str:
    if not entry.get("git_commit"):
        return f"code {str(entry.get('code'))[:COMMIT_LENGTH]}"
    changes = " with uncommitted changes" if entry.get("git_dirty") else ""
    return f"commit {entry['git_commit'][:COMMIT_LENGTH]}{changes}"
