"""`rgbt report` as a user calls it; the store itself is tested in test_collect."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from analysis.report import collect, page
from analysis.report.__main__ import entry
from analysis.report.data import ReportData
from rgbt.tracking.mlflow_store import MlflowTracking
from tests.commands import Call, assert_one_sentence

EMPTY = ReportData(
    title="t",
    made="",
    store="sqlite",
    command="",
    runs=(),
    tables=(),
    studies=(),
    masks=(),
    differences=(),
    remarks=tuple(f"Remark {number}." for number in range(7)),
)


@pytest.fixture
def collected(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Arguments of the collection; the store is not read and the page is one line."""
    told: list[Any] = []

    def fake(*wanted: Any) -> ReportData:
        *told[:], track = wanted
        assert list(track([1, 2], "something")) == [1, 2]
        return EMPTY

    def write(data: ReportData, out: Path) -> Path:
        (out / "index.html").write_text("page")
        return out / "index.html"

    monkeypatch.setattr(collect, "collect", fake)
    monkeypatch.setattr(page, "write_page", write)
    return told


def test_command_prints_path_and_content_of_the_page(
    call: Call, tmp_path: Path, collected: list[Any]
) -> None:
    out, runs = tmp_path / "new" / "report", tmp_path / "runs"
    uri = "tracking.uri=http://me:secret@host:5000"
    code, said, err = call(entry, f"out={out}", f"runs_dir={runs}", "resamples=300", uri)
    assert code == 0
    assert f"page   {out}/index.html" in said
    assert "holds  0 runs, 0 tables with runs, 0 published only, 0 studies" in said
    assert err.count("rgbt: Remark ") == 5
    assert "2 more remarks are on the page." in err
    tracking, *others, command, trust = collected
    assert isinstance(tracking, MlflowTracking)
    assert tracking.uri == "http://me:secret@host:5000"
    assert (others, trust) == ([runs, 300], ())
    assert command.startswith("rgbt report out=")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["resamples=many"], "'resamples'"),
        (["resamples=10"], "'resamples'"),
        (["tracking.url=x"], "'tracking.url'"),
        (["tracking=none"], "made from an MLflow store"),
        ([], "there is no MLflow store"),
    ],
)
def test_mistakes_are_one_sentence(
    call: Call, tmp_path: Path, words: list[str], sentence: str
) -> None:
    out = tmp_path / "report"
    code, _, err = call(entry, f"out={out}", f"runs_dir={tmp_path}", *words)
    assert code == 2
    assert sentence in err
    assert not out.exists()


def test_file_instead_of_the_folder_is_refused(call: Call, tmp_path: Path) -> None:
    (tmp_path / "report").write_text("")
    code, _, err = call(entry, f"out={tmp_path / 'report'}")
    assert code == 2
    assert_one_sentence(err, "is a file; choose a folder.")


@pytest.mark.slow
def test_help_does_not_wait_for_libraries() -> None:
    code = (
        "import sys; sys.argv = ['report', '--help']; import analysis.report.__main__ as m\n"
        "try: m.entry()\n"
        "except SystemExit: pass\n"
        "print({'torch', 'mlflow', 'matplotlib', 'pandas'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "usage: rgbt report [option=value ...]" in done.stdout
    assert done.stdout.strip().endswith("set()")
