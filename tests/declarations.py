"""Whether runs were made after their table had declared their seed and the claim."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from itertools import product
from pathlib import Path

import yaml

from rgbt.checks import InputError
from rgbt.config.values import check_value
from rgbt.runs.result import RunResult
from sweeps.judge.judged_table import JudgedTable
from sweeps.plan.claim import Claim
from sweeps.plan.table import Table, table_path


def confirming(tables: Iterable[JudgedTable]) -> list[tuple[Path, Table, Claim, RunResult]]:
    """Every run of a declared seed that judges a claim: file of the table, table, claim, run."""
    found = []
    for judged in tables:
        path, table = table_path(judged.request.name), judged.request.table
        for claim in judged.claims:
            if claim.basis != "confirmation":
                continue
            cells = set(product(claim.rows, table.confirm))
            for cell in cells & judged.runs.keys():  # a claim covers the rows that were run
                (run,) = judged.runs[cell].results
                found.append((path, table, claim.claim, run))
    return found


def undeclared(root: Path, path: Path, table: Table, claim: Claim, run: RunResult) -> str:
    """Why a run does not confirm a claim, or "": the commit that made it declared both."""
    first = run.provenance[0]
    commit = str(first.get("git_commit"))
    if first.get("git_dirty") is not False:
        return f"{run.key} was made by changed files"
    before = _table_at(root, commit, path.relative_to(root).as_posix())
    if before is None:
        return f"{run.key}: commit {commit[:8]} has no such table"
    if before.confirm != table.confirm:
        return f"{run.key}: commit {commit[:8]} declares the seeds {before.confirm}"
    if _without_words(claim) not in [
        _without_words(other) for other in before.claims if not other.exploratory
    ]:
        return f"{run.key}: commit {commit[:8]} does not declare '{claim.name}'"
    return ""


def _without_words(claim: Claim) -> Claim:
    """A claim without its words."""
    return replace(claim, says="", source="", remarks=())


@lru_cache
def _table_at(root: Path, commit: str, path: str) -> Table | None:
    command = ["git", "-C", str(root), "show", f"{commit}:{path}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        return None
    try:
        table: Table = check_value(path, yaml.safe_load(done.stdout), Table)
    except InputError:
        return None
    return table


def has_history(root: Path) -> bool:
    """Whether the commits that made the runs of the archive can be read."""
    command = ["git", "-C", str(root), "rev-parse", "--is-shallow-repository"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.returncode == 0 and done.stdout.strip() == "false"
