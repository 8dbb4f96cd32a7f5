"""The processes that train one run together, and what they have in common.

Each of W processes has every W-th sample of a batch: process r has the samples r, r + W, r + 2 W,
and so on. What is drawn for a batch is drawn by every process for all samples, from the same
generator, and each keeps its own part (`own`). So the draws of a sample do not depend on W. That
also holds where several copies of a batch are stacked, because W divides the batch.

A loss that is a mean over samples or pixels is computed by each process for its own samples; the
mean over the processes is the loss of the batch. A divisor that depends on the data is that of all
samples, divided by W (`mean_count`). Where a loss is not linear in its sums, the sums are those of
all samples (`total`).

With one process, every function returns its argument. What process 0 does for all of them, such as
looking at files, is a function given to `computed_once`. Whether a process writes the files of the
run is decided in one place, where it opens the run folder (`rgbt.training.train.train_run`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed, nn

Value = TypeVar("Value")

# Whether process 0 computes something for all (`computed_once`), as if it were the only process.
_is_alone = False


def num_processes() -> int:
    """Return W, the number of processes of this run; 1 where it is not distributed."""
    return distributed.get_world_size() if _is_distributed() else 1


def rank() -> int:
    """Return r, the number of this process, 0..W-1."""
    return distributed.get_rank() if _is_distributed() else 0


def own(whole: Tensor, dim: int = 0) -> Tensor:
    """Return the part of this process: every W-th entry along `dim`, from the r-th on.

    Args:
        whole: any dtype; entries along `dim` are the samples of all processes, or several stacked
            copies of them.
        dim: the dimension of the samples, >= 0.
    """
    if num_processes() == 1:
        return whole
    return whole[(slice(None),) * dim + (slice(rank(), None, num_processes()),)]


def own_draw(draw: Callable[[int], Tensor], count: int, dim: int = 0) -> Tensor:
    """Draw for the samples of all processes, and return the part of this process.

    Args:
        draw: number of samples -> the draws, with the samples along `dim`.
        count: samples of this process.
        dim: as in `own`.
    """
    return own(draw(count * num_processes()), dim)


def whole(part: Tensor) -> Tensor:
    """Join the parts of all processes in the order of the samples: the inverse of `own`, dim 0.

    No gradient passes. All processes have as many samples: (n, ...) -> (n W, ...).
    """
    if num_processes() == 1:
        return part
    sent = part.detach().contiguous()  # the parts received have its layout
    parts = [torch.empty_like(sent) for _ in range(num_processes())]
    distributed.all_gather(parts, sent)
    return torch.stack(parts, 1).flatten(0, 1)


def total(part: Tensor) -> Tensor:
    """Sum over the processes, in the same shape; its gradient is the sum of their gradients.

    The gradients of parameters are then averaged over the processes, so that a loss that every
    process computes from such sums has the gradient of the loss of the batch.
    """
    if num_processes() == 1:
        return part
    summed: Tensor = _Total.apply(part)  # type: ignore[no-untyped-call]
    return summed


def mean_count(count: Tensor) -> Tensor:
    """Return the sum over the processes, divided by their number; no gradient passes."""
    if num_processes() == 1:
        return count
    summed = count.detach().float().clone()
    distributed.all_reduce(summed)
    return summed / num_processes()


@torch.no_grad()
def average_gradients(parameters: Sequence[nn.Parameter]) -> None:
    """Replace each gradient by its mean over the processes, after the last pass of a phase.

    A step may have several forward passes, heads that one domain alone uses, and parameters that
    two optimizers step, unlike in DistributedDataParallel. What a parameter kept from an earlier
    phase is the mean already. No gradient is 0 where another process has one.
    """
    if num_processes() == 1:
        return
    used = mean_count(torch.tensor([parameter.grad is not None for parameter in parameters]))
    by_dtype: dict[torch.dtype, list[Tensor]] = {}
    for parameter, share in zip(parameters, used.tolist(), strict=True):
        if not share:
            continue
        if parameter.grad is None:
            parameter.grad = torch.zeros_like(parameter)
        by_dtype.setdefault(parameter.dtype, []).append(parameter.grad)
    for gradients in by_dtype.values():
        flat = torch.cat([gradient.reshape(-1) for gradient in gradients])
        distributed.all_reduce(flat)
        flat /= num_processes()
        parts = torch.split(flat, [gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view(gradient.shape))


def largest(number: int) -> int:
    """Return the largest of the numbers of all processes."""
    if num_processes() == 1:
        return number
    found = torch.tensor(number)
    distributed.all_reduce(found, distributed.ReduceOp.MAX)
    return int(found)


def computed_once(compute: Callable[[], Value]) -> Value:
    """Return to every process what process 0 computes as if it were the only one; the others wait.

    The value is of any type that can be pickled. An error of `compute` is raised in process 0
    alone; torchrun or srun end the others.
    """
    global _is_alone
    if num_processes() == 1:
        return compute()
    values: list[Any] = [None]
    if rank() == 0:
        _is_alone = True
        try:
            values = [compute()]
        finally:
            _is_alone = False
    distributed.broadcast_object_list(values, src=0)
    found: Value = values[0]
    return found


def collected(value: Value) -> list[Value]:
    """Return the values of all processes, process by process."""
    if num_processes() == 1:
        return [value]
    values: list[Any] = [None] * num_processes()
    distributed.all_gather_object(values, value)
    return values


def _is_distributed() -> bool:
    return not _is_alone and distributed.is_available() and distributed.is_initialized()


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
