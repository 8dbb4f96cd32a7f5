"""Kernels, views, FLOPs and bytes of one CRM step, counted on a CPU without a GPU.

Bytes are those of the inputs and outputs of every operation that is no view. An eager step needs at
least bytes / bandwidth and FLOPs / rate, and about four microseconds for every kernel.

The criterion and the deformable attention work in the chunks that they have on a GPU. With
``fused=yes``, functions marked by `rgbt.fusion` without a gradient of their own are counted as one
kernel that reads its arguments and writes its results, as `trainer.compile=functions` makes them.

Run: python -m tests.benchmarks.bench_traffic [swin_s] [batch=2] [top=25] [fused=yes]
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry

from rgbt.assembly.training_setup import set_up_training
from rgbt.config.compose import compose
from rgbt.engine.checkpoint import State
from rgbt.losses import set_criterion
from rgbt.models.mask2former import head
from rgbt.runs.specify import specify
from tests.benchmarks.gpu_step import write_images
from tests.benchmarks.loop import trainer_of

# Operations that make no new memory.
VIEWS = frozenset(
    (
        *("view", "_unsafe_view", "permute", "transpose", "t", "expand", "slice", "select"),
        *("unsqueeze", "squeeze", "detach", "alias", "as_strided", "split", "split_with_sizes"),
        *("unbind", "chunk", "_reshape_alias", "unfold", "view_as_complex", "view_as_real"),
    )
)
# Bytes and FLOPs of a second of an H100 (HBM3; TF32 as matrix products reach it), kernels' start.
BANDWIDTH, RATE, START = 3.0e12, 3.5e14, 4e-6


class Traffic(TorchDispatchMode):
    """Counts what operations read and write, by place of the code and by operation."""

    def __init__(self) -> None:
        super().__init__()
        self.kernels: Counter[str] = Counter()
        self.views: Counter[str] = Counter()
        self.bytes: Counter[tuple[str, str, str]] = Counter()
        self.calls: Counter[tuple[str, str, str]] = Counter()
        self.flops = 0
        self.is_counting = False

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__
        if name in VIEWS:
            self.views[name] += 1
            return found
        self.kernels[name] += 1
        moved = 0
        for leaf in tree_leaves((args, kwargs, found)):
            if isinstance(leaf, Tensor):
                moved += leaf.numel() * leaf.element_size()
        shape = str(tuple(found.shape)) if isinstance(found, Tensor) else ""
        self.bytes[code_of(sys._getframe(1)), name, shape] += moved
        self.calls[code_of(sys._getframe(1)), name, shape] += 1
        if func._overloadpacket in flop_registry:
            self.flops += flop_registry[func._overloadpacket](
                *args, **(kwargs or {}), out_val=found
            )
        return found

    def add_fused(self, function: Callable[..., Any], *, dynamic: bool) -> Callable[..., Any]:
        """Stand for `torch.compile`: call a function that is counted as one kernel."""
        assert dynamic, "as rgbt.fusion compiles"

        def call(*arguments: Any) -> Any:
            leaves = tree_leaves(arguments)
            if not self.is_counting:
                return function(*arguments)
            if torch.is_grad_enabled() and any(_has_gradient(leaf) for leaf in leaves):
                return function(*arguments)
            with _disable_current_modes():
                found = function(*arguments)
            moved = 0
            for leaf in (*leaves, *tree_leaves(found)):
                if isinstance(leaf, Tensor):
                    moved += leaf.numel() * leaf.element_size()
            key = code_of(sys._getframe(1)), f"fused {function.__name__}", ""
            self.kernels["fused"] += 1
            self.bytes[key] += moved
            self.calls[key] += 1
            return found

        return call


def _has_gradient(leaf: object) -> bool:
    return isinstance(leaf, Tensor) and leaf.requires_grad


def code_of(frame: Any) -> str:
    """Name the innermost function of rgbt that is being called; the backward pass has none."""
    while frame is not None:
        path = frame.f_code.co_filename
        if "/rgbt/" in path and "site-packages" not in path and "/engine/" not in path:
            return f"{path.rsplit('/rgbt/', 1)[1]}:{frame.f_code.co_name}"
        frame = frame.f_back
    return "backward, optimizer"


class _Batches:
    """The same batch for two steps, of which the second one is counted."""

    def __init__(self, batch: Any, traffic: Traffic) -> None:
        self.batch, self.traffic, self.number = batch, traffic, 0

    def __iter__(self) -> _Batches:
        return self

    def __next__(self) -> Any:
        """The batch; `KeyboardInterrupt` after the counted step."""
        self.number += 1
        if self.number == 2:
            self.traffic.__enter__()
            self.traffic.is_counting = True
        if self.number == 3:
            self.traffic.__exit__(None, None, None)
            raise KeyboardInterrupt
        return self.batch


def count(network: str, batch_size: int, *, is_fused: bool = False) -> Traffic:
    """Count a step of CRM as published, with random images and weights."""
    traffic = Traffic()
    with (
        TemporaryDirectory() as folder,
        mock.patch.object(set_criterion, "CHUNK_BYTES", set_criterion.CHUNK_BYTES_GPU),
        mock.patch.object(head, "BLOCK_BYTES", 2**40),
        mock.patch.object(torch, "compile", traffic.add_fused),
    ):
        images = Path(folder, "images")
        write_images(images, 2 * batch_size, (480, 640))
        words = ["+experiment=crm", "scale=paper", f"model=mask2former_{network}"]
        words += ["tracking=none", "trainer.accelerator=cpu", f"dataset.root={images}"]
        words += ["data.num_workers=0", f"recipe.batch_size={batch_size}", "scale.pretrained=false"]
        words += [f"trainer.compile={'functions' if is_fused else 'none'}"]
        setup = set_up_training(specify(compose(words), words), upstream_finished=False)
        trainer = trainer_of(setup, Path(folder))
        batch = next(setup.batches(range(2)))
        try:
            trainer.fit(_Batches(batch, traffic), State(seed=0))
        except KeyboardInterrupt:
            return traffic
    raise AssertionError("unreachable: the batches end with KeyboardInterrupt")


def main(network: str = "swin_s", batch: str = "2", top: str = "25", fused: str = "no") -> None:
    """Print the totals, and what moves most."""
    traffic = count(network, int(batch), is_fused=fused == "yes")
    kernels, moved = sum(traffic.kernels.values()), sum(traffic.bytes.values())
    print(
        f"{network}, batch {batch}, 256x320: {kernels} kernels, {sum(traffic.views.values())} "
        f"views, {traffic.flops / 1e9:.0f} GFLOP, {moved / 1e9:.1f} GB moved. On an H100 at least "
        f"{1e3 * moved / BANDWIDTH:.0f} ms for the bytes, {1e3 * traffic.flops / RATE:.0f} ms for "
        f"the FLOPs (TF32), {1e3 * kernels * START:.0f} ms to start the kernels.\n"
    )
    print("|    GB | calls | operation | place | shape |\n|---|---|---|---|---|")
    for key, value in traffic.bytes.most_common(int(top)):
        place, name, shape = key
        print(f"| {value / 1e9:5.2f} | {traffic.calls[key]:5} | {name} | {place} | {shape} |")
    print("\nkernels:", traffic.kernels.most_common(40))
    print("views:", traffic.views.most_common(12))


if __name__ == "__main__":
    given = dict(word.split("=", 1) for word in sys.argv[1:] if "=" in word)
    main(*[word for word in sys.argv[1:] if "=" not in word], **given)
