"""Copies of the tensors of a network, with which it can predict."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

Normalisation = Literal["batch", "running"]
"""What batch normalisations use: the statistics of their own batch, or the running statistics."""


class NetworkCopy(nn.Module):
    """The network with copies of its parameters, made when this object is built.

    The copies are buffers of this module, so that a checkpoint can have them.

    Args:
        network: no copy of the module is made, and a wrapper of it counts as it.
        normalisation: "batch": the network is in training mode without dropout, stochastic depth
            and changes of statistics; "running": it is in evaluation mode.
        buffers: whether its buffers, such as running statistics, are copied too; otherwise those
            of the network are used.
    """

    def __init__(
        self, network: nn.Module, *, normalisation: Normalisation, buffers: bool = False
    ) -> None:
        super().__init__()
        self._normalisation = normalisation
        self._copies_buffers = buffers
        # Not registered: the network is not a part of its copy.
        self._of_network = (network,)
        for name, tensor in self._own_tensors():
            self.register_buffer(_key(name), tensor.detach().clone())

    def pairs(self) -> tuple[list[Tensor], list[Tensor]]:
        """The copies, and the tensors of the network in the same order."""
        named = self._own_tensors()
        return [self.get_buffer(_key(name)) for name, _ in named], [tensor for _, tensor in named]

    @contextmanager
    def in_network(self) -> Iterator[None]:
        """Within it, the network predicts with the copies, without gradients.

        Afterwards it has its own parameters, buffers and modes, bit for bit.
        """
        (network,) = self._of_network
        modes = [(module, module.training) for module in network.modules()]
        norms = [module for module, trains in modes if isinstance(module, _BatchNorm) and trains]
        tracking = [module.track_running_stats for module in norms]
        self._exchange(self._own_tensors())
        try:
            network.eval()
            for norm in norms if self._normalisation == "batch" else ():
                norm.train()
                norm.track_running_stats = False
            with torch.no_grad():
                yield
        finally:
            # Backwards: a tensor with two names is exchanged twice.
            self._exchange(self._own_tensors()[::-1])
            for norm, tracks in zip(norms, tracking, strict=True):
                norm.track_running_stats = tracks
            for module, trains in modes:
                module.training = trains

    def _exchange(self, tensors: list[tuple[str, Tensor]]) -> None:
        """Exchange these tensors of the network with their copies, without another copy."""
        for name, own in tensors:
            copied = self.get_buffer(_key(name))
            self._buffers[_key(name)], own.data = own.data, copied

    def _own_tensors(self) -> list[tuple[str, Tensor]]:
        (network,) = self._of_network
        named = network.state_dict(keep_vars=True).items()
        return [
            (name, each)
            for name, each in named
            if self._copies_buffers or isinstance(each, nn.Parameter)
        ]


def _key(name: str) -> str:
    """The name of the buffer of a tensor; a buffer cannot have a dot."""
    return name.replace(".", "/")
