"""CPU seconds and memory of every network at 256x320, each in a process of its own.

Run: python -m tests.benchmarks.bench_networks [name ...]
"""

from __future__ import annotations

import json
import resource
import statistics
import sys
from collections.abc import Callable

from tests.benchmarks.timing import in_process, seconds  # isort: skip - before torch

from typing import Any

import torch
from torch import Tensor

from rgbt.engine.device import keep_memory
from tests.models.golden import network

MODULE = "tests.benchmarks.bench_networks"
SIZE = (256, 320)
ROUNDS = 3
NETWORKS = (
    *("mask2former_tiny", "mask2former_swin_t", "mask2former_swin_s", "mask2former_swin_b"),
    *("cmx_tiny", "cmx_b0", "cmx_b2", "cmx_b4", "rtfnet_tiny", "rtfnet_50", "rtfnet_152"),
    *("cmnext_tiny", "cmnext_b0", "cmnext_b2", "cmnext_b4"),
    *("mfnet_tiny", "mfnet", "heatnet_tiny", "heatnet"),
    *("deeplabv2_tiny", "deeplabv2"),
)
Step = Callable[[], Tensor]


def images() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    rgb = torch.rand(1, 3, *SIZE, generator=generator)
    return rgb, torch.rand(1, 1, *SIZE, generator=generator)


def total(output: Any) -> Tensor:
    """One number that every prediction has a part in."""
    tensors = [value for value in output.aux.values() if value.requires_grad]
    if output.logits is not None:
        tensors.append(output.logits)
    return torch.stack([tensor.float().sum() for tensor in tensors]).sum()


def cpu(step: Step, *, backward: bool) -> float:
    """CPU seconds of one step."""
    if backward:
        return seconds(lambda: step().backward())[0]
    with torch.no_grad():
        return seconds(step)[0]


def one(name: str) -> dict[str, float]:
    """CPU seconds of forward (evaluation) and of forward and backward (training), peak memory."""
    net = network(name)
    pair, generator = images(), torch.Generator().manual_seed(1)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    forward = [cpu(lambda: total(net.eval()(*pair)), backward=False) for _ in range(ROUNDS + 1)]
    eval_peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    both = [
        cpu(lambda: total(net.train()(*pair, generator=generator)), backward=True)
        for _ in range(ROUNDS)
    ]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "millions": sum(p.numel() for p in net.parameters()) / 1e6,
        "forward": statistics.median(forward[1:]),
        "step": statistics.median(both),
        "forward_mib": (eval_peak - before) / 1024,
        "mib": peak / 1024,
    }


def main() -> None:
    words = sys.argv[1:]
    if words and words[0] == "--one":
        keep_memory()
        print(json.dumps(one(words[1])))
        return
    print("network, 1 x 256 x 320, CPU s      params M   forward  fwd+bwd   MiB forward  MiB peak")
    for name in words or NETWORKS:
        row = in_process(MODULE, "--one", name)
        print(
            f"{name:<32} {row['millions']:10.2f} {row['forward']:9.2f} {row['step']:8.2f} "
            f"{row['forward_mib']:13.0f} {row['mib']:9.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
