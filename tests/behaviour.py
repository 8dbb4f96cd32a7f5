"""Recorded numbers of every experiment: a change of structure must not change any of them.

``python -m tests.behaviour record FILE.json`` writes for every file of ``conf/experiment/`` the
composed configuration and the run key at three settings, and trains ten steps at smoke size: losses
as exact hexadecimal floats, counts as digests. ``python -m tests.behaviour compare A.json B.json``
prints one line per experiment and exits with 1 if anything differs. ``tests/behaviour.json`` is the
recording of the repository; write it again where a change is meant to alter behaviour.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import platform
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any
from unittest.mock import patch

# Waiting threads leave the cores to other processes; the results are the same.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
RECORDED = Path(__file__).with_suffix(".json")
EXPERIMENTS = sorted(path.stem for path in (ROOT / "conf/experiment").glob("*.yaml"))

SETTINGS = {
    "smoke": ["+debug=smoke"],
    "demo": [],
    "paper": ["scale=paper", "dataset.root=x"],
}
"""Overrides at which configurations and keys are recorded."""

SETTINGS_OF_STARTS = {"smoke": ["+debug=smoke"], "bench": ["scale=bench"]}
"""The same of the common starts. Their data sets are embedded: none has a form at paper scale."""

TEN_STEPS = [
    *("+debug=smoke", "trainer.max_steps=10", "trainer.log_every=1", "trainer.eval_every=10"),
    *("trainer.checkpoint_every=10", "trainer.accelerator=cpu", "trainer.threads=2"),
    "tracking=none",
]
"""Overrides of the runs that are recorded. Upstream runs get the same number of steps."""

PATHS = ("runs_dir", "tracking", "dataset.root", "dataset.cache_dir")
"""What is left out of configurations: where things lie."""

NAMING = ("vendor_id", "cpu family", "model", "stepping", "CPU implementer", "CPU part")
"""Entries of /proc/cpuinfo that tell kinds of processors apart; x86 has the first, ARM the last."""

MEASURED = ("images_per_s", "wait_share", "peak_memory_mib")
"""Logged values that are measured of the machine."""

REL_TOL, ABS_TOL = 1e-4, 1e-6
"""Of first losses on another kind of machine. Later losses differ more: one thread in place of two
moves the tenth by up to 4%."""


# The adapter: the only lines that name modules of the product.


def compose(overrides: Sequence[str]) -> dict[str, Any]:
    """The composed, checked and resolved configuration of these overrides."""
    from tests.composed import specified

    return dict(specified(tuple(overrides)).plain)


def key(overrides: Sequence[str]) -> str:
    """The run key of these overrides."""
    from tests.composed import specified

    return specified(tuple(overrides)).key


def run(overrides: Sequence[str]) -> None:
    """``python -m rgbt.run`` with these overrides, in this process."""
    from rgbt.run import main

    said = io.StringIO()
    try:
        with patch("sys.argv", ["rgbt", *overrides]), redirect_stderr(said), redirect_stdout(said):
            main()
    except SystemExit as end:
        if end.code:
            raise RuntimeError(f"{overrides} ended with {end.code}:\n{said.getvalue()}") from end


# Recording.


def record(runs_dir: Path) -> dict[str, Any]:
    """Record every experiment, with one line each on stderr.

    Args:
        runs_dir: empty folder for the runs; an upstream run of several experiments is trained once.
    """
    experiments = {}
    for number, name in enumerate(EXPERIMENTS, 1):
        started = time.monotonic()
        experiments[name] = {
            "compositions": {setting: composition(name, setting) for setting in settings_of(name)},
            "training": training(name, runs_dir),
        }
        seconds = time.monotonic() - started
        print(f"{number:2}/{len(EXPERIMENTS)} {name:38} {seconds:5.1f} s", file=sys.stderr)
    return {"machine": machine(), "experiments": experiments}


def machine() -> dict[str, str]:
    """What must agree for two runs to agree bit for bit."""
    listed = Path("/proc/cpuinfo")
    return {
        "torch": torch.__version__,
        "cpu": torch.backends.cpu.get_cpu_capability(),
        "processor": processor(listed.read_text()) if listed.is_file() else platform.processor(),
        "platform": f"{platform.system()} {platform.machine()}",
    }


def processor(cpuinfo: str) -> str:
    """Family, model, stepping and a digest of the flags of the first processor that Linux lists.

    Machines whose processors have one name and capability differ in these, and then in the last
    bits of Mask2Former and CMX.
    """
    lines = (line.partition(":") for line in cpuinfo.partition("\n\n")[0].splitlines())
    found = {key.strip(): value.strip() for key, _, value in lines}
    flags = found.get("flags", found.get("Features", ""))
    return " ".join([*(found.get(key, "-") for key in NAMING), digest(flags.encode())])


def settings_of(experiment: str) -> dict[str, list[str]]:
    """Name of each setting at which an experiment is recorded -> its overrides."""
    return SETTINGS_OF_STARTS if experiment.startswith("start_") else SETTINGS


def composition(experiment: str, setting: str) -> dict[str, Any]:
    """Run key and digests of the nodes of a configuration."""
    overrides = [f"+experiment={experiment}", *settings_of(experiment)[setting]]
    config = compose(overrides)
    nodes = {}
    for name, node in config.items():
        if isinstance(node, dict):
            node = {each: node[each] for each in node if f"{name}.{each}" not in PATHS}
        if name not in PATHS:
            nodes[name] = digest(json.dumps(node, sort_keys=True).encode())
    return {"key": key(overrides), "nodes": nodes}


def training(experiment: str, runs_dir: Path) -> dict[str, Any]:
    """Run key, logged values by name and digests of counts of a run of ten steps."""
    overrides = [f"+experiment={experiment}", *TEN_STEPS, f"runs_dir={runs_dir}"]
    run(overrides)
    name = key(overrides)
    folder = runs_dir / name
    logged: dict[str, list[str]] = {}
    for line in map(json.loads, (folder / "metrics.jsonl").read_text().splitlines()):
        for part, value in line["values"].items() if line["kind"] == "train" else ():
            if part not in MEASURED:
                logged.setdefault(part, []).append(float(value).hex())
    archives = sorted(folder.rglob("*.npz"))
    counts = {path.relative_to(folder).as_posix(): archive_digest(path) for path in archives}
    return {"key": name, "steps": logged, "counts": counts}


def archive_digest(path: Path) -> str:
    """Digest of the arrays of a ``.npz`` file; the file itself holds the time it was written."""
    with np.load(path) as arrays:
        parts = [
            part
            for name in sorted(arrays)
            for part in (
                f"{name} {arrays[name].dtype} {arrays[name].shape}",
                arrays[name].tobytes(),
            )
        ]
    return digest(b"\0".join(part.encode() if isinstance(part, str) else part for part in parts))


def digest(content: bytes) -> str:
    """The first 16 hexadecimal digits of SHA-256."""
    return hashlib.sha256(content).hexdigest()[:16]


def written(value: Any, depth: int = 4) -> str:
    """JSON with one line per entry down to a depth, and compact below it."""
    if not depth or not isinstance(value, dict):
        return json.dumps(value)
    entries = (f"{json.dumps(name)}: {written(each, depth - 1)}" for name, each in value.items())
    return "{\n" + ",\n".join(entries) + "\n}"


# Comparison.


def differences(old: dict[str, Any], new: dict[str, Any], is_exact: bool) -> Iterator[str]:
    """What differs between two records of an experiment, as short sentences."""
    for setting, before in old["compositions"].items():
        yield from composition_differences(setting, before, new["compositions"][setting])
    yield from training_differences(old["training"], new["training"], is_exact)


def composition_differences(
    setting: str, old: dict[str, Any], new: dict[str, Any]
) -> Iterator[str]:
    """What differs between two results of `composition`."""
    if old["key"] != new["key"]:
        yield f"{setting}: key {old['key']} became {new['key']}"
    for node in sorted(old["nodes"].keys() | new["nodes"].keys()):
        if old["nodes"].get(node) != new["nodes"].get(node):
            yield f"{setting}: configuration of {node} differs"


def training_differences(old: dict[str, Any], new: dict[str, Any], is_exact: bool) -> Iterator[str]:
    """What differs between two results of `training`.

    Args:
        is_exact: False compares the first value of every loss with a tolerance, and no counts.
    """
    if old["key"] != new["key"]:
        yield f"ten steps: key {old['key']} became {new['key']}"
    for part in sorted(old["steps"].keys() | new["steps"].keys()):
        before, after = old["steps"].get(part, []), new["steps"].get(part, [])
        if len(before) != len(after):
            yield f"{part} was logged {len(before)} times, now {len(after)} times"
            continue
        for number, pair in enumerate(zip(before, after, strict=True), 1):
            if pair[0] != pair[1] and (is_exact or not is_rounding(part, number, *pair)):
                first, other = map(float.fromhex, pair)
                yield f"{part} differs from value {number}: {first:.9g} became {other:.9g}"
                break
    for name in sorted(old["counts"].keys() | new["counts"].keys()):
        before, after = old["counts"].get(name), new["counts"].get(name)
        if before != after and (is_exact or None in (before, after)):
            yield f"{name} differs"


def is_rounding(part: str, number: int, old: str, new: str) -> bool:
    """Whether two kinds of machine may differ so in a logged value, counted from 1."""
    if number > 1 or not part.startswith("loss"):
        return True
    first, other = float.fromhex(old), float.fromhex(new)
    return math.isclose(first, other, rel_tol=REL_TOL, abs_tol=ABS_TOL)


def compare(old: dict[str, Any], new: dict[str, Any]) -> int:
    """Print one line per experiment; the number of experiments that differ."""
    is_exact = old["machine"] == new["machine"]
    if not is_exact:
        print(f"Two kinds of machine: {old['machine']}, {new['machine']}.")
        print(f"First losses are compared within {REL_TOL:g}, later ones and counts are not.")
    differing = 0
    for name in sorted(old["experiments"].keys() | new["experiments"].keys()):
        if not (name in old["experiments"] and name in new["experiments"]):
            found = ["only in one of the recordings"]
        else:
            pair = old["experiments"][name], new["experiments"][name]
            found = list(differences(*pair, is_exact))
        more = f" (and {len(found) - 3} more)" if len(found) > 3 else ""
        print(f"{name:38} {'; '.join(found[:3]) or 'same'}{more}")
        differing += bool(found)
    print(f"{differing} of {len(old['experiments'])} experiments differ.")
    return differing


def main(arguments: Sequence[str]) -> int:
    """Exit code of ``record FILE`` and ``compare FILE FILE``."""
    match arguments:
        case ["record", file]:
            started = time.monotonic()
            with tempfile.TemporaryDirectory() as folder:
                recording = record(Path(folder))
            Path(file).write_text(written(recording) + "\n")
            print(f"{file}: {time.monotonic() - started:.0f} s", file=sys.stderr)
            return 0
        case ["compare", old, new]:
            return int(compare(*(json.loads(Path(file).read_text()) for file in (old, new))) > 0)
    print(__doc__, file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
