"""The built site: its pages fit a telephone, its search finds what people look for.

Chromium opens every page in a frame of 390 pixels; without Chromium these tests are skipped.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from queue import Queue
from typing import Any

import pytest

from tests.docs.pages import ROOT

pytestmark = [pytest.mark.docs, pytest.mark.slow]

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
WIDTH, SCREEN = 390, (1280, 800)
SECONDS = 600

SOUGHT = {
    "own data": "/tutorials/own-data-set.html",
    "SLURM": "/how-to/cluster-and-slurm.html",
    "ONNX": "/how-to/export-a-network.html",
    "missing thermal": "/how-to/measure-robustness.html",
    "uninstall": "/how-to/keep-results.html",
}
"""Words, and the page that the search should find among its first three."""

PROBE = """<!doctype html><iframe id="frame"></iframe><script>
const [jobs, found] = [JOBS, {}];
const frame = document.getElementById("frame");
const ask = async job => {
  [frame.width, frame.height] = job.size;
  await new Promise(done => { frame.onload = done; frame.src = job.page; });
  const view = frame.contentWindow, root = frame.contentDocument.documentElement;
  return await eval(job.script)(view, root);
};
(async () => {
  for (const job of jobs) found[job.name] = await ask(job);
  await fetch("found", {method: "POST", body: JSON.stringify(found)});
})();
</script>"""

OVERFLOW = """(view, root) => {
  if (root.scrollWidth <= root.clientWidth) return "";
  const within = box => box && box !== root && box !== view.document.body
    && (view.getComputedStyle(box).overflowX !== "visible" || within(box.parentElement));
  const wide = [...root.querySelectorAll("body *")].find(box =>
    box.getBoundingClientRect().right > root.clientWidth + 1 && !within(box.parentElement));
  return `${root.scrollWidth} px: ${wide ? wide.outerHTML.slice(0, 120) : "?"}`;
}"""
"""How wide the page is and its first box that is too wide; "": it does not scroll."""

BOTTOM = """(view, root) => Math.max(...[...root.querySelectorAll("article > *")].map(
  box => box.getBoundingClientRect().bottom + view.scrollY))"""

RESULTS = """async (view, root) => {
  for (let n = 0; n < 600; n++) {
    const items = [...root.querySelectorAll(".md-search-result__item")];
    if (items.length) return items.map(item => new URL(item.querySelector("a").href).pathname);
    await new Promise(done => setTimeout(done, 100));
  }
  return [];
}"""
"""Pages that the search finds, best first."""


class Handler(SimpleHTTPRequestHandler):
    """Serves the site, and takes what the page of the probe found."""

    def do_GET(self) -> None:
        if self.path.startswith("/search/") and "?q=" not in self.headers["Referer"]:
            self.send_error(404)  # each page would read the index
        else:
            super().do_GET()

    def do_POST(self) -> None:
        found = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.found.put(json.loads(found))  # type: ignore[attr-defined]
        self.send_response(204)
        self.end_headers()

    def log_message(self, *_: Any) -> None:
        """Nothing."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the built site."""
    folder = tmp_path_factory.mktemp("site")
    words = ["mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    subprocess.run([ROOT / ".venv/bin/python", "-m", *words], cwd=ROOT, check=True)
    return folder


def seen(site: Path, jobs: list[dict[str, Any]]) -> dict[str, Any]:
    """What the script of each job returns for its page, by the name of the job."""
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed")
    (site / "probe.html").write_text(PROBE.replace("JOBS", json.dumps(jobs)))
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(site)))
    server.found = Queue()  # type: ignore[attr-defined]
    threading.Thread(target=server.serve_forever, daemon=True).start()
    address = f"http://127.0.0.1:{server.server_port}/probe.html"
    words = ["--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0", address]
    browser = subprocess.Popen([CHROMIUM, *words], stderr=subprocess.DEVNULL)
    try:
        result: dict[str, Any] = server.found.get(timeout=SECONDS)  # type: ignore[attr-defined]
    finally:
        browser.terminate()
        browser.wait()
        server.shutdown()
        (site / "probe.html").unlink()
    return result


def test_no_page_scrolls_sideways_on_a_telephone(site: Path) -> None:
    names = sorted(str(path.relative_to(site)) for path in site.rglob("*.html"))
    jobs = [{"name": n, "page": n, "size": [WIDTH, 844], "script": OVERFLOW} for n in names]
    wide = {name: why for name, why in seen(site, jobs).items() if why}
    assert len(names) > 50
    assert not wide, "\n".join(f"{name}: {why}" for name, why in wide.items())


def test_a_wide_table_without_a_box_of_its_own_is_found(tmp_path: Path) -> None:
    table = "<table><tr>" + "<td>of the widest columns</td>" * 20 + "</tr></table>"
    for name, box in (("bare", "<div>"), ("boxed", '<div style="overflow-x: auto">')):
        (tmp_path / name).write_text(f"<!doctype html><main>{box}{table}</div></main>")
        (tmp_path / name).rename(tmp_path / f"{name}.html")
    jobs = [
        {"name": name, "page": f"{name}.html", "size": [WIDTH, 844], "script": OVERFLOW}
        for name in ("bare", "boxed")
    ]
    found = seen(tmp_path, jobs)
    assert "<table>" in found["bare"]
    assert found["boxed"] == ""


def test_home_page_fits_a_screen(site: Path) -> None:
    job = {"name": "home", "page": "index.html", "size": [*SCREEN], "script": BOTTOM}
    assert seen(site, [job])["home"] <= SCREEN[1]


def test_search_finds_what_people_look_for(site: Path) -> None:
    jobs = [
        {"name": words, "page": f"index.html?q={words}", "size": [*SCREEN], "script": RESULTS}
        for words in SOUGHT
    ]
    found = seen(site, jobs)
    missed = {words: found[words][:3] for words in SOUGHT if SOUGHT[words] not in found[words][:3]}
    assert not missed


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
