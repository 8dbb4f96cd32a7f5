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
        "interrupt": signal.getsignal(signal.SIGINT) is signal.default_int_handler,
    }
    return json.dumps(known)


def do(what: str, place: Path, *words: str) -> None:
    print("said", what, flush=True)
    if what == "tell":
        note(place, facts())
    elif what == "leave":
        print(*words[1:], end="", file=sys.stderr, flush=True)  # half a line
        sys.exit(int(words[0]))
    elif what == "raise":
        raise ValueError("a bad day")
    elif what == "kill":
        os.kill(os.getpid(), int(words[0]))
    elif what == "wait":  # until there is a file of that name; words are signals to ignore
        for number in words:
            signal.signal(int(number), signal.SIG_IGN)
        sleeper = subprocess.Popen(["sleep", "600"])
        note(place, f"{facts()}\n{os.getpid()} {sleeper.pid}")
        while not place.with_suffix(".go").exists():
            time.sleep(0.01)
        sleeper.kill()
        place.with_suffix(".done").touch()
    elif what == "train":  # holds the lock of its folder, is stopped by SIGTERM, and then resumes
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
    do(sys.argv[1], Path(sys.argv[2]), *sys.argv[3:])
