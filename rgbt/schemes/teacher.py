"""Copies of a network that predict beside it: the teacher, which is its moving average."""

from __future__ import annotations

import copy
from typing import Literal

from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm

from rgbt.averaging import AveragedNetwork

Normalisation = Literal["batch", "running"]
"""What batch normalisations use: the statistics of their own batch, or the running statistics."""


def frozen_copy(network: nn.Module) -> nn.Module:
    """The network as it is now, in evaluation mode and without gradients."""
    return copy.deepcopy(network).eval().requires_grad_(False)


class Teacher:
    """The moving average w' of the parameters w of a network, before the update of step t.

        w' <- a w' + (1 - a) w,   a = min(1 - 1 / (t + 1), decay),   t = 0, 1, ...

    In step 0, a is 0 and the teacher is a copy of the network. Buffers are not averaged.

    Source: Tarvainen and Valpola, "Mean teachers are better role models".   Released: DACS,
    DAFormer, HRDA, MIC.

    Args:
        network: the student.
        decay: 0.99 in DACS, 0.999 in DAFormer, HRDA and MIC.
        normalisation: "batch": the teacher is in training mode without dropout, stochastic depth
            and changes of statistics; "running": in evaluation mode. Released: "batch".

    Attributes:
        average: w', which a checkpoint has.
    """

    def __init__(self, network: nn.Module, *, decay: float, normalisation: Normalisation) -> None:
        self.average = AveragedNetwork(network, buffers=False)
        self._student = (network,)  # of which it is no part
        self._decay = decay
        self._normalisation = normalisation
        self._step: int | None = None

    def update(self, step: int) -> None:
        """Average the parameters before `step`; a second call in the same step does nothing."""
        if step != self._step:
            self._step = step
            self.average.update(self._student[0], max(1 / (step + 1), 1 - self._decay))

    def network(self) -> nn.Module:
        """The teacher, ready to predict; normalisations that the student froze stay frozen."""
        teacher: nn.Module = self.average.module.eval()
        if self._normalisation == "batch":
            both = zip(teacher.modules(), self._student[0].modules(), strict=True)
            for norm, own in both:
                if isinstance(norm, _BatchNorm) and own.training:
                    norm.train()
                    norm.track_running_stats = False
        return teacher
