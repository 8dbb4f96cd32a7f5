"""Seconds for which checkpoints stop a training: written by a thread, against waiting for the file.

CRM trains at the settings of the paper, but with small crops of the embedded data set: the files do
not depend on them. Every fifth step has the best weights so far, which are copied; after the next
one the state (weights, both moments of AdamW) is copied and a thread writes both. "Waiting" is
``trainer.checkpoint_minutes=0``. With "busy", two other processes compute.

Run: python -m tests.benchmarks.bench_checkpoint [swin_s] [busy] [device=cpu]
"""

from __future__ import annotations

import multiprocessing
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from itertools import repeat
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

from tests.benchmarks.timing import seconds  # isort: skip - before torch

from torch import nn

from rgbt.assembly.training_setup import TrainingSetup, set_up_training
from rgbt.config.compose import compose
from rgbt.engine.checkpoint import State
from rgbt.engine.trainer import Hooks
from rgbt.runs.specify import specify
from tests.benchmarks.loop import trainer_of

EVERY, NEVER = 5, 1440


def set_up(network: str, device: str) -> TrainingSetup:
    words = ["+experiment=crm", f"model=mask2former_{network}", "scale=paper", "dataset=synth"]
    words += ["scale.pretrained=false", "tracking=none", f"trainer.accelerator={device}"]
    words += ["recipe.batch_size=2", "scale.crop_hw=[64,80]", "data.num_workers=0"]
    return set_up_training(specify(compose(words), words), upstream_finished=False)


class Rising(Hooks):
    """Every evaluation is the best so far; after it, `due` is called at the end of a step."""

    due: Callable[[], None]

    def log(self, step: int, values: dict[str, float]) -> None:
        if step > EVERY and step % EVERY == 1:
            self.due()

    def evaluate(self, step: int, network: nn.Module) -> float | None:
        return float(step)


def measured(
    setup: TrainingSetup, folder: Path, minutes: int, steps: int
) -> dict[str, list[float]]:
    """Seconds between two steps, by what is copied there, and of the thread."""
    hooks, lengths = Rising(), {"max_steps": 10**6, "eval_every": EVERY, "log_every": 1}
    trainer = trainer_of(setup, folder, hooks, checkpoint_minutes=minutes, **lengths)
    found: dict[str, list[float]] = defaultdict(list)

    def due() -> None:
        trainer._wait()
        trainer._saved_at = -60.0 * NEVER

    hooks.due = due
    between = trainer._evaluate_and_save
    state = State(seed=0)

    def timed(state: State) -> None:
        saved_at = trainer._saved_at
        _, wall = seconds(lambda: between(state))
        kind = "nothing" if trainer._saved_at == saved_at else "state"
        found["best weights" if state.step % EVERY == 0 else kind].append(wall)
        if trainer._writing is not None and kind == "state":
            began = time.perf_counter()
            end = lambda _: found["thread"].append(time.perf_counter() - began)  # noqa: E731
            trainer._writing.add_done_callback(end)

    trainer._evaluate_and_save = timed  # type: ignore[method-assign]

    def batches() -> Iterator[object]:
        batch = next(setup.batches(range(1)))
        yield from repeat(batch, steps)
        raise KeyboardInterrupt

    try:
        trainer.fit(batches(), state)  # type: ignore[arg-type]
    except KeyboardInterrupt:
        return found
    raise AssertionError("there are more steps")


def compute() -> None:
    while True:
        sum(range(10**6))


def main(network: str = "swin_s", *words: str) -> None:
    device = "cuda" if "device=cuda" in words else "cpu"
    busy = [multiprocessing.Process(target=compute, daemon=True) for _ in range(2)]
    for process in busy if "busy" in words else ():
        process.start()
    with TemporaryDirectory() as name:
        folder, setup = Path(name), set_up(network, device)
        waiting = measured(setup, folder / "waiting", 0, 4)["state"]
        found = measured(setup, folder / "thread", NEVER, 6 * EVERY)
        sizes = [(folder / "thread" / file).stat().st_size for file in ("last.pt", "best.pt")]
    stop = found["state"]
    print(
        "| GB of state, best | waiting s | thread: first, median, longest s | best weights, longest"
        " | nothing | the thread writes for s | waiting / median |"
    )
    print(
        f"| {sizes[0] / 1e9:.2f}, {sizes[1] / 1e9:.2f} | {median(waiting):.2f} | {stop[0]:.2f}, "
        f"{median(stop):.2f}, {max(stop):.2f} | {max(found['best weights']):.2f} | "
        f"{median(found['nothing']):.3f} | {median(found['thread']):.1f} | "
        f"{median(waiting) / median(stop):.0f} |"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
