"""Evaluation of a split against the forward passes of its network alone.

Both take the same images in one process, in turns; CPU seconds. The evaluation reads the images
from the decoded cache (`data.cache`), in the main process. The forward passes are those of
``network(rgb, thermal)`` without gradients, on batches that are in memory.

Run: python -m tests.benchmarks.bench_evaluation [case ...]
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.benchmarks.timing import medians  # isort: skip - before torch

import torch

from rgbt.assembly.session import open_session
from rgbt.config.compose import compose
from rgbt.data.loaders import eval_batches
from rgbt.evaluation import measure
from rgbt.runs.specify import specify
from rgbt.types import Batch

ROUNDS = 5


@dataclass(frozen=True)
class Case:
    """What is evaluated.

    Attributes:
        images: of the split.
        overrides: network, size and batch.
    """

    images: int
    overrides: tuple[str, ...]


PAPER = (
    *("dataset.height=480", "dataset.width=640", "transform.test_short_edge=null"),
    "data.eval_batch_size=1",
)
"""Images of the paper's size, one at a time, as at scale=paper."""

CASES = {
    "mfnet 480x640": Case(6, ("+experiment=mfnet", "model=mfnet", *PAPER)),
    "mask2former_swin_t 480x640": Case(2, ("+experiment=crm", "model=mask2former_swin_t", *PAPER)),
    "mfnet_tiny, scale=demo": Case(50, ("+experiment=mfnet",)),
    "mask2former_tiny, scale=demo": Case(20, ("+experiment=crm",)),
}


def measured(case: Case, folder: Path) -> tuple[float, float]:
    """CPU seconds of the evaluation of a split and of the forward passes alone."""
    sizes = [f"dataset.num_{split}=2" for split in ("train", "val")]
    words = [*case.overrides, *sizes, f"dataset.num_test={case.images}"]
    words += [f"runs_dir={folder}", f"data.cache={folder / 'decoded'}", "tracking=none"]
    session = open_session(specify(compose(words), words), load_weights=False)
    batches = eval_batches(
        session.dataset, session.dataset.names("test"), session.transform, session.loading
    )
    in_memory = [batch.to(session.device) for batch in batches]

    def forward() -> None:
        _forward(session.model.eval(), in_memory)

    def whole() -> None:
        measure.measure(session, measure.measurement_of(session, "test"))

    times = medians({"evaluate": whole, "forward": forward}, ROUNDS)
    return times["evaluate"][0], times["forward"][0]


@torch.inference_mode()
def _forward(network: torch.nn.Module, batches: Sequence[Batch]) -> None:
    for batch in batches:
        network(batch.rgb, batch.thermal)


def main() -> None:
    print("CPU s per image                 evaluate   forward    ratio")
    for name in sys.argv[1:] or CASES:
        with TemporaryDirectory() as folder:
            whole, forward = measured(CASES[name], Path(folder))
        images = CASES[name].images
        row = f"{whole / images:9.4f} {forward / images:9.4f} {whole / forward:8.2f}"
        print(f"{name:<30} {row}", flush=True)


if __name__ == "__main__":
    main()
