"""Virtual views of a batch with labels and logits: ours against a loop of OpenCV, in one run.

One batch: 8 frames of 480x640, RGB and thermal bilinear, labels nearest, nine-class logits
bilinear. Ours draws no angles but does all the rest: homographies, largest rectangles, one
composed sampling, and the gradient of the logits. The loop does what the release does per sample,
on NumPy copies and without a gradient: 8-bit image, float label and logits, each warped, cut and
resized. On a GPU the loop includes the copies from and to it, as in the release.

Three rows tell what limits ours: logits sampled by `grid_sample` alone (the same padded frames,
with its own gradient), the gradient as a sparse matrix of SciPy (one thread, classes interleaved
before), and a copy of the bytes that have to be moved. On a CPU the ratio of CPU times counts.

The memory of large tensors is kept as in every training here; "default" leaves the allocator as
the release has it, which costs both about 10 ms a sample.

Run: python -m tests.benchmarks.bench_virtual_views [default]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import cached_property
from typing import Any

from tests.benchmarks.timing import in_turns, seconds  # isort: skip - before torch

import cv2
import numpy as np
import torch
from scipy.sparse import csc_array
from torch import Tensor
from torch.nn import functional as F

from rgbt.engine.device import keep_memory
from rgbt.geometry.camera import Camera, Rule, homography, inner_rectangle
from rgbt.geometry.padding import pad_to
from rgbt.geometry.warp import Resampling, Warp, halved_mean, powers_of_two

HW = (480, 640)
BATCH = 8
CLASSES = 9
AT_LEAST = {"cpu": 1.0, "cuda": 10.0}
ROUNDS = 9
FULL, HALF = "ours, full, with gradient", "ours, half, with gradient"
THREADS = 2

CAMERA = Camera(fx=702.6, fy=703.45, cx=320, cy=240, height=HW[0], width=HW[1])


class Work:
    """Eight frames, their angles, and what to do with them."""

    def __init__(self, device: str) -> None:
        generator = torch.Generator().manual_seed(0)
        self.device = device
        coarse = torch.rand(BATCH, 4, 60, 80, generator=generator)
        self.image = F.interpolate(coarse, HW, mode="bilinear").to(device)
        blocks = torch.randint(0, CLASSES, (BATCH, 30, 40), generator=generator)
        self.label = blocks.repeat_interleave(16, 1).repeat_interleave(16, 2).to(device)
        logits = torch.randn(BATCH, CLASSES, 60, 80, generator=generator)
        self.logits = F.interpolate(logits, HW, mode="bilinear").to(device).requires_grad_()
        self.upstream = torch.randn(BATCH, CLASSES, *HW, generator=generator).to(device)
        self.upstreams = {False: self.upstream, True: halved_mean(self.upstream)}
        limits = torch.tensor([10.0, 10.0, 5.0])
        self.angles = ((2 * torch.rand(BATCH, 3, generator=generator) - 1) * limits).to(device)

    def warp(self, rule: Rule, resampling: Resampling) -> Warp:
        views = homography(self.angles, CAMERA.matrix(HW), "zxy")
        return Warp(views, inner_rectangle(views, HW, rule), HW, resampling)

    def ours(
        self,
        rule: Rule = "largest",
        resampling: Resampling = "once",
        *,
        gradient: bool = True,
        half: bool = False,
    ) -> tuple[Tensor, Tensor, Tensor]:
        warp = self.warp(rule, resampling)
        image, label = warp.bilinear(self.image), warp.nearest(self.label, 255)
        with torch.set_grad_enabled(gradient):
            if half:
                logits = warp.halved().bilinear(halved_mean(self.logits))
            else:
                logits = warp.bilinear(self.logits)
        if gradient:
            self.logits.grad = None
            logits.backward(self.upstreams[half])
        return image, label, logits.detach()

    def opencv(self) -> tuple[Tensor, Tensor, Tensor]:
        warp = self.warp("corners", "twice")
        matrices = warp.homography.cpu().numpy()
        edges = (warp.rectangle + 0.5).int().tolist()
        results = [self._one(b, matrices[b], edges[b]) for b in range(BATCH)]
        image, label, logits = (torch.stack(parts) for parts in zip(*results, strict=True))
        return image.to(self.device), label.to(self.device), logits.to(self.device)

    def _one(self, b: int, matrix: np.ndarray[Any, Any], edges: list[int]) -> tuple[Tensor, ...]:
        def viewed(frame: np.ndarray[Any, Any], how: int) -> np.ndarray[Any, Any]:
            left, top, right, bottom = edges
            canvas = cv2.warpPerspective(frame, matrix, HW[::-1], flags=how)
            return cv2.resize(canvas[top:bottom, left:right], HW[::-1], interpolation=how)

        image = (self.image[b].permute(1, 2, 0).cpu().numpy() * 255).astype(np.uint8)
        label = self.label[b].cpu().numpy().astype(np.float32)
        logits = self.logits[b].detach().permute(1, 2, 0).cpu().numpy()
        return (
            torch.from_numpy(viewed(image, cv2.INTER_LINEAR)).permute(2, 0, 1).float() / 255,
            torch.from_numpy(viewed(label, cv2.INTER_NEAREST)).long(),
            torch.from_numpy(viewed(logits, cv2.INTER_LINEAR)).permute(2, 0, 1),
        )

    def plain(self) -> Tensor:
        """Logits by `grid_sample` alone, of padded frames as ours, forward and backward."""
        self.logits.grad = None
        logits = F.grid_sample(
            pad_to(self.logits, powers_of_two(HW)), self.grid, align_corners=False
        )
        logits.backward(self.upstream)
        return logits

    @cached_property
    def grid(self) -> Tensor:
        """Points of a view that shows 81 % of the frame."""
        padded = powers_of_two(HW)
        sides = (
            (2 * torch.linspace(0.05, 0.95, side) * side / large - 1).to(self.device)
            for side, large in zip(HW, padded, strict=True)
        )
        y, x = torch.meshgrid(*sides, indexing="ij")
        return torch.stack([x, y], -1).expand(BATCH, -1, -1, -1).contiguous()

    def copied(self) -> None:
        """The bytes of images, labels, logits and their gradient, read once and written once."""
        for source in (self.image, self.label, self.logits.detach(), self.upstream):
            torch.empty_like(source).copy_(source)

    @cached_property
    def matrices(self) -> list[tuple[csc_array, np.ndarray[Any, Any]]]:
        """Four weights for each pixel of the grid, and the gradients with classes interleaved."""
        height, width = HW
        x, y = ((self.grid[0, ..., k].flatten() + 1) * side / 2 - 0.5 for k, side in self.sides())
        column, row = x.floor().clamp(max=width - 2), y.floor().clamp(max=height - 2)
        u, v = x - column, y - row
        corner = (row * width + column).int()[:, None]
        pixels = corner + torch.tensor([0, 1, width, width + 1], dtype=torch.int32)
        weights = torch.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], 1)
        first = np.arange(0, 4 * height * width + 1, 4, dtype=np.int32)
        matrix = csc_array(
            (weights.flatten().numpy(), pixels.flatten().numpy(), first),
            shape=(height * width,) * 2,
        )
        rows = self.upstream.permute(0, 2, 3, 1).flatten(1, 2).contiguous()
        return [(matrix, each.numpy()) for each in rows]

    @staticmethod
    def sides() -> tuple[tuple[int, int], ...]:
        """Padded width for x, padded height for y."""
        height, width = powers_of_two(HW)
        return (0, width), (1, height)

    def scattered(self) -> None:
        """The gradient as a product with the transposed sparse matrix."""
        for matrix, rows in self.matrices:
            matrix @ rows


def on_gpu(call: Callable[[], object]) -> tuple[float, float]:
    """CPU seconds, and those between two events in place of the wall clock."""
    torch.cuda.synchronize()
    work = time.process_time()
    begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    begin.record()
    call()
    end.record()
    end.synchronize()
    return time.process_time() - work, float(begin.elapsed_time(end)) / 1e3


def check(work: Work) -> None:
    """Both do the same work: released choices give nearly equal frames."""
    image, label, logits = work.ours("corners", "twice", gradient=False)
    theirs = work.opencv()
    assert float((image - theirs[0]).abs().mean()) < 1.5 / 255, "images differ"
    assert float((label.where(label != 255, 0) != theirs[1]).float().mean()) < 1e-3, "labels differ"
    assert float((logits - theirs[2]).abs().mean()) < 0.01, "logits differ"


def compare(device: str) -> bool:
    work = Work(device)
    check(work)
    calls: dict[str, Callable[[], object]] = {
        "OpenCV loop, no gradient": work.opencv,
        FULL: work.ours,
        HALF: lambda: work.ours(half=True),
        "ours, no gradient": lambda: work.ours(gradient=False),
        "ours, half, no gradient": lambda: work.ours(gradient=False, half=True),
        "ours as released, with gradient": lambda: work.ours("corners", "twice"),
        "logits by grid_sample alone": work.plain,
        "the bytes, copied": work.copied,
    }
    if device == "cpu":
        calls["gradient by a sparse matrix"] = work.scattered
    timed = in_turns(calls, ROUNDS, timer=on_gpu if device == "cuda" else seconds)
    times = {name: 1e3 * pairs[:, ::-1] for name, pairs in timed.items()}  # wall, CPU
    where = torch.cuda.get_device_name() if device == "cuda" else f"{THREADS} threads"
    print(f"{BATCH} x {HW[0]}x{HW[1]}, {CLASSES} classes, {where}, OpenCV {cv2.__version__}")
    print("ms a sample (medians): wall, CPU; times faster than the loop: by wall (range), by CPU")
    loop = times["OpenCV loop, no gradient"]
    for name, values in times.items():
        wall, cpu = np.median(values, axis=0) / BATCH
        low, middle, high = np.quantile(loop[:, 0] / values[:, 0], [0, 0.5, 1])
        by_cpu = np.median(loop[:, 1] / values[:, 1])
        print(
            f"  {name:32s} {wall:7.2f} {cpu:7.2f}"
            f"   {middle:6.2f} ({low:.2f} .. {high:.2f}) {by_cpu:6.2f}"
        )
    column = 0 if device == "cuda" else 1
    for name in (FULL, HALF):
        reached = float(np.median(loop[:, column] / times[name][:, column]))
        print(f"{name}: {reached:.2f} times, wanted {AT_LEAST[device]}")
    return reached >= AT_LEAST[device]


def main() -> int:
    if "default" not in sys.argv[1:]:
        keep_memory()
    torch.set_num_threads(THREADS)
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    return 0 if all([compare(device) for device in devices]) else 1


if __name__ == "__main__":
    sys.exit(main())
