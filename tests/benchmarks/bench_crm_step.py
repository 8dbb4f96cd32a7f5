"""One CRM training step: batched against pass by pass and layer by layer, equal loss, one run.

The reference does what the releases do: 4 backbone passes (two branches, clean and masked), 6 head
calls, 4 criterion calls with one matching per layer and image. Both take the same weights, images,
masks and points; stochastic depth is off, because it would draw in another order.

Run: python -m tests.benchmarks.bench_crm_step [tiny] [swin_s]
"""

from __future__ import annotations

import sys

from tests.benchmarks.timing import in_turns  # isort: skip - before torch

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.engine.allocator import keep_memory
from rgbt.geometry.padding import STRIDE, padded_hw
from rgbt.losses.distillation import sdc, sdn
from rgbt.losses.set_criterion import SetCriterion
from rgbt.models.inputs import expand_cells
from rgbt.models.mask2former.model import Mask2Former
from rgbt.models.mask2former.swin import PATCH
from rgbt.types import Batch, MaskPair, Output
from tests.benchmarks.reference_criterion import Replayed, reference_criterion

VIEWS = ("rgbt", "rgb", "thermal")
CASES = {
    "tiny": ("demo", "mask2former_tiny", 8, 5),
    "swin_s": ("paper", "mask2former_swin_s", 2, 2),
}
"""name -> scale, model, batch size, repetitions."""


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
    number = criterion.sampling.candidates + criterion.sampling.fresh
    generator = torch.Generator().manual_seed(2)
    shape = (sets, len(batch.label), criterion.matcher.num_points, 2)
    matcher = 2 * torch.rand(shape, generator=generator) - 1
    return Replayed(matcher, 2 * torch.rand((sets, masks, number, 2), generator=generator) - 1, 4)


def batched_loss(
    network: Mask2Former, criterion: SetCriterion, batch: Batch, masks: MaskPair, draws: Replayed
) -> Tensor:
    both = MaskPair(*(torch.cat([torch.zeros_like(m), m]) for m in masks))
    images = batch.rgb.repeat(2, 1, 1, 1), batch.thermal.repeat(2, 1, 1, 1)
    aux = network(*images, both, passes=2, views=VIEWS).aux
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
            outputs.append(network.sem_seg_head([level.chunk(3)[view] for level in features]))
    total = outputs[0][0].new_zeros(())
    for index, (classes, mask_logits) in enumerate(outputs[:4]):
        alone = Output(
            None, {"class_logits": classes[:, None], "mask_logits": mask_logits[:, None]}
        )
        parts = reference_criterion(criterion, alone, batch, draws.one_pass(index))
        total = total + sum(part.sum() for part in parts.values())
    final = [classes[-1] for classes, _ in outputs]
    return total + sdc(final[0], final[3]) + sdn(final[0], final[4], final[5])


def measure(name: str, precision: str) -> str:
    scale, model, batch_size, rounds = CASES[name]
    network, criterion, batch, masks = make(scale, model, batch_size)
    layers = len(network.sem_seg_head.predictor.transformer_ffn_layers) + 1
    last: dict[str, float] = {}

    def step(way: str, loss: Callable[..., Tensor]) -> None:
        network.zero_grad()
        draws = points(criterion, network, batch, layers)
        with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
            value = loss(network, criterion, batch, masks, draws)
        value.backward()
        last[way] = value.item()

    ways = {"slow": reference_loss, "fast": batched_loss}
    timed = in_turns({n: lambda n=n, w=w: step(n, w) for n, w in ways.items()}, rounds)
    # CPU time, because these machines are shared.
    slow, fast = (float(np.median(timed[way][:, 0])) for way in ways)
    slow_loss, fast_loss = last["slow"], last["fast"]
    return (
        f"{name:<7} batch {batch_size} {precision}  "
        f"pass by pass {slow:7.2f} s  batched {fast:7.2f} s  "
        f"ratio {slow / fast:4.2f}  loss {slow_loss:.4f} / {fast_loss:.4f}"
    )


def main() -> None:
    keep_memory()
    for name in sys.argv[1:] or CASES:
        for precision in ("fp32", "bf16"):
            print(measure(name, precision), flush=True)


if __name__ == "__main__":
    main()
