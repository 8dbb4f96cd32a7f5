"""Scores and latency of networks as ONNX in onnxruntime, against PyTorch, one thread.

Weights are random. Scores are compared on 20 test images of the embedded data set, or of a data set
in the layout of MFNet. Times are CPU seconds of one image, both sides in turns.

Run: python -m tests.benchmarks.bench_exported [96,128 NAME ...] [root=/data/MFNet]
"""

from __future__ import annotations

import statistics
import sys
import time
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from rgbt.config.command import built
from rgbt.config.compose import available
from rgbt.evaluation.export import compare
from rgbt.evaluation.profiled_network import from_overrides
from rgbt.exported.onnx_network import ScoresOfImages, exported_network
from rgbt.randomness import derive
from rgbt.requirements import record_of

ROUNDS = 7
NUM_IMAGES = 20

Pair = tuple[Tensor, Tensor]
"""RGB (1, 3, H, W) and thermal (1, 1, H, W) in [0, 1]."""


def images(hw: tuple[int, int], root: str) -> list[Pair]:
    words = ["dataset=mfnet", f"dataset.root={root}"] if root else ["dataset=synth"]
    dataset = built("dataset", words)
    found = []
    for name in dataset.names("test")[:NUM_IMAGES]:
        sample = dataset.read(name)
        whole = torch.cat(
            [torch.from_numpy(sample.rgb).permute(2, 0, 1), torch.from_numpy(sample.thermal)[None]]
        )
        sized = F.interpolate(whole[None].float() / 255, size=hw, mode="bilinear")
        found.append((sized[:, :3], sized[:, 3:]))
    return found


def cpu_ms(call: Any, pair: Pair) -> float:
    start = time.process_time()
    call(*pair)
    return 1000 * (time.process_time() - start)


def measure(name: str, hw: tuple[int, int], pairs: list[Pair]) -> str:
    described = from_overrides(name, [f"model={name}"], hw)
    torch.manual_seed(derive(0, "weights"))
    network = described.model.build().eval().requires_grad_(False)
    view = described.view or record_of(network).views[0]
    graph = ScoresOfImages(network, view=view, head=None)
    exported = exported_network(network, view, hw, name)
    found = compare(graph, lambda *pair: exported(*pair).logits, pairs)
    both = []
    with torch.inference_mode():
        for number in range(ROUNDS):
            calls = [graph, exported]
            times = {call: cpu_ms(call, pairs[0]) for call in calls[:: (-1) ** number]}
            both.append([times[call] for call in calls])
    own, onnx = (statistics.median(each) for each in zip(*both, strict=True))
    ratio = statistics.median(b / a for a, b in both)
    return (
        f"{name}: {found.num_images} images, difference {found.difference:.2g} of "
        f"{found.largest:.3g}, same class {found.equal:.6%}; torch {own:.1f} ms, ONNX {onnx:.1f} "
        f"ms, ratio {ratio:.2f}"
    )


def main(words: list[str]) -> None:
    torch.set_num_threads(1)
    root = next((word.partition("=")[2] for word in words if word.startswith("root=")), "")
    size, *names = [word for word in words if "=" not in word] or ["96,128"]
    height, width = map(int, size.split(","))
    pairs = images((height, width), root)
    for name in names or [each for each in available("model") if each.endswith("_tiny")]:
        print(measure(name, (height, width), pairs), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
