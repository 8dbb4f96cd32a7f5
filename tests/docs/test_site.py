"""The built site: its pages fit a telephone, its search finds what people look for.

Chromium opens every page at a width of 390 pixels; without Chromium these tests are skipped.
"""

from __future__ import annotations

import re
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote

import pytest

from tests.browser import CHROMIUM, Page, open_page
from tests.docs.pages import ROOT

pytestmark = [pytest.mark.docs, pytest.mark.slow]

TELEPHONE, SCREEN = (390, 844), (1280, 800)
LOADED = "document.readyState === 'complete' && location.protocol !== 'about:'"

SOUGHT = {
    "own data": "/tutorials/own-data-set.html",
    "SLURM": "/how-to/cluster-and-slurm.html",
    "ONNX": "/how-to/export-a-network.html",
    "missing thermal": "/how-to/measure-robustness.html",
    "uninstall": "/how-to/keep-results.html",
}
"""Words, and the page that the search should find among its first three."""

OVERFLOW = """(root => {
  if (root.scrollWidth <= root.clientWidth) return "";
  const within = box => box && box !== root && box !== document.body
    && (getComputedStyle(box).overflowX !== "visible" || within(box.parentElement));
  const wide = [...root.querySelectorAll("body *")].find(box =>
    box.getBoundingClientRect().right > root.clientWidth + 1 && !within(box.parentElement));
  return `${root.scrollWidth} px: ${wide ? wide.outerHTML.slice(0, 120) : "?"}`;
})(document.documentElement)"""
"""How wide the page is and its first box that is too wide; "": it does not scroll."""

BOTTOM = """Math.max(...[...document.querySelectorAll("article > *")].map(
  box => box.getBoundingClientRect().bottom + scrollY))"""

RESULTS = """[...document.querySelectorAll(".md-search-result__item")].map(
  item => new URL(item.querySelector("a").href).pathname)"""
"""Pages that the search finds, best first."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the built site."""
    folder = tmp_path_factory.mktemp("site")
    words = ["mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    subprocess.run([ROOT / ".venv/bin/python", "-m", *words], cwd=ROOT, check=True)
    return folder


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Page]:
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed")
    with open_page(tmp_path / "profile") as page:
        yield page


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder on loopback, at the yielded address."""
    handler = partial(SimpleHTTPRequestHandler, directory=str(folder))
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()


def overflow(browser: Page, path: Path) -> str:
    browser.size(*TELEPHONE)
    browser.go(path.as_uri(), LOADED)
    return str(browser.value(OVERFLOW))


def test_no_page_scrolls_sideways_on_a_telephone(site: Path, browser: Page) -> None:
    paths = sorted(site.rglob("*.html"))
    wide = {path: why for path in paths if (why := overflow(browser, path))}
    assert len(paths) > 50
    assert not wide, "\n".join(f"{path.relative_to(site)}: {why}" for path, why in wide.items())


def test_a_wide_table_without_a_box_of_its_own_is_found(tmp_path: Path, browser: Page) -> None:
    table = "<table><tr>" + "<td>of the widest columns</td>" * 20 + "</tr></table>"
    found = []
    for box in ("<div>", '<div style="overflow-x: auto">'):
        (tmp_path / "page.html").write_text(f"<!doctype html><main>{box}{table}</div></main>")
        found.append(overflow(browser, tmp_path / "page.html"))
    assert "<table>" in found[0]
    assert found[1] == ""


def test_home_page_fits_a_screen(site: Path, browser: Page) -> None:
    browser.size(*SCREEN)
    browser.go((site / "index.html").as_uri(), LOADED)
    assert 0 < browser.value(BOTTOM) <= SCREEN[1]


def test_search_finds_what_people_look_for(site: Path, browser: Page) -> None:
    found = {}
    with served(site) as address:  # the index of the search is fetched
        for words in SOUGHT:
            browser.go(f"{address}/index.html?q={quote(words)}", f"({RESULTS}).length")
            found[words] = browser.value(RESULTS)[:3]
    assert not {words: found[words] for words in SOUGHT if SOUGHT[words] not in found[words]}


def test_numbers_of_the_home_page_are_those_of_the_readme() -> None:
    """Versions, times, sizes and counts; the words of commands and links are no numbers."""
    home, readme = (numbers(ROOT / name) for name in ("docs/index.md", "README.md"))
    assert home
    assert home <= readme


def numbers(path: Path) -> set[str]:
    """Numbers of a page, also those in words."""
    text = re.sub(r"\]\([^)]*\)|\{[^}]*\}|<!--.*?-->", " ", path.read_text())
    digits = set(re.findall(r"(?<![\w.+/=-])\d[\d,]*(?:\.\d+)*(?![\w=])", text))
    words = r"\b(two|three|four|five|six|seven|eight|nine|ten|fifteen)\b"
    return digits | set(re.findall(words, text.lower()))
