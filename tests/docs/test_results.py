"""The pages of results and the marked numbers are those of the archive: run `make results`."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sweeps.show.pages import Report

pytestmark = pytest.mark.docs

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"


@pytest.mark.slow
def test_pages_figures_and_marked_numbers_follow_from_the_archive(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(ROOT)
    report = Report(Path("none"), Path("results"), 2000, counted=True)
    made = {RESULTS / name: text for name, text in report.pages().items()}
    marked = re.search(r"^MARKED := (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert marked is not None
    for name in marked[1].split(","):
        made[ROOT / name] = report.filled((ROOT / name).read_text())
    differing = [str(path) for path, text in made.items() if path.read_text() != text]
    images = {RESULTS / name: content for name, content in report.images.items()}
    assert set(RESULTS.glob("*.svg")) == set(images)
    differing += [str(path) for path, content in images.items() if path.read_bytes() != content]
    assert differing == [], "make results"
