"""A command for the steps of jobs: ``python -m tests.sweeps.steps WHAT FILE ...``."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path


def note(place: Path, text: str) -> None:
    """Write a file at once, for a reader that waits for it."""
    place.with_suffix(".new").write_text(text)
    place.with_suffix(".new").rename(place)


def facts() -> str:
    known = {
        "argv": sys.argv[1:],
        "command": sys.orig_argv[1:],
        "given": os.environ.get("GIVEN"),
        "folder": str(Path.cwd()),
        "gpus": os.environ.get("CUDA_VISIBLE_DEVICES"),
        "grandparent": Path(f"/proc/{os.getppid()}/stat").read_text().rpartition(")")[2].split()[1],
        "interrupt": signal.getsignal(signal.SIGINT) is signal.default_int_handler,
    }
    return json.dumps(known)


def tell(place: Path) -> None:
    note(place, facts())


def leave(place: Path, code: str, *words: str) -> None:
    print(*words, end="", file=sys.stderr, flush=True)  # half a line
    sys.exit(int(code))


def fail(place: Path) -> None:
    raise ValueError("a bad day")


def kill(place: Path, number: str) -> None:
    os.kill(os.getpid(), int(number))


def wait(place: Path, *ignored: str) -> None:
    """Until a file says that it may go on; with a child, and without these signals."""
    for number in ignored:
        signal.signal(int(number), signal.SIG_IGN)
    sleeper = subprocess.Popen(["sleep", "600"])
    note(place, f"{facts()}\n{os.getpid()} {sleeper.pid}")
    while not place.with_suffix(".go").exists():
        time.sleep(0.01)
    sleeper.kill()
    place.with_suffix(".done").touch()


def train(place: Path) -> None:
    """As a training: it holds the lock of its folder, and SIGTERM stops it."""
    from rgbt.files.atomic import holding

    with holding(place.parent / "lock") as holder:
        if holder is not None:
            sys.exit(f"rgbt: {holder} holds it.")
        with (place.parent / "steps").open("a") as file:
            file.write("begin\n")
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
        while not place.with_suffix(".go").exists():
            time.sleep(0.01)
        note(place.parent / "result.json", "{}")


if __name__ == "__main__":
    print("said", sys.argv[1], flush=True)
    globals()[sys.argv[1]](Path(sys.argv[2]), *sys.argv[3:])
