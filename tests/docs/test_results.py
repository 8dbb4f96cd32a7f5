"""The pages of results and the marked numbers are those of the archive: run `make results`.

And what they say is what the archive and the declarations of the tables allow.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from analysis.archive import _compared
from sweeps.show.claims import SIZES, statement
from sweeps.show.pages import MARKED, Report
from tests.declarations import confirming, has_history, undeclared

pytestmark = [pytest.mark.docs, pytest.mark.slow]

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"


@pytest.fixture(scope="module")
def report() -> Report:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        return Report(Path("none"), Path("results"), 2000, counted=True)


def filled_pages() -> list[Path]:
    """The pages written by hand with marked numbers."""
    marked = re.search(r"^MARKED := (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert marked is not None
    return [ROOT / name for name in marked[1].split(",")]


def test_pages_figures_and_marked_numbers_follow_from_the_archive(
    report: Report, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    made = {RESULTS / name: text for name, text in report.pages().items()}
    made |= {page: report.filled(page.read_text()) for page in filled_pages()}
    differing = [str(path) for path, text in made.items() if path.read_text() != text]
    images = {RESULTS / name: content for name, content in report.images.items()}
    assert set(RESULTS.glob("*.svg")) == set(images)
    differing += [str(path) for path, content in images.items() if path.read_bytes() != content]
    assert differing == [], "make results"


def test_confirming_runs_were_declared_before_they_were_made(report: Report) -> None:
    if not has_history(ROOT):
        pytest.skip("without the history of the repository")
    found = set()
    for path, table, claim, run in confirming(section.judged for section in report.tables):
        found.add(undeclared(ROOT, path, table, claim, run))
    assert found - {""} == set()


def test_archived_runs_are_undamaged_and_have_the_key_of_their_command() -> None:
    found = [(path.stem, state, why) for path, state, why, _ in _compared(ROOT / "results")]
    assert [one for one in found if one[1] != "same"] == [], "rgbt archive check"


def test_no_verdict_is_worded_as_of_a_paper_that_is_not_of_its_runs(report: Report) -> None:
    for _, row in report.every.iterrows():
        where = f"{row['table']} {row['claim']}"
        text = statement(row)
        of_paper = row["verdict"] in ("holds", "contradicted", "undecided")
        assert not of_paper or row["basis"] == "counted" or row["scale"] == "paper", where
        if row["verdict"] in ("same direction", "opposite direction"):
            assert f"on {row['images']}" in text, where
            assert row["basis"] == "confirmation" or "not confirmed" in text, where
            is_inside = round(row["low"], 2) <= row["printed"] <= round(row["high"], 2)
            assert is_inside or row["printed"] != row["printed"] or row["size"] in SIZES, where
            assert is_inside or row["size"] != "includes it", where
            assert not row["size"] or SIZES[row["size"]] in text, where


def test_quoted_claims_are_confirmed_or_said_not_to_be(report: Report) -> None:
    for page in filled_pages():
        for mark in MARKED.finditer(page.read_text()):
            kind, *names = mark[2].split()
            if kind != "claim":
                continue
            text = mark[0].removesuffix(mark[3])
            known = ("confirmation by", "not confirmed", "**Not run", "counted", "Not comparable")
            assert any(word in text for word in known), names
