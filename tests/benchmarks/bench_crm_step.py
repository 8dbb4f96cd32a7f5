"""One CRM training step in three ways, equal loss, one run, and beside them the CRM release.

pass by pass: what the releases do, 4 backbone passes (two branches, clean and masked), 6 head
    calls, 4 criterion calls with one matching per layer and image; made of this project's modules.
all masks: batched, with mask logits of all six predictions.
ours: what `rgbt.schemes.crm` runs, without the masks of R' and T', which nothing reads.

All take the same weights, images, masks and points; stochastic depth is off, because it would draw
in another order. The release itself was compared once, with the step that is here "all masks"
(`RELEASE`). That ratio times "all masks" / "ours" of this run estimates the ratio to it today;
changes of the modules are in both and not counted. The speed of a machine is not in the estimate,
because both factors are ratios of one machine. That of two kernels is printed to put the seconds
into context. Every case, and every peak of memory, is a process of its own.

Run: python -m tests.benchmarks.bench_crm_step [tiny] [swin_s_1] [swin_s]
"""

from __future__ import annotations

import json
import resource
import sys

from tests.benchmarks.timing import in_process, in_turns, seconds  # isort: skip - before torch

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.engine.device import keep_memory
from rgbt.geometry.padding import STRIDE, padded_hw
from rgbt.losses.distances import sdc, sdn
from rgbt.losses.set_criterion import SetCriterion
from rgbt.models.inputs import expand_cells
from rgbt.models.mask2former.model import Mask2Former
from rgbt.models.swin import PATCH
from rgbt.types import Batch, MaskPair, Output
from tests.benchmarks.reference_criterion import Replayed, reference_criterion

VIEWS = ("rgbt", "rgb", "thermal")
CASES = {
    "tiny": ("demo", "mask2former_tiny", 8, 5),
    "swin_s_1": ("paper", "mask2former_swin_s", 1, 2),
    "swin_s": ("paper", "mask2former_swin_s", 2, 2),
}
"""name -> scale, model, batch size, repetitions."""

RELEASE = {
    "tiny": "1.56 (of the smallest times 1.67)",
    "swin_s_1": "1.42 in CPU time, 1.75 in wall time",
    "swin_s": "1.31 in CPU time, 1.49 in wall time (33.0 s against 22.1 s)",
}
"""name -> time of the CRM release divided by that of "all masks".

Measured in one run with the same weights bit for bit, the same images and masks, losses 185.34 and
185.42: two cores, torch 2.13, single precision, crops padded to 256x320 (Swin-S).
"""
RELEASE_RATIO = {"tiny": 1.56, "swin_s_1": 1.42, "swin_s": 1.31}
"""The same as one number, of CPU times where both were measured."""


def make(
    scale: str, model: str, batch_size: int
) -> tuple[Mask2Former, SetCriterion, Batch, MaskPair]:
    words = (f"scale={scale}", f"model={model}", "dataset=mfnet", "dataset.root=unused")
    config = compose(["+experiment=crm", *words, "model.drop_path_rate=0.0"])
    torch.manual_seed(0)
    network: Mask2Former = build(config.model)
    height, width = config.scale.crop_hw
    generator = torch.Generator().manual_seed(1)
    cells = torch.randint(0, 9, (batch_size, 4, 5), generator=generator)
    label = cells.repeat_interleave(-(-height // 4), 1).repeat_interleave(-(-width // 5), 2)
    batch = Batch(
        rgb=torch.rand(batch_size, 3, height, width, generator=generator),
        thermal=torch.rand(batch_size, 1, height, width, generator=generator),
        label=label[:, :height, :width],
        name=tuple(map(str, range(batch_size))),
        centre_yx=torch.zeros(batch_size, 2, dtype=torch.int64),
        position=None,
        original_hw=torch.zeros(batch_size, 2, dtype=torch.int64),
    )
    rows, columns = (side // 32 for side in padded_hw((height, width)))
    hidden = torch.rand(batch_size, rows, columns, generator=generator) < 0.5
    return network.train(), build(config.loss), batch, MaskPair(hidden, ~hidden)


def points(criterion: SetCriterion, network: Mask2Former, batch: Batch, layers: int) -> Replayed:
    """The same draws for both: 4 supervised passes of all layers."""
    sets = 4 * layers
    masks = sum(len(label.unique()) for label in batch.label)
    number = criterion.num_drawn
    generator = torch.Generator().manual_seed(2)
    shape = (sets, len(batch.label), criterion.num_points, 2)
    matcher = 2 * torch.rand(shape, generator=generator) - 1
    return Replayed(matcher, 2 * torch.rand((sets, masks, number, 2), generator=generator) - 1, 4)


def batched_loss(
    network: Mask2Former,
    criterion: SetCriterion,
    batch: Batch,
    masks: MaskPair,
    draws: Replayed,
    *,
    num_masks: int | None,
) -> Tensor:
    both = MaskPair(*(torch.cat([torch.zeros_like(m), m]) for m in masks))
    images = batch.rgb.repeat(2, 1, 1, 1), batch.thermal.repeat(2, 1, 1, 1)
    aux = network(*images, both, passes=2, views=VIEWS, num_masks=num_masks).aux
    supervised = Output(None, {name: value[:, :4] for name, value in aux.items()})
    final = aux["class_logits"][-1]
    total = sum(part.sum() for part in criterion.compare(supervised, batch, draws).values())
    return total + sdc(final[0], final[3]) + sdn(final[0], final[4], final[5])


def reference_loss(
    network: Mask2Former, criterion: SetCriterion, batch: Batch, masks: MaskPair, draws: Replayed
) -> Tensor:
    full_hw = padded_hw((batch.rgb.shape[-2], batch.rgb.shape[-1]))
    images = network.inputs(batch.rgb, batch.thermal, multiple=STRIDE)
    outputs = []
    for hidden in (None, expand_cells(masks, len(batch.rgb), full_hw, PATCH)):
        features = network.backbone(images, hidden, views=VIEWS)
        for view in range(3):
            head = network.sem_seg_head
            pyramid = head.pixel_decoder([level.chunk(3)[view] for level in features])
            outputs.append(head.predictor(pyramid))
    total = outputs[0][0].new_zeros(())
    for index, (classes, mask_logits) in enumerate(outputs[:4]):
        alone = Output(
            None, {"class_logits": classes[:, None], "mask_logits": mask_logits[:, None]}
        )
        parts = reference_criterion(criterion, alone, batch, draws.one_pass(index))
        total = total + sum(part.sum() for part in parts.values())
    final = [classes[-1] for classes, _ in outputs]
    return total + sdc(final[0], final[3]) + sdn(final[0], final[4], final[5])


WAYS: dict[str, Callable[..., Tensor]] = {
    "pass by pass": reference_loss,
    "all masks": partial(batched_loss, num_masks=None),
    "ours": partial(batched_loss, num_masks=4),
}


def steps(name: str, precision: str) -> Callable[[str], float]:
    """Forward and backward of one case; called with the way, it returns the loss."""
    scale, model, batch_size, _ = CASES[name]
    network, criterion, batch, masks = make(scale, model, batch_size)
    layers = len(network.sem_seg_head.predictor.transformer_ffn_layers) + 1

    def step(way: str) -> float:
        network.zero_grad()
        draws = points(criterion, network, batch, layers)
        with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
            value = WAYS[way](network, criterion, batch, masks, draws)
        value.backward()
        return value.item()

    return step


def timings(name: str, precision: str) -> dict[str, dict[str, object]]:
    """CPU seconds of every repetition, because these machines are shared, and losses, by way."""
    step = steps(name, precision)
    losses: dict[str, float] = {}

    def call(way: str) -> None:
        losses[way] = step(way)

    timed = in_turns({way: partial(call, way) for way in WAYS}, CASES[name][-1])
    return {way: {"cpu": timed[way][:, 0].tolist(), "loss": losses[way]} for way in WAYS}


def peak(name: str, precision: str, way: str) -> dict[str, float]:
    """GiB of this process after two steps."""
    step = steps(name, precision)
    for _ in range(2):
        step(way)
    return {"gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20}


PARTS: dict[str, Callable[..., object]] = {"timings": timings, "peak": peak}
"""What is measured in a process of its own."""


def measured(part: str, *words: str) -> dict[str, Any]:
    found = in_process("tests.benchmarks.bench_crm_step", part, *words)
    if "failed" in found:
        raise RuntimeError(f"{part} {' '.join(words)}: {found['failed']}")
    return found


def report(name: str) -> None:
    """Print every way of one case, and the comparison with the release."""
    single: dict[str, float] = {}
    for precision in ("fp32", "bf16"):
        found = measured("timings", name, precision)
        cpu = {way: np.array(values["cpu"]) for way, values in found.items()}
        for way, times in cpu.items():
            middle = float(np.median(times))
            single.setdefault(way, middle)
            print(
                f"{name:<8} batch {CASES[name][2]} {precision} {way:<12} {middle:7.2f} CPU s  "
                f"ratio to ours {np.median(times / cpu['ours']):4.2f}  "
                f"fp32 / {precision} {single[way] / middle:4.2f}  loss {found[way]['loss']:.4f}  "
                f"{measured('peak', name, precision, way)['gib']:5.2f} GiB",
                flush=True,
            )
        if precision == "fp32":
            gain = float(np.median(cpu["all masks"] / cpu["ours"]))
            print(
                f"{name:<8} CRM release / all masks, measured once: {RELEASE[name]}; "
                f"CRM release / ours, estimated: {RELEASE_RATIO[name] * gain:4.2f}"
            )


def machine_speed() -> str:
    """What two kernels of the step reach here, in GFLOP per CPU second."""
    a, b = torch.rand(1280, 512), torch.rand(512, 1280)
    maps, weight = torch.rand(8, 256, 64, 80), torch.rand(256, 256, 3, 3)
    work = {
        "matmul": (2 * 1280 * 512 * 1280 * 20, lambda: [a @ b for _ in range(20)]),
        "convolution": (
            2 * 8 * 256 * 256 * 9 * 64 * 80,
            lambda: torch.conv2d(maps, weight, padding=1),
        ),
    }
    rates = []
    for name, (operations, call) in work.items():
        call()
        fastest = min(seconds(call)[0] for _ in range(5))
        rates.append(f"{name} {operations / fastest / 1e9:.0f}")
    return ", ".join(rates)


def main() -> None:
    keep_memory()
    if sys.argv[1:2] and sys.argv[1] in PARTS:
        print(json.dumps(PARTS[sys.argv[1]](*sys.argv[2:])))
        return
    threads, capability = torch.get_num_threads(), torch.backends.cpu.get_cpu_capability()
    print(f"torch {torch.__version__}, {threads} threads, {capability}")
    print(f"GFLOP per CPU second: {machine_speed()}", flush=True)
    for name in sys.argv[1:] or CASES:
        report(name)


if __name__ == "__main__":
    main()
