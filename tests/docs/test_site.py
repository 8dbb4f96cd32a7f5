"""The built site: its pages fit a telephone, its search finds what people look for.

Chromium opens every page in a frame of 390 pixels; without Chromium these tests are skipped.
"""

from __future__ import annotations

import json
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
SECONDS = 240

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
  const inside = box => {
    for (let up = box.parentElement; up && up !== root; up = up.parentElement)
      if (up !== view.document.body && view.getComputedStyle(up).overflowX !== "visible")
        return true;
    return false;
  };
  if (root.scrollWidth <= root.clientWidth) return "";
  const wide = [...root.querySelectorAll("main *")].filter(box =>
    box.getBoundingClientRect().right > root.clientWidth + 1 && !inside(box));
  const first = wide[0];
  return `${root.scrollWidth} px: ${first ? first.outerHTML.slice(0, 120) : "?"}`;
}"""

BOTTOM = """(view, root) => {
  const last = root.querySelector("article > :last-child");
  return Math.max(...[...root.querySelectorAll("article > *")].map(
    box => box.getBoundingClientRect().bottom + view.scrollY));
}"""


class Handler(SimpleHTTPRequestHandler):
    """Serves the site, and takes what the page of the probe found."""

    def do_GET(self) -> None:
        if self.path.startswith("/search/"):  # each page would read it
            self.send_error(404)
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
