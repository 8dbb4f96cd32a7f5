"""The plan of tables: what they show of every row before the first run starts."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sweeps.plan.request import make_request
from sweeps.plan.table import PUBLISHED, STUDIES, table_names
from sweeps.point import Outcome, Point
from sweeps.reproduce import entry
from sweeps.show import preview
from sweeps.show.preview import MISSING, need_lines
from tests.commands import Call


def test_shared_upstream_runs_count_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two rows of 3 GB each and the teacher of both, 2 GB: 8 GB, and 3 while one is written."""
    sizes = {"a": 3e9, "b": 3e9, "teacher": 2e9}
    runs: dict[str, Any] = {}
    for key in sizes:
        runs[key] = SimpleNamespace(key=key, plain={}, pending=())
    for key in ("a", "b"):
        runs[key].pending = (runs["teacher"], runs[key])
    planner: Any = SimpleNamespace(
        composed=lambda point: runs[point.label], lacking=lambda point: {"data": "images"}
    )
    monkeypatch.setattr(preview, "checkpoint_bytes", lambda run: sizes[run.key])
    monkeypatch.setattr(preview, "expected_s", lambda run, known: {"a": 5400.0, "b": None}[run.key])
    monkeypatch.setattr(preview, "free_bytes", lambda folder: 10e9)
    outcomes = [Outcome(Point(key, (key,)), "waiting") for key in ("a", "b")]
    lines, table = need_lines([*outcomes, outcomes[0]], planner, tmp_path, 2).renderables
    assert str(lines).splitlines() == [
        "Time with workers=2: 45 min, without upstream runs and further evaluations; of 1 runs it "
        "is known after the first of their kind.",
        "Disk: 11.0 GB of checkpoints, one of them written twice at a time; 10.0 GB are free in "
        f"{tmp_path}.",
    ]
    assert table is not None
    assert "checkpoints need 11.0 GB" in capsys.readouterr().err


def test_a_table_that_lacks_all_is_planned(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows of Temporal have ResNets of two sizes, and each its file."""
    monkeypatch.chdir(tmp_path)
    words = ("table=temporal/table5", "rows=1", "scale=paper", "dry_run=true", "tracking=none")
    code, out, err = call(entry, *words)
    assert (code, err) == (0, "")
    assert list(tmp_path.iterdir()) == [], "nothing is written"
    # 185.24 M parameters: two copies of the weights, one momentum, of 4 bytes each.
    (row,) = [line.split() for line in out.splitlines() if "seed=0" in line]
    assert row[3:] == ["missing", "-", "2.2", "GB", "-", "data,", "weights"]
    assert "resnet50-0676ba61.pth" in out
    assert "resnet152" not in out
    assert "Time with workers=1: known after the first run." in out


@pytest.mark.slow
def test_every_row_of_all_tables_says_time_disk_and_what_is_missing(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = call(entry, "table=all", "scale=paper", "dry_run=true", "tracking=none")
    lines = out.splitlines()
    assert (code, max(map(len, lines))) == (0, 120)
    assert list(tmp_path.iterdir()) == [], "nothing is written"
    rows = [line for line in lines if "seed=0 " in line]
    requests = [make_request(name, "paper") for name in table_names(PUBLISHED, STUDIES)]
    assert len(table_names(PUBLISHED)) == 26
    wanted = {point.overrides for request in requests for point in request.points()}
    assert len(rows) == len(wanted), "rows of one run are one"
    for row in rows:
        assert not row.startswith("  seed=0"), "a label is one line"
        # A table, claims, no time before the first run; gigabytes; then what is missing.
        assert re.search(r"\d\.\d\d +- +(\d+\.\d GB|\d+ MB|-) ", row), row
        is_known = re.search(r"GB|MB", row) or "checkout" in row
        assert is_known, row
    assert "Time with workers=1: known after the first run." in out
    assert re.search(r"Disk: \d+\.\d GB of checkpoints", out)
    named = out.partition(MISSING)[2]
    for file in ("swin_small_patch4", "swin_tiny_patch4", "swin_base_patch4", "mit_b2", "mit_b4"):
        assert file in named
    for name in ("mfnet", "kp", "pst900", "freiburg"):
        assert f"dataset.root=FOLDER of {name}" in named
    assert "model.checkout=./DFormer" in named
    assert "0 failed, " in err
