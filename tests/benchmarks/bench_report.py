"""The report of 60 runs, 25 tables and 2 studies: its size, and how long a browser opens it.

Chromium opens the pages in turns, each time with a fresh profile. Times are the browser's own, from
the start of the navigation: until the document is parsed and can be used (DOMContentLoaded), and
until the first frame with it is painted; charts follow one by one. The page of an empty store shows
how much of it is the browser.

Run: python -m tests.benchmarks.bench_report
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from analysis.report.page import page_text
from tests.analysis.report import pages

ROUNDS = 5
SIZE_MB = 5.0
SECONDS = 2.0
PROBE = """
addEventListener("load", () => requestAnimationFrame(() => requestAnimationFrame(() => {
  const timing = performance.getEntriesByType("navigation")[0];
  const nodes = document.querySelectorAll("*").length;
  console.log(`probe ${timing.domContentLoadedEventEnd} ${performance.now()} ${nodes}`);
})));
"""


def opened(chromium: str, file: Path) -> tuple[float, float, int]:
    """Milliseconds to DOMContentLoaded and to the first frame; number of elements."""
    with tempfile.TemporaryDirectory() as profile:
        done = subprocess.run(
            [
                *(chromium, "--headless=new", "--no-sandbox", "--disable-gpu"),
                *("--enable-logging=stderr", "--v=0", f"--user-data-dir={profile}"),
                *("--window-size=1280,900", f"--screenshot={profile}/page.png", file.as_uri()),
            ],
            capture_output=True,
            text=True,
            check=True,
        )
    found = re.search(r"probe ([\d.]+) ([\d.]+) (\d+)", done.stderr)
    assert found is not None, done.stderr
    return float(found[1]), float(found[2]), int(found[3])


def probed(text: str, file: Path) -> Path:
    """A copy of the page that says when it was drawn; its own policy would refuse the probe."""
    text = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", text)
    head, _, tail = text.rpartition("</body>")
    file.write_text(f"{head}<script>{PROBE}</script></body>{tail}")
    return file


def main() -> int:
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        print("no chromium on the PATH: nothing measured")
        return 1
    stores = {"60 runs": pages.report(), "empty store": pages.report(num_rows=0)}
    start = time.perf_counter()
    texts = {name: page_text(data) for name, data in stores.items()}
    built = time.perf_counter() - start
    times: dict[str, list[tuple[float, float, int]]] = {name: [] for name in texts}
    with tempfile.TemporaryDirectory() as folder:
        files = {n: probed(t, Path(folder) / f"{n[:2]}.html") for n, t in texts.items()}
        for _ in range(ROUNDS):
            for name, file in files.items():
                times[name].append(opened(chromium, file))
    print(f"both pages written in {built:.2f} s; medians of {ROUNDS} openings")
    print("page         size, MB  elements  DOMContentLoaded, ms  first frame, ms")
    for name, measured in times.items():
        parsed, painted, _ = (median(column) for column in zip(*measured, strict=True))
        size = len(texts[name].encode()) / 1e6
        print(f"{name:12s} {size:8.2f} {measured[0][2]:9d} {parsed:21.0f} {painted:16.0f}")
    size = len(texts["60 runs"].encode()) / 1e6
    worst = max(painted for _, painted, _ in times["60 runs"]) / 1e3
    print(f"60 runs: {size:.2f} MB (wanted < {SIZE_MB:.0f}), slowest opening {worst:.2f} s (< 2)")
    return 0 if size < SIZE_MB and worst < SECONDS else 1


if __name__ == "__main__":
    sys.exit(main())
