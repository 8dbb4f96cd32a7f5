"""CPU seconds that a command takes beside training: help, configuration, first step, evaluation.

Each command is a process of its own, with an MLflow store in SQLite that exists; user and system
time of it and of its children. The floor of a training is measured beside it: the import of torch,
and of what an optimizer of torch and Fabric import. Another checkout of this repository can be
measured in turns with this one.

Run: python -m tests.benchmarks.bench_start [folder of another checkout ...] [case=--help,...]
"""

from __future__ import annotations

import os
import resource
import shutil
import statistics
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

ROUNDS = 3
RUN = ("-m", "rgbt.run")
SMOKE = ("+experiment=grbm", "+debug=smoke", "dataset.num_test=100")

UNTIL_FIRST_STEP = """
import os, sys
from rgbt.runs.folder import RunFolder
append = RunFolder.append
def leave(*arguments):
    append(*arguments)
    os._exit(0)
RunFolder.append = leave
from rgbt.run import main
main()
"""

OPTIMIZER = (
    "import torch, lightning_fabric\ntorch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=0.1)"
)

Case = Callable[[Path], tuple[str, ...]]
"""Folder of runs -> arguments of Python."""


def smoke(runs: Path, *more: str) -> tuple[str, ...]:
    return (*SMOKE, f"runs_dir={runs}", *more)


def evaluate(runs: Path) -> tuple[str, ...]:
    """Of the 100 test images of the first run, not yet evaluated into this folder."""
    run = next(runs.glob("*/result.json")).parent
    return ("-m", "rgbt.evaluate", f"run={run}", f"out={runs / 'evaluated' / 'counts.npz'}")


CASES: dict[str, Case] = {
    "--help": lambda _: (*RUN, "--help"),
    "--cfg job": lambda _: (*RUN, "--cfg", "job", "+experiment=grbm"),
    "finished run": lambda runs: (*RUN, *smoke(runs)),
    "until the first step": lambda runs: ("-c", UNTIL_FIRST_STEP, *smoke(runs, "seed=1")),
    "evaluate 100 images": evaluate,
    "whole smoke run": lambda runs: (*RUN, *smoke(runs, "seed=2")),
    "import torch": lambda _: ("-c", "import torch"),
    "torch, Fabric, optimizer": lambda _: ("-c", OPTIMIZER),
    "import mlflow": lambda _: ("-c", "import mlflow"),
}


def cpu_seconds(words: tuple[str, ...], checkout: Path) -> float:
    """Of one process and its children.

    Raises:
        CalledProcessError: the command failed.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE", "MLFLOW_DISABLE_TELEMETRY": "true"}
    subprocess.run(
        [sys.executable, *words], cwd=checkout, env=environment, check=True, capture_output=True
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measure(checkouts: list[Path], folder: Path, names: list[str]) -> dict[str, list[float]]:
    """Case -> the median of each checkout; the checkouts take turns."""
    stores = [folder / str(number) for number in range(len(checkouts))]
    for checkout, runs in zip(checkouts, stores, strict=True):
        cpu_seconds(CASES["finished run"](runs), checkout)  # trains the run and makes the store
        cpu_seconds(CASES["finished run"](runs), checkout)
    found: dict[str, list[float]] = {}
    for name in names:
        case = CASES[name]
        times: list[list[float]] = [[] for _ in checkouts]
        for _ in range(ROUNDS):
            for each, checkout, runs in zip(times, checkouts, stores, strict=True):
                done = set(runs.iterdir())
                each.append(cpu_seconds(case(runs), checkout))
                for path in set(runs.iterdir()) - done:  # the next round trains it again
                    shutil.rmtree(path)
        found[name] = [statistics.median(each) for each in times]
    return found


def main() -> None:
    chosen = [word[5:].split(",") for word in sys.argv[1:] if word.startswith("case=")]
    others = [Path(word).resolve() for word in sys.argv[1:] if not word.startswith("case=")]
    with TemporaryDirectory() as folder:
        found = measure([Path.cwd(), *others], Path(folder), chosen[0] if chosen else [*CASES])
    print(f"{'CPU s':<26} {'this':>8} " + " ".join(f"{'other':>8} {'ratio':>6}" for _ in others))
    for name, (own, *rest) in found.items():
        print(f"{name:<26} {own:8.2f} " + " ".join(f"{o:8.2f} {o / own:6.2f}" for o in rest))


if __name__ == "__main__":
    main()
