"""Recorded numbers of every experiment: a change of structure must not change any of them.

``python -m tests.behaviour record FILE.json`` trains ten steps of every experiment at smoke size
and writes losses as exact hexadecimal floats and counts as digests. ``compare A.json B.json``
prints one line per experiment and exits with 1 if anything differs. ``tests/behaviour.json`` is
the recording of the repository; write it again where a change is meant to alter behaviour. An
experiment that was recorded later, on another machine, names that machine.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any
from unittest.mock import patch

# Waiting threads leave the cores to other processes; the results are the same.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import pytest
import torch

from rgbt.metrics.counts import Counts

ROOT = Path(__file__).resolve().parents[1]
RECORDED = Path(__file__).with_suffix(".json")
EXPERIMENTS = sorted(path.stem for path in (ROOT / "conf/experiment").glob("*.yaml"))

TEN_STEPS = [
    *("+debug=smoke", "trainer.max_steps=10", "trainer.log_every=1", "trainer.eval_every=10"),
    *("trainer.checkpoint_minutes=1", "trainer.accelerator=cpu", "trainer.threads=1"),
    "tracking=none",
]
"""Overrides of the runs that are recorded. Upstream runs get the same number of steps."""

NAMING = ("vendor_id", "cpu family", "model", "stepping", "CPU implementer", "CPU part")
MEASURED = ("images_per_s", "wait_share", "peak_memory_mib", "seconds_left")
COUNTED = ("absent", "classes", "counts", "dataset", "names", "partition", "split")
FIRST = (1e-4, 1e-6)
"""Relative and absolute tolerance of first losses on another kind of machine; later ones differ by
up to 4%."""

UPSTREAM = (0.1, 0.01)
"""Likewise of experiments whose first loss follows ten steps of an upstream run."""


def record(runs_dir: Path) -> dict[str, Any]:
    """Record every experiment; an upstream run of several is trained once, in `runs_dir`."""
    found = {name: training(name, runs_dir) for name in EXPERIMENTS}
    return {"machine": machine(), "experiments": found}


def training(experiment: str, runs_dir: Path) -> dict[str, Any]:
    """Logged values by name, and digests of counts, of a run of ten steps.

    Its folder is removed: all experiments fill 2 GB. Those of upstream runs stay for the next ones.
    """
    from rgbt.run import main
    from tests.commands import logged, without_pictures
    from tests.composed import specified

    words = [f"+experiment={experiment}", *TEN_STEPS, f"runs_dir={runs_dir}"]
    said = io.StringIO()
    with (
        patch("sys.argv", ["rgbt", *words]),
        redirect_stderr(said),
        redirect_stdout(said),
        without_pictures(),
        pytest.raises(SystemExit) as left,
    ):
        main()
    assert not left.value.code, said.getvalue()
    folder = specified(tuple(words)).folder
    steps: dict[str, list[str]] = {}
    for line in logged(folder, "train"):
        for part in [each for each in line["values"] if each not in MEASURED]:
            steps.setdefault(part, []).append(float(line["values"][part]).hex())
    archives = sorted(folder.rglob("*.npz"))
    counts = {path.relative_to(folder).as_posix(): archive_digest(path) for path in archives}
    shutil.rmtree(folder)
    return {"steps": steps, "counts": counts}


def machine() -> dict[str, str]:
    """What must agree for two runs to agree bit for bit."""
    listed = Path("/proc/cpuinfo")
    first = listed.read_text().partition("\n\n")[0] if listed.is_file() else ""
    found = dict(re.findall(r"^(.*?)\s*: ?(.*?)\s*$", first, re.M))
    flags = found.get("flags", found.get("Features", ""))
    return {
        "torch": torch.__version__,
        "cpu": torch.backends.cpu.get_cpu_capability(),
        "processor": " ".join([*(found.get(each, "-") for each in NAMING), digest(flags.encode())]),
        "platform": f"{platform.system()} {platform.machine()}",
    }


def archive_digest(path: Path) -> str:
    """Digest of what was counted; the file itself holds the time it was written, and the run."""
    counts = Counts.load(path)
    arrays: dict[str, Any] = {key: getattr(counts, key) for key in COUNTED}
    arrays["night"] = np.array(counts.night or (), bool)
    arrays["unscored"] = np.array(counts.unscored, str)
    parts = []
    for name, value in sorted(arrays.items()):
        array = np.asanyarray(value)
        parts.append(f"{name} {array.dtype} {array.shape}\0".encode() + array.tobytes())
    return digest(b"\0".join(parts))


def digest(content: bytes) -> str:
    """The first 16 hexadecimal digits of SHA-256."""
    return hashlib.sha256(content).hexdigest()[:16]


def written(value: Any, depth: int = 4) -> str:
    """JSON with one line per entry down to a depth, and compact below it."""
    if not depth or not isinstance(value, dict):
        return json.dumps(value)
    entries = (f"{json.dumps(name)}: {written(each, depth - 1)}" for name, each in value.items())
    return "{\n" + ",\n".join(entries) + "\n}"


def tolerance(experiment: str) -> tuple[float, float]:
    """`FIRST` or `UPSTREAM`."""
    from tests.composed import specified

    return UPSTREAM if specified((f"+experiment={experiment}",)).upstream else FIRST


def differences(
    old: dict[str, Any],
    new: dict[str, Any],
    is_exact: bool,
    first_within: tuple[float, float] = FIRST,
) -> Iterator[str]:
    """What differs between two results of `training`.

    Args:
        is_exact: False compares the first value of every loss with a tolerance, and no counts.
        first_within: see `tolerance`.
    """
    for part in sorted(old["steps"].keys() | new["steps"].keys()):
        one, other = (each["steps"].get(part, []) for each in (old, new))
        is_same = one == other
        if not is_exact and len(one) == len(other):
            first = float.fromhex(one[0]), float.fromhex(other[0])
            rel_tol, abs_tol = first_within
            is_close = math.isclose(*first, rel_tol=rel_tol, abs_tol=abs_tol)
            is_same = is_close or not part.startswith("loss")
        if not is_same:
            yield f"{part}: {one} became {other}"
    for name in sorted(old["counts"].keys() | new["counts"].keys()):
        counts = old["counts"].get(name), new["counts"].get(name)
        if counts[0] != counts[1] and (is_exact or None in counts):
            yield f"{name} differs"


def compare(old: dict[str, Any], new: dict[str, Any]) -> int:
    """Print one line per experiment; the number of experiments that differ."""
    is_exact = old["machine"] == new["machine"]
    if not is_exact:
        print(
            f"Another kind of machine: first losses are compared within {FIRST[0]:g} "
            f"({UPSTREAM[0]:g} behind an upstream run), no counts."
        )
    differing = 0
    nothing: dict[str, Any] = {"steps": {}, "counts": {}}
    for name in sorted(old["experiments"].keys() | new["experiments"].keys()):
        pair = (each["experiments"].get(name, nothing) for each in (old, new))
        found = list(differences(*pair, is_exact, tolerance(name)))
        print(f"{name:38} {'; '.join(found[:3]) or 'same'}")
        differing += bool(found)
    return differing


def main(arguments: list[str]) -> int:
    """Exit code of ``record FILE`` and ``compare FILE FILE``."""
    match arguments:
        case ["record", file]:
            with tempfile.TemporaryDirectory() as folder:
                Path(file).write_text(written(record(Path(folder))) + "\n")
            return 0
        case ["compare", old, new]:
            return int(compare(*(json.loads(Path(file).read_text()) for file in (old, new))) > 0)
    print(__doc__, file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
