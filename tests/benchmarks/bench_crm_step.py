"""One training step of CRM beside that of its release, on a CPU: seconds, and peak memory.

Both have the same sizes, images and labels, and make a whole step: forward, backward, clipping,
AdamW. Each is a process of its own with the settings of its users: ours keeps freed memory, as
``rgbt run`` does; the release does not. They take turns, so that other load affects both.

Run: python -m tests.benchmarks.bench_crm_step release=FOLDER [CASE ...] [rounds=5]
"""

from __future__ import annotations

import multiprocessing
import resource
import sys
import warnings

from tests.benchmarks.timing import seconds  # isort: skip - before torch

from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import torch
from omegaconf import OmegaConf
from torch import Tensor

from rgbt.assembly.training_setup import set_up_training
from rgbt.config.compose import compose
from rgbt.engine.device import keep_memory
from rgbt.runs.specify import specify
from rgbt.types import Batch
from tests.benchmarks.loop import trainer_of
from tests.benchmarks.release_step import release_step

CASES = {
    "tiny_8": ("mask2former_tiny", 8, (128, 160), 1024),
    "tiny_4": ("mask2former_tiny", 4, (128, 160), 1024),
    "swin_t_2": ("mask2former_swin_t", 2, (256, 320), 12544),
}
"""name -> network, batch size, rows and columns, points at which masks are compared."""


def draw(batch_size: int, hw: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Images (B, 4, H, W) in [0, 1], labels (B, H, W), hidden tokens (B, 2, 1, H / 4, W / 4)."""
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(batch_size, 4, *hw, generator=generator)
    cells = torch.randint(0, 9, (batch_size, 4, 5), generator=generator)
    label = cells.repeat_interleave(hw[0] // 4, 1).repeat_interleave(hw[1] // 5, 2)
    hidden = torch.rand(batch_size, 1, 1, hw[0] // 32, hw[1] // 32, generator=generator) < 0.5
    hidden = torch.cat([hidden, ~hidden], 1).repeat_interleave(8, 3).repeat_interleave(8, 4)
    return image, label, hidden.float()


def words_of(case: str) -> list[str]:
    """The words of our run."""
    network, batch_size, hw, num_points = CASES[case]
    words = ["+experiment=crm", f"model={network}", "tracking=none", "trainer.accelerator=cpu"]
    words += [f"data.batch_size={batch_size}", f"scale.num_points={num_points}"]
    return [*words, f"scale.crop_hw=[{hw[0]},{hw[1]}]"]


def our_step(case: str) -> Callable[[], object]:
    """A step of our loop; the loader is not in it."""
    keep_memory()
    words = words_of(case)
    setup = set_up_training(specify(compose(words), words), upstream_finished=False)
    trainer = trainer_of(setup, Path(mkdtemp()))
    setup.model.train()
    _, batch_size, hw, _ = CASES[case]
    image, label, _ = draw(batch_size, hw)
    batch = Batch(
        rgb=image[:, :3],
        thermal=image[:, 3:],
        label=label,
        name=tuple(map(str, range(batch_size))),
        centre_yx=torch.zeros(batch_size, 2, dtype=torch.int64),
        position=None,
        original_hw=torch.zeros(batch_size, 2, dtype=torch.int64),
    )
    return lambda: trainer._step(0, iter([batch]), 0)


def their_step(case: str, checkout: Path) -> Callable[[], object]:
    """A step of the release."""
    network, batch_size, hw, num_points = CASES[case]
    config = compose(words_of(case))
    sizes = OmegaConf.to_container(config.model, resolve=True)
    assert isinstance(sizes, dict), network
    image, label, hidden = draw(batch_size, hw)
    return release_step(
        checkout, sizes, num_points=num_points, images=255 * image, label=label, hidden=hidden
    )


def serve(pipe: Connection, case: str, checkout: Path | None) -> None:
    """Make a step for every request; answer with CPU and wall seconds and the peak in MiB."""
    warnings.filterwarnings("ignore")
    torch.set_num_threads(2)
    step = our_step(case) if checkout is None else their_step(case, checkout)
    while pipe.recv():
        found = seconds(step)
        pipe.send((*found, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10))


def compare(case: str, checkout: Path, rounds: int) -> None:
    """Print the medians of both, and of the ratios of each round."""
    context = multiprocessing.get_context("spawn")
    pipes = []
    for source in (None, checkout):
        ours, theirs = context.Pipe()
        context.Process(target=serve, args=(theirs, case, source), daemon=True).start()
        pipes.append(ours)
    rows = []
    for _ in range(rounds + 1):
        row = []
        for pipe in pipes:
            pipe.send(True)
            row.append(pipe.recv())
        rows.append(row)
    for pipe in pipes:
        pipe.send(False)
    times = np.array(rows)[1:]  # the first step does not count
    (cpu, wall, peak), (their_cpu, their_wall, their_peak) = np.median(times, axis=0)
    ratios = times[:, 1] / times[:, 0]
    print(
        f"{case:<9} ours {cpu:.2f} CPU s, {wall:.2f} s, {peak:.0f} MiB   release {their_cpu:.2f} "
        f"CPU s, {their_wall:.2f} s, {their_peak:.0f} MiB   release / ours "
        f"{np.median(ratios[:, 0]):.2f} CPU, {np.median(ratios[:, 1]):.2f} wall, of the smallest "
        f"{times[:, 1, 0].min() / times[:, 0, 0].min():.2f} CPU",
        flush=True,
    )


def main() -> None:
    """Compare the cases named, or all."""
    given = dict(word.split("=", 1) for word in sys.argv[1:] if "=" in word)
    if "release" not in given:
        print("not measured: release=FOLDER is a checkout of the CRM release")
        return
    for case in [word for word in sys.argv[1:] if "=" not in word] or CASES:
        compare(case, Path(given["release"]).resolve(), int(given.get("rounds", 5)))


if __name__ == "__main__":
    main()
