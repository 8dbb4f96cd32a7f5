"""Memory and time of one training step of the networks of domain adaptation, side by side.

One image of each domain at 320x640, the thesis' input: both passes, both losses, the critic, all
optimisers, as at scale=paper. HeatNet's phases take turns, so that two of its steps do what one of
the others does: it is shown per pair. Every network has a process of its own, for its memory.

Run: python -m tests.benchmarks.bench_adaptation [cpu|cuda] [threads] [batch size]
"""

from __future__ import annotations

import json
import resource
import sys
import tempfile
from pathlib import Path

import numpy as np

from tests.benchmarks.timing import in_process, seconds

CASES = {
    "one head": ("sh_adversarial", ()),
    "two heads": ("multi_head_thermal", ()),
    "two heads, decoder of the text": (
        "multi_head_thermal",
        ("model=deeplabv2_two_heads_literal",),
    ),
    "two heads, decoder of the code": ("multi_head_modified_thermal", ()),
    "two streams (HeatNet)": ("heatnet_no_teacher", ()),
    "RGB alone (HeatNet's student)": ("heatnet_no_teacher", ("model.modalities=rgb",)),
}
ROUNDS = {"cpu": 1, "cuda": 20}


def measure(case: str, device: str, threads: int, batch_size: int) -> dict[str, float]:
    """Seconds per step, wall and CPU, and peak memory in MiB of one case, in this process."""
    import torch

    from rgbt.assembly.training_setup import set_up_training
    from rgbt.config.compose import compose
    from rgbt.engine.trainer import Trainer
    from rgbt.runs.specify import specify

    experiment, changes = CASES[case]
    config = compose(
        [
            *(f"+experiment={experiment}", "scale=paper", "dataset=synth_freiburg", *changes),
            *("model.weights=null", "tracking=none", f"data.batch_size={batch_size}"),
            *("data.num_workers=0", f"trainer.accelerator={device}", f"trainer.threads={threads}"),
        ]
    )
    made = set_up_training(specify(config))
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(
            fabric=made.fabric,
            settings=made.session.trainer,
            scheme=made.scheme,
            model=made.model,
            others=made.others,
            optimizers=made.optimizers,
            schedule=made.schedule,
            steps_per_epoch=1,
            folder=Path(folder),
            record=lambda *_: None,
            validate=lambda _: 0.0,
        )
        per_round = 2 if getattr(made.scheme, "alternates", False) else 1
        rounds = ROUNDS[device]
        batches = made.batches(range(per_round * (rounds + 1)))
        steps = iter(range(per_round * (rounds + 1)))

        def one_round() -> None:
            for _ in range(per_round):
                trainer._step(next(steps), batches, 0)

        cpu, wall = np.median([seconds(one_round) for _ in range(rounds + 1)][1:], axis=0)
    peak = (
        torch.cuda.max_memory_allocated() / 2**20
        if device == "cuda"
        else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    )
    parameters = sum(each.numel() for each in made.session.model.parameters()) / 1e6
    return {
        "s": float(wall),
        "cpu": float(cpu),
        "mib": peak,
        "parameters": parameters,
    }


def main(device: str = "cpu", threads: str = "2", batch_size: str = "1") -> None:
    """Measure every case and print a table."""
    print(f"{device}, {threads} threads, {batch_size} image(s) of each domain, 320x640")
    first = None
    for case in CASES:
        words = ("--case", case, device, threads, batch_size)
        found = in_process("tests.benchmarks.bench_adaptation", *words)
        if "failed" in found:
            print(f"{case}: failed: {found['failed']}")
            continue
        counted = found["cpu" if device == "cpu" else "s"]
        first = first or counted
        print(
            f"{case:32} {found['parameters']:7.1f} M  {found['s']:7.2f} s  "
            f"{found['cpu']:7.2f} s CPU  {counted / first:5.2f}x  {found['mib']:7.0f} MiB",
            flush=True,
        )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--case"]:
        print(json.dumps(measure(sys.argv[2], sys.argv[3], int(sys.argv[4]), int(sys.argv[5]))))
    else:
        main(*sys.argv[1:])
