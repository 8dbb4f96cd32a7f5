"""CPU seconds of a training step of an EfficientNet-Lite0 encoder by the number of frozen stages.

Forward and backward pass of four crops of 192x256, one thread, with and without a gradient of the
stem's output, which a mask token needs.

Run: python -m tests.benchmarks.bench_frozen_stages
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from tests.benchmarks.timing import medians  # isort: skip - before torch

import torch
from torch import nn

from rgbt.models.efficientnet_lite import STEM, EfficientNetLite

STAGES = (0, 1, 2, 3, 7)
ROUNDS = 5


def step(encoder: EfficientNetLite, images: torch.Tensor, token: nn.Parameter | None) -> None:
    x = encoder.stem(images)
    x = x if token is None else x + token
    total = torch.zeros(())
    for index in range(4):
        x = encoder.level(index, x)
        total = total + x.mean()
    if total.requires_grad:
        total.backward()


def main() -> None:
    torch.set_num_threads(1)
    images = torch.rand(4, 3, 192, 256).to(memory_format=torch.channels_last)
    token = nn.Parameter(torch.zeros(1, STEM, 1, 1))
    calls: dict[str, Callable[[], object]] = {}
    for stages in STAGES:
        encoder = EfficientNetLite(1.0, 1.0, None, stages).train()
        encoder = encoder.to(memory_format=torch.channels_last)
        calls[f"{stages} | alone"] = partial(step, encoder, images, None)
        calls[f"{stages} | with a token"] = partial(step, encoder, images, token)
    timed = medians(calls, ROUNDS)
    for name, (cpu, _) in timed.items():
        base = timed[f"0 | {name.partition(' | ')[2]}"][0]
        print(f"| {name} | {cpu:.3f} | {cpu / base:.2f} |")


if __name__ == "__main__":
    main()
