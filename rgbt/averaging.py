"""The average of the weights of a network over the steps of its training.

One class for the moving average and the mean of the last steps that are evaluated
(`rgbt.engine.checkpoint`), and for the teacher of self-training.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

Tensors = tuple[Tensor, ...] | list[Tensor]


class AveragedNetwork(AveragedModel):
    """Averages the weights of a network over the steps, in a copy of it, `module`.

        w' <- w' + share (w - w')

    A share of 1 copies the weights, and of 1 / n makes w' their mean over n updates. Integer
    buffers are always copied. No gradient reaches w'.

    Args:
        network: with the weights that the average begins with; it may be wrapped by Fabric.
        buffers: whether floating-point buffers, such as running statistics, are averaged like
            parameters; otherwise they are copied.
    """

    def __init__(self, network: nn.Module, *, buffers: bool) -> None:
        super().__init__(network, multi_avg_fn=self._average, use_buffers=buffers)
        self.requires_grad_(False)
        self._share = 1.0
        # torch copies the weights in the first update; here the copy is the first value.
        self.n_averaged.fill_(1)

    def update(self, network: nn.Module, share: float) -> None:
        """Average the weights of `network`, which have a weight of `share`, 0..1."""
        self._share = share
        self.update_parameters(network)

    @torch.no_grad()
    def _average(self, means: Tensors, values: Tensors, count: object) -> None:
        """Average tensors of one device and dtype; the count of torch is not used."""
        del count
        if self._share < 1 and means[0].is_floating_point():
            torch._foreach_lerp_(means, values, self._share)
        else:
            torch._foreach_copy_(means, values)
