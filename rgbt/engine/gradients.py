"""Average the gradients of the processes of a run.

There is no wrapper like DistributedDataParallel. A step may have several forward passes, heads that
one domain alone uses, and parameters that two optimizers step, so the gradients of a phase are
averaged once, after its last backward pass. What a parameter kept from an earlier phase is the mean
already, and the mean of that is the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, distributed, nn

from rgbt.checks import RunError
from rgbt.processes import collected, num_processes

BUCKET_BYTES = 64 * 2**20
"""Gradients are sent in pieces of about this size, so that there is no second copy of all."""


@torch.no_grad()
def average_gradients(parameters: Sequence[nn.Parameter]) -> None:
    """Replace each gradient by its mean over the processes; nothing with one process.

    Args:
        parameters: in the same order in all processes, which have gradients for the same ones.
    """
    if num_processes() == 1:
        return
    for bucket in _buckets([each.grad for each in parameters if each.grad is not None]):
        flat = torch.cat([gradient.reshape(-1) for gradient in bucket])
        distributed.all_reduce(flat)
        flat /= num_processes()
        parts = torch.split(flat, [gradient.numel() for gradient in bucket])
        for gradient, part in zip(bucket, parts, strict=True):
            gradient.copy_(part.view(gradient.shape))


def check_gradients(parameters: Sequence[nn.Parameter], phase: str) -> None:
    """Refuse processes that have gradients for different parameters, naming the phase.

    Raises:
        RunError: the mean would be of different parameters.
    """
    of_all = collected([each.grad is not None for each in parameters])
    differing = sum(len(set(flags)) > 1 for flags in zip(*of_all, strict=True))
    if differing:
        raise RunError(
            f"the processes have gradients for different parameters ({differing} of "
            f"{len(parameters)} in the phase of {phase}), so these cannot be averaged. The passes "
            "of a scheme must not depend on the samples of one process; train with "
            "trainer.devices=1, or correct the scheme."
        )


def _buckets(gradients: Sequence[Tensor]) -> Iterator[list[Tensor]]:
    """The gradients in order, in lists of one dtype and about `BUCKET_BYTES`."""
    bucket: list[Tensor] = []
    for gradient in gradients:
        size = sum(each.nbytes for each in bucket)
        if bucket and (size + gradient.nbytes > BUCKET_BYTES or bucket[0].dtype != gradient.dtype):
            yield bucket
            bucket = []
        bucket.append(gradient)
    if bucket:
        yield bucket
