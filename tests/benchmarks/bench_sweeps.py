"""Cost and savings of the sweeper: seconds per point, two workers against one, pruning.

All parts train CMX's tiny network on the embedded data, one thread a run, in a folder of their own:

* overhead: wall seconds of a point minus those between the first line of its training and its
  result, of the sweeper and of the plain command called in a loop;
* workers: wall seconds of the same grid with one worker and with two;
* pruning: the same search with and without a median pruner, equal trials and sampler seed: training
  steps done and the best value;
* smoke: CPU seconds, with all processes, of six smoke runs on two workers, by Hydra's basic
  launcher in sequence, and by its joblib launcher if it is installed.

Run: python -m tests.benchmarks.bench_sweeps [overhead] [workers] [pruning] [smoke]
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from optuna import get_all_study_names

from sweeps import attributes as names
from sweeps.worker.storage import load_study, open_storage
from sweeps.worker.trial_store import counted_trials
from tests.benchmarks.process_cost import cpu_seconds
from tests.benchmarks.timing import seconds

POINTS = 6
TRIALS = 16
SHORT = ("trainer.max_steps=8", "trainer.eval_every=8")
GRID = ("trainer.max_steps=60", "trainer.eval_every=60")
SEARCH = ("trainer.max_steps=120", "trainer.eval_every=20")
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}


def call(*words: str) -> float:
    """Wall seconds of a command."""
    command = [sys.executable, "-m", "rgbt.run", *words]
    run = partial(subprocess.run, command, env=ENVIRONMENT, check=True, capture_output=True)
    return seconds(run)[1]


def inside(run: Path) -> float:
    """Seconds of training and evaluation of a run."""
    return float(json.loads((run / "result.json").read_text())["seconds_of_last_process"])


def trials_of(runs: Path) -> list:
    storage = open_storage(None, runs)
    (name,) = get_all_study_names(storage)
    return counted_trials(load_study(name, storage))


def overhead(place: Path) -> None:
    words = ("+experiment=cmx", *SHORT, "trainer.threads=1")
    call(*words, f"runs_dir={place / 'warm'}")
    plain = []
    for seed in range(3):
        wall = call(*words, f"seed={seed}", f"runs_dir={place / 'loop'}")
        newest = max((place / "loop").glob("*/result.json"), key=lambda path: path.stat().st_mtime)
        plain.append(wall - inside(newest.parent))
    seeds = ",".join(map(str, range(POINTS)))
    sweep = place / "sweep"
    wall = call("-m", *words, f"seed={seeds}", f"runs_dir={sweep}", "hydra.sweeper.workers=1")
    each = []
    for trial in trials_of(sweep):
        (key,) = trial.user_attrs[names.RUNS]
        each.append(trial.user_attrs[names.SECONDS] - inside(sweep / key))
    again = call("-m", *words, f"seed={seeds}", f"runs_dir={sweep}", "hydra.sweeper.workers=1")
    trained = sum(inside(path.parent) for path in sweep.glob("*/result.json"))
    print(f"plain command in a loop: {statistics.median(plain):.2f} s beside training, per point")
    print(
        f"sweeper: first point {each[0]:.2f} s, then median {statistics.median(each[1:]):.2f} s "
        f"(max {max(each[1:]):.2f}); whole grid {wall:.1f} s for {trained:.1f} s of training"
    )
    print(f"the same command again, everything known: {again:.1f} s for {POINTS} points")


def workers(place: Path) -> None:
    words = ("-m", "+experiment=cmx", *GRID, "seed=0,1,2,3")
    walls = {}
    for count in (1, 2):
        one = f"hydra.sweeper.workers={count}"
        walls[count] = call(*words, one, f"runs_dir={place / f'workers{count}'}")
    print(
        f"4 points, one thread each: 1 worker {walls[1]:.1f} s, 2 workers {walls[2]:.1f} s: "
        f"{walls[1] / walls[2]:.2f}x"
    )


def pruning(place: Path) -> None:
    found = {}
    for name, pruner in (
        ("none", "null"),
        ("median", "{_target_:optuna.pruners.MedianPruner,n_startup_trials:4,n_warmup_steps:20}"),
    ):
        runs = place / name
        wall = call(
            *("-m", "+experiment=cmx", *SEARCH, f"runs_dir={runs}"),
            "optimizer.lr=tag(log, interval(0.00003, 0.1))",
            *(f"hydra.sweeper.trials={TRIALS}", "hydra.sweeper.workers=2"),
            f"hydra.sweeper.pruner={pruner}",
        )
        trials = trials_of(runs)
        steps = sum(
            max(trial.intermediate_values, default=0)
            for trial in trials
            if trial.state.name in ("COMPLETE", "PRUNED")
        )
        best = max(trial.value for trial in trials if trial.state.name == "COMPLETE")
        pruned = sum(trial.state.name == "PRUNED" for trial in trials)
        found[name] = steps
        print(
            f"pruner {name}: {len(trials)} trials, {pruned} pruned, {steps} steps, "
            f"best val mIoU {best:.2f}, {wall:.0f} s"
        )
    print(f"steps saved: {100 * (1 - found['median'] / found['none']):.0f} %")


LAUNCHERS = {
    "sweeper, two workers": ("hydra.sweeper.workers=2",),
    "basic launcher, in sequence": ("hydra/sweeper=basic",),
    "joblib launcher, two workers": (
        *("hydra/sweeper=basic", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2"),
    ),
}


def smoke(place: Path) -> None:
    words = ("rgbt.run", "-m", "+experiment=grbm", "+debug=smoke", "seed=0,1,2,3,4,5")
    for number, (name, launcher) in enumerate(LAUNCHERS.items()):
        if "joblib" in name and find_spec("hydra_plugins.hydra_joblib_launcher") is None:
            print(f"{name}: hydra-joblib-launcher is not installed")
            continue
        runs = place / str(number)
        where = (f"runs_dir={runs}", f"hydra.sweep.dir={runs / 'hydra'}")
        cost = cpu_seconds((*words, *where, *launcher), {**os.environ})
        print(f"six smoke runs, {name}: {cost:.1f} CPU s", flush=True)


PARTS = {"overhead": overhead, "workers": workers, "pruning": pruning, "smoke": smoke}


def main() -> None:
    for name in sys.argv[1:] or PARTS:
        with tempfile.TemporaryDirectory() as place:
            PARTS[name](Path(place))


if __name__ == "__main__":
    main()
