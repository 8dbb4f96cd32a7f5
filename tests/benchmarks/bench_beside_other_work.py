"""Wall seconds of commands alone and beside busy processes, by how OpenMP's threads wait.

Every figure is of real commands in processes of their own: the median step of ``rgbt run``, and
``rgbt evaluate`` and ``rgbt predict`` of 100 images. A busy process is a loop of Python. Beside one
to `cores` of them, each of which gets its share, the least possible ratio is
(busy + threads) / cores.

Run: python -m tests.benchmarks.bench_beside_other_work [NAME=VALUE[,NAME=VALUE] ...]

Each word is a set of environment variables to measure; without words, those in `SETTINGS`.
"""

from __future__ import annotations

import json
import math
import os
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

STEPS, SKIPPED, BATCH = 24, 4, 4
LIMIT_S = 90.0
"""Longest time of a command; it is ended then, and the table has "inf"."""

RUN = (
    *("run", "+experiment=grbm", "tracking=none", "trainer.log_every=1"),
    *(f"trainer.max_steps={STEPS}", "trainer.eval_every=1000", "trainer.tested=last"),
)
WAITING = ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY", "KMP_BLOCKTIME")

SETTINGS: dict[str, dict[str, str]] = {
    "rgbt": {},
    "libgomp's default": {"GOMP_SPINCOUNT": "300000"},
    "passive": {"OMP_WAIT_POLICY": "PASSIVE"},
}
BUSY = ("alone", "beside one", "beside two")

Environment = Mapping[str, str]


@contextmanager
def busy(number: int) -> Iterator[None]:
    """So many processes that compute all the time."""
    started = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(number)]
    try:
        yield
    finally:
        for each in started:
            each.kill()
            each.wait()


def environment(setting: Environment) -> dict[str, str]:
    """Of a command: that of this process with one setting of how threads wait."""
    kept = {name: value for name, value in os.environ.items() if name not in WAITING}
    return {**kept, "MLFLOW_DISABLE_TELEMETRY": "true", **setting}


def start(words: Sequence[str], setting: Environment) -> subprocess.Popen[bytes]:
    """``rgbt`` with these words, which writes nothing."""
    nothing = subprocess.DEVNULL
    command = [sys.executable, "-m", "rgbt", *words]
    return subprocess.Popen(
        command, env=environment(setting), stdout=nothing, stderr=nothing, start_new_session=True
    )


def wall(commands: Sequence[Sequence[str]], setting: Environment) -> float:
    """Seconds until these commands, started at once, have all ended; inf where they take too long.

    Raises:
        RuntimeError: a command failed.
    """
    began = time.monotonic()
    started = [start(words, setting) for words in commands]
    for each, words in zip(started, commands, strict=True):
        try:
            if each.wait(LIMIT_S):
                raise RuntimeError(f"rgbt {' '.join(words)} ended with exit code {each.returncode}")
        except subprocess.TimeoutExpired:
            kill(started)
            return math.inf
    return time.monotonic() - began


def kill(started: Sequence[subprocess.Popen[bytes]]) -> None:
    """End commands with the processes that they have started."""
    for each in started:
        with suppress(ProcessLookupError):  # it has ended
            os.killpg(each.pid, signal.SIGKILL)
        each.wait()


def step_seconds(runs: Path) -> float:
    """Median of the steps of the one run in a folder, without the first ones; inf without more."""
    (log,) = runs.glob("*/metrics.jsonl")
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    speeds = [line["values"]["images_per_s"] for line in lines if line["kind"] == "train"]
    later = speeds[SKIPPED:]
    return BATCH / statistics.median(later) if later else math.inf


def measure(folder: Path, setting: Environment, number: int, trained: Path) -> dict[str, float]:
    """Figures of one setting beside so many busy processes, by name."""
    folder.mkdir()
    found = {}
    with busy(number):
        found["run"] = wall([(*RUN, f"runs_dir={folder}")], setting)
        found["step"] = step_seconds(folder)
        run = f"run={trained}"
        out = folder / "evaluated"
        found["evaluate"] = wall([("evaluate", run, f"out={out}")], setting)
        words = ("predict", run, "input=test", f"out={folder / 'predicted'}")
        found["predict"] = wall([words], setting)
        if not number:
            two = [(*RUN, f"runs_dir={folder}/{n}", f"seed={n}") for n in (1, 2)]
            found["two runs"] = wall(two, setting)
    return found


def table(found: Mapping[str, list[dict[str, float]]]) -> Iterator[str]:
    """The figures as Markdown: seconds, and how many times those alone."""
    yield f"| setting | figure | {' | '.join(BUSY)} |"
    yield "|---|---|" + "---|" * len(BUSY)
    for setting, columns in found.items():
        for name in columns[0]:
            alone = columns[0]["run" if name == "two runs" else name]
            cells = [
                f"{each[name]:.2f} ({each[name] / alone:.1f})" for each in columns if name in each
            ]
            yield f"| {setting} | {name} | {' | '.join(cells + [''] * (len(BUSY) - len(cells)))} |"


def main() -> None:
    settings = {
        word: dict(pair.split("=") for pair in word.split(",")) for word in sys.argv[1:]
    } or SETTINGS
    found: dict[str, list[dict[str, float]]] = {name: [] for name in settings}
    with TemporaryDirectory() as folder:
        root = Path(folder)
        wall([(*RUN, f"runs_dir={root}/trained")], SETTINGS["passive"])  # also makes the images
        (trained,) = (root / "trained").iterdir()
        for number in range(len(BUSY)):
            for index, (name, setting) in enumerate(settings.items()):
                found[name].append(measure(root / f"{index}-{number}", setting, number, trained))
                print(name, BUSY[number], found[name][-1], file=sys.stderr, flush=True)
    print(*table(found), sep="\n")


if __name__ == "__main__":
    main()
