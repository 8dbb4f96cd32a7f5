"""A teacher: the network with the moving average of its own parameters."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import torch
from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm

Normalisation = Literal["batch", "running"]
"""What batch normalisations of the teacher use: the statistics of its own batch, or the running
statistics of the student."""


class Teacher(nn.Module):
    """The moving average w' of the parameters w of a network, before the update of step t.

        w' <- a w' + (1 - a) w,   a = min(1 - 1 / (t + 1), decay),   t = 0, 1, ...

    In step 0, a is 0 and the teacher is a copy of the network. Buffers are not averaged. The
    averages are buffers of this module, so that a checkpoint has them.

    Source: Tarvainen and Valpola, "Mean teachers are better role models".   Released: DACS,
    DAFormer, HRDA, MIC.

    Args:
        network: the student; no copy of the module is made, and a wrapper of it counts as it.
        decay: 0.99 in DACS, 0.999 in DAFormer, HRDA and MIC.
        normalisation: "batch": the teacher is in training mode without dropout, stochastic depth
            and changes of statistics (released); "running": it is in evaluation mode.
    """

    def __init__(self, network: nn.Module, *, decay: float, normalisation: Normalisation) -> None:
        super().__init__()
        self._decay = decay
        self._normalisation = normalisation
        self._step: int | None = None
        # Not registered: the network is not a part of its teacher.
        self._of_network = (network,)
        for name, tensor in self._parameters_of_network():
            self.register_buffer(_key(name), tensor.detach().clone())

    def update(self, step: int) -> None:
        """Average the parameters before `step`; a second call in the same step does nothing."""
        if step == self._step:
            return
        self._step = step
        share = max(1 / (step + 1), 1 - self._decay)
        named = self._parameters_of_network()
        averages = [self.get_buffer(_key(name)) for name, _ in named]
        with torch.no_grad():
            torch._foreach_lerp_(averages, [tensor for _, tensor in named], share)

    @contextmanager
    def in_network(self) -> Iterator[None]:
        """Within it, the network predicts as the teacher, without gradients.

        Afterwards it has its own parameters, buffers and modes, bit for bit.
        """
        (network,) = self._of_network
        modes = [(module, module.training) for module in network.modules()]
        norms = [module for module, trains in modes if isinstance(module, _BatchNorm) and trains]
        tracking = [module.track_running_stats for module in norms]
        self._exchange()
        try:
            network.eval()
            for norm in norms if self._normalisation == "batch" else ():
                norm.train()
                norm.track_running_stats = False
            with torch.no_grad():
                yield
        finally:
            self._exchange()
            for norm, tracks in zip(norms, tracking, strict=True):
                norm.track_running_stats = tracks
            for module, trains in modes:
                module.training = trains

    def _exchange(self) -> None:
        """Exchange the parameters of the network with the averages, without a copy."""
        for name, parameter in self._parameters_of_network():
            average = self.get_buffer(_key(name))
            self._buffers[_key(name)], parameter.data = parameter.data, average

    def _parameters_of_network(self) -> list[tuple[str, nn.Parameter]]:
        (network,) = self._of_network
        named = network.state_dict(keep_vars=True).items()
        return [(name, each) for name, each in named if isinstance(each, nn.Parameter)]


def _key(name: str) -> str:
    """The name of the buffer of a parameter; a buffer cannot have a dot."""
    return name.replace(".", "/")
