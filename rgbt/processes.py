"""The processes that train one run together, and what they have in common.

Each of W processes has every W-th sample of a batch: process r has the samples r, r + W, r + 2 W,
and so on. What is drawn for a batch is drawn by every process for all samples, from the same
generator, and each keeps its own part (`own`). So the draws of a sample do not depend on W. That
also holds where several copies of a batch are stacked, because W divides the batch.

A loss that is a mean over samples or pixels is computed by each process for its own samples; the
mean over the processes is the loss of the batch. A divisor that depends on the data is that of all
samples, divided by W (`mean_count`). Where a loss is not linear in its sums, the sums are those of
all samples (`total`).

With one process, every function returns its argument. Within `alone`, so does process 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed

Value = TypeVar("Value")

_alone = False


def num_processes() -> int:
    """W, the number of processes of this run; 1 where it is not distributed."""
    return distributed.get_world_size() if _is_distributed() else 1


def rank() -> int:
    """r, the number of this process, 0..W-1. Process 0 writes the files of the run."""
    return distributed.get_rank() if _is_distributed() else 0


def own(whole: Tensor, dim: int = 0) -> Tensor:
    """The part of this process: every W-th entry along `dim`, from the r-th on.

    Args:
        whole: any dtype; entries along `dim` are the samples of all processes, or several stacked
            copies of them.
        dim: the dimension of the samples, >= 0.
    """
    if num_processes() == 1:
        return whole
    return whole[(slice(None),) * dim + (slice(rank(), None, num_processes()),)]


def own_draw(draw: Callable[[int], Tensor], count: int, dim: int = 0) -> Tensor:
    """The part of this process of what is drawn for all samples.

    Args:
        draw: number of samples -> the draws, with the samples along `dim`.
        count: samples of this process.
        dim: as in `own`.
    """
    return own(draw(count * num_processes()), dim)


def whole(part: Tensor) -> Tensor:
    """The parts of all processes in the order of the samples; the inverse of `own` along dim 0.

    No gradient passes. All processes have as many samples: (n, ...) -> (n W, ...).
    """
    if num_processes() == 1:
        return part
    sent = part.detach().contiguous()  # the parts received have its layout
    parts = [torch.empty_like(sent) for _ in range(num_processes())]
    distributed.all_gather(parts, sent)
    return torch.stack(parts, 1).flatten(0, 1)


def total(part: Tensor) -> Tensor:
    """The sum over the processes, of the same shape; its gradient is the sum of their gradients.

    The gradients of parameters are then averaged over the processes, so that a loss that every
    process computes from such sums has the gradient of the loss of the batch.
    """
    if num_processes() == 1:
        return part
    summed: Tensor = _Total.apply(part)  # type: ignore[no-untyped-call]
    return summed


def mean_count(count: Tensor) -> Tensor:
    """The sum over the processes, divided by their number; no gradient passes."""
    if num_processes() == 1:
        return count
    summed = count.detach().float().clone()
    distributed.all_reduce(summed)
    return summed / num_processes()


def largest(number: int) -> int:
    """The largest of the numbers of all processes."""
    if num_processes() == 1:
        return number
    found = torch.tensor(number)
    distributed.all_reduce(found, distributed.ReduceOp.MAX)
    return int(found)


def agreed(value: Value) -> Value:
    """The value of process 0, of any type that can be pickled."""
    if num_processes() == 1:
        return value
    values = [value]
    distributed.broadcast_object_list(values, src=0)
    return values[0]


def collected(value: Value) -> list[Value]:
    """The values of all processes, process by process."""
    if num_processes() == 1:
        return [value]
    values: list[Any] = [None] * num_processes()
    distributed.all_gather_object(values, value)
    return values


@contextmanager
def alone() -> Iterator[None]:
    """A context in which this process works as if it were the only one; the others wait."""
    global _alone
    before, _alone = _alone, True
    try:
        yield
    finally:
        _alone = before


def _is_distributed() -> bool:
    return not _alone and distributed.is_available() and distributed.is_initialized()


class _Total(torch.autograd.Function):
    """Sum over the processes, forwards and backwards."""

    @staticmethod
    def forward(ctx: Any, part: Tensor) -> Tensor:  # noqa: ARG004
        summed = part.clone()
        distributed.all_reduce(summed)
        return summed

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # noqa: ARG004
        summed = gradient.clone()
        distributed.all_reduce(summed)
        return summed
