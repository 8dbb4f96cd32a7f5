"""Peak memory of a training step by network, batch and setting, and which recipe fits a GPU.

Counted: the step runs on tensors without content (FakeTensorMode), and the bytes of all tensors
that exist at the same time are added up. That is what `torch.cuda.max_memory_allocated` reports,
less workspaces of cuDNN and rounding by the allocator. Images are those of `scale=paper`; two of
four labels per image are assumed for the set criterion, because matching reads numbers.

Measured: the step runs in a fresh process; resident memory on a CPU (peak less what was there
before), `max_memory_allocated` on a GPU.

Run: python -m tests.benchmarks.bench_memory [NAME ...] [SETTING ...]   counted table
     python -m tests.benchmarks.bench_memory --measure NAME BATCH [device]
"""

from __future__ import annotations

import json
import resource
import sys
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

from tests.benchmarks.timing import in_process, seconds  # isort: skip - before torch

import numpy as np
import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.nn import functional as F
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.engine.device import recompute_activations
from rgbt.geometry.padding import padded_hw
from rgbt.losses import set_criterion
from rgbt.models.mask2former import head
from rgbt.schemes.crm import CRM
from rgbt.types import Batch, MaskPair

MODULE = "tests.benchmarks.bench_memory"
MIB = 2**20
CARDS = (24, 40, 80)
"""GB of the graphics cards; 2 GB are left to the driver, cuDNN and fragments."""
SPARE = 2.0
SETTINGS = {
    "fp32": (False, False),
    "bf16": (True, False),
    "recomputed": (False, True),
    "both": (True, True),
}
"""name -> bf16-mixed, activation checkpointing."""
NETWORKS: dict[str, tuple[str, ...]] = {
    "swin_t": ("+experiment=crm", "model=mask2former_swin_t"),
    "swin_s": ("+experiment=crm", "model=mask2former_swin_s"),
    "swin_b": ("+experiment=crm", "model=mask2former_swin_b"),
    "mfnet": ("+experiment=mfnet",),
    "rtfnet_152": ("+experiment=rtfnet", "model=rtfnet_152"),
    "cmx_b2": ("+experiment=cmx", "model=cmx_b2"),
    "cmx_b4": ("+experiment=cmx", "model=cmx_b4"),
}
"""name -> words of its experiment; CRM steps of two masked passes, or one supervised pass."""
FAKE = FakeTensorMode(allow_non_fake_inputs=True)
"""One for all counts, because networks keep masks by size."""
TARGETS = 4
"""Classes present in an image, for the set criterion."""


class Live(TorchDispatchMode):
    """The bytes of the storages that operations made, now and at most."""

    def __init__(self) -> None:
        super().__init__()
        self.now = self.peak = 0
        self.known: dict[int, Any] = {}

    def add(self, tensor: Tensor) -> None:
        storage = tensor.untyped_storage()
        key, size = storage._cdata, storage.nbytes()
        if key in self.known or tensor.device.type == "cuda" and size == 0:
            return

        def freed(_: object) -> None:
            self.known.pop(key, None)
            self.now -= size

        self.known[key] = weakref.ref(storage, freed)
        self.now += size
        self.peak = max(self.peak, self.now)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(found):
            if isinstance(leaf, Tensor):
                self.add(leaf)
        return found


@dataclass
class Case:
    """A network with its loss and the recipe of the paper."""

    name: str
    config: Any = field(init=False)

    def __post_init__(self) -> None:
        words = ("scale=paper", "dataset=mfnet", "dataset.root=unused")
        self.config = compose([*NETWORKS[self.name], *words])

    @property
    def batch_size(self) -> int:
        return int(self.config.scale.batch_size)

    def batch(self, count: int) -> Batch:
        height, width = self.config.scale.crop_hw
        return Batch(
            rgb=torch.rand(count, 3, height, width),
            thermal=torch.rand(count, 1, height, width),
            label=torch.arange(width).expand(count, height, width) % TARGETS,
            name=tuple(map(str, range(count))),
            centre_yx=torch.zeros(count, 2, dtype=torch.int64),
            position=None,
            original_hw=torch.zeros(count, 2, dtype=torch.int64),
        )

    def step(self, network: nn.Module, batch: Batch, *, bf16: bool) -> None:
        """Forward and backward as the trainer has them: autocast around the network alone."""
        device = batch.rgb.device.type

        def forward(*arguments: Any, **keywords: Any) -> Any:
            with torch.autocast(device, torch.bfloat16, enabled=bf16):
                found = network(*arguments, **keywords)
            aux = {name: value.float() for name, value in found.aux.items()}
            return type(found)(found.logits, aux)

        def generator_of(purpose: str) -> torch.Generator:
            return torch.Generator(device).manual_seed(len(purpose))

        if "swin" in self.name:
            loss = build(self.config.loss)
            forward.record = network.record  # type: ignore[attr-defined]
            scheme = CRM(
                model=forward,
                loss=loss,
                masker=hide,
                modality_weight=1.0,
                complementary_weight=1.0,
                nonlocal_weight=1.0,
            )
            (phase,) = scheme.phases(batch, generator_of)
            parts = phase.parts
        else:
            output = forward(batch.rgb, batch.thermal, generator=generator_of("network"))
            # Without classes or pixels to leave out: their number would be read from the labels.
            parts = {"ce": F.cross_entropy(output.logits.float(), batch.label)}
        torch.stack([part.sum() for part in parts.values()]).sum().backward()


def hide(image_hw: tuple[int, int], centre_yx: Tensor, _: torch.Generator) -> MaskPair:
    """Every second cell of 32 pixels of each image, complementary."""
    rows, columns = (side // 32 for side in padded_hw(image_hw))
    cells = torch.arange(rows * columns, device=centre_yx.device).view(rows, columns) % 2 == 0
    hidden = cells.expand(len(centre_yx), rows, columns)
    return MaskPair(hidden, ~hidden)


@contextmanager
def without_numbers() -> Iterator[None]:
    """Matching reads no numbers: the first queries are matched to the first classes."""

    def assign(costs: Tensor, _: Any) -> set_criterion.Matches:
        sets, images = costs.shape[:2]
        image = np.repeat(np.arange(images), TARGETS)
        query = np.tile(np.arange(TARGETS), images)
        queries = np.tile(query, (sets, 1))
        return set_criterion.Matches(image, query.copy(), queries, slice(None), len(image))

    with mock.patch.object(set_criterion, "assign", assign):
        yield


def counted(case: Case, count: int, *, bf16: bool, recomputed: bool) -> dict[str, float]:
    """MiB: peak of forward and backward beside weights and gradients, and these themselves."""
    with torch.device("meta"):
        network: nn.Module = build(case.config.model).train()
    with FAKE, without_numbers(), Live() as live:
        network.to_empty(device="cpu")
        if recomputed:
            recompute_activations(network)
        weights = sum(p.numel() * p.element_size() for p in network.parameters())
        for parameter in network.parameters():
            parameter.grad = torch.zeros_like(parameter)
        batch = case.batch(count)
        before, live.peak = live.now, live.now
        case.step(network, batch, bf16=bf16)
    return {"weights": weights / MIB, "activations": (live.peak - before) / MIB}


def measured(name: str, count: int, setting: str, device: str) -> dict[str, float]:
    """MiB of activations as the process has them, and CPU seconds of the step."""
    bf16, recomputed = SETTINGS[setting]
    case = Case(name)
    network: nn.Module = build(case.config.model).train().to(device)
    if recomputed:
        recompute_activations(network)
    for parameter in network.parameters():
        parameter.grad = torch.zeros_like(parameter)
    batch = case.batch(count).to(device)
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
    else:
        before = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    cpu, _ = seconds(lambda: case.step(network, batch, bf16=bf16))
    if device == "cuda":
        peak = torch.cuda.max_memory_allocated()
    else:
        peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {"activations": (peak - before) / MIB, "cpu_s": cpu}


def table(name: str, settings: list[str]) -> None:
    """Counted memory of one network: batch 1, the paper's batch, what lies between, what fits.

    Activations grow by the same number of bytes with every sample. The chunks of the criterion on a
    GPU do not: they are as large at batch 2 as at 14, which is therefore counted.
    """
    case = Case(name)
    paper = max(2, case.batch_size)
    for setting in settings:
        bf16, recomputed = SETTINGS[setting]
        both = [counted(case, count, bf16=bf16, recomputed=recomputed) for count in (1, paper)]
        state = 4 * both[0]["weights"]  # with gradients and both moments of AdamW
        one, most = (state + each["activations"] for each in both)
        slope = (most - one) / (paper - 1)
        fits = [int(((card - SPARE) * 1e9 / MIB - one) // slope) + 1 for card in CARDS]
        print(
            f"| {name} | {setting} | {state / 1024:.2f} | {one / 1024:.2f} | "
            f"{slope / 1024:.2f} | {paper}: {most / 1024:.1f} | "
            + " | ".join(str(max(0, count)) for count in fits)
            + " |",
            flush=True,
        )


def main() -> None:
    words = sys.argv[1:]
    if words and words[0] == "--one":
        name, count, setting, device = words[1:]
        print(json.dumps(measured(name, int(count), setting, device)))
        return
    if words and words[0] == "--measure":
        name, count, device = words[1], words[2], (*words[3:], "cpu")[0]
        for setting in SETTINGS:
            row = in_process(MODULE, "--one", name, count, setting, device)
            print(name, count, setting, device, row, flush=True)
        return
    print(
        "| network | setting | weights, gradients, AdamW GiB | batch 1 GiB | "
        "GiB per sample | paper's batch: GiB | fits 24 GB | 40 GB | 80 GB |"
    )
    settings = [word for word in words if word in SETTINGS] or list(SETTINGS)
    with (  # the chunks that they have on a GPU
        mock.patch.object(set_criterion, "CHUNK_BYTES", set_criterion.CHUNK_BYTES_GPU),
        mock.patch.object(head, "BLOCK_BYTES", 2**40),
    ):
        for name in [word for word in words if word in NETWORKS] or list(NETWORKS):
            table(name, settings)


if __name__ == "__main__":
    main()
