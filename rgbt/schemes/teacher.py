"""A teacher: the network with the moving average of its own parameters."""

from __future__ import annotations

from contextlib import AbstractContextManager

import torch
from torch import nn

from rgbt.schemes.network_copy import NetworkCopy, Normalisation


class Teacher:
    """The moving average w' of the parameters w of a network, before the update of step t.

        w' <- a w' + (1 - a) w,   a = min(1 - 1 / (t + 1), decay),   t = 0, 1, ...

    In step 0, a is 0 and the teacher is a copy of the network. Buffers are not averaged.

    Source: Tarvainen and Valpola, "Mean teachers are better role models".   Released: DACS,
    DAFormer, HRDA, MIC.

    Args:
        network: the student.
        decay: 0.99 in DACS, 0.999 in DAFormer, HRDA and MIC.
        normalisation: see `NetworkCopy`; released: "batch".

    Attributes:
        average: w', which a checkpoint has.
    """

    def __init__(self, network: nn.Module, *, decay: float, normalisation: Normalisation) -> None:
        self.average = NetworkCopy(network, normalisation=normalisation)
        self._decay = decay
        self._step: int | None = None

    def update(self, step: int) -> None:
        """Average the parameters before `step`; a second call in the same step does nothing."""
        if step == self._step:
            return
        self._step = step
        share = max(1 / (step + 1), 1 - self._decay)
        averages, own = self.average.pairs()
        with torch.no_grad():
            torch._foreach_lerp_(averages, own, share)

    def in_network(self) -> AbstractContextManager[None]:
        """Within it, the network predicts as the teacher (`NetworkCopy.in_network`)."""
        return self.average.in_network()
