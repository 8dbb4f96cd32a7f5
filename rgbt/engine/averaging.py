"""Average the weights of a network over the steps of its training, for evaluation.

The network trains with its own weights. Its average is put in their place for every evaluation, and
is what `best.pt` and `last.pt` hold. Other networks, such as a discriminator, are not averaged.

Sources: "ema" is the teacher of Tarvainen and Valpola, "Mean teachers are better role models"
(2017). "last" is stochastic weight averaging of Izmailov et al., "Averaging Weights Leads to Wider
Optima and Better Generalization" (2018), but statistics of batch normalisation are averaged, not
estimated again on the training images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn, get_swa_multi_avg_fn

from rgbt.checks import InputError
from rgbt.engine.checkpoint import UNAVERAGED, restore_weights
from rgbt.engine.settings import TrainerSettings
from rgbt.processes import agreed, num_processes

AddToAverage = Callable[[Sequence[Tensor], Sequence[Tensor], int], None]
"""Add tensors to means in place, given the number of values in each mean."""

WARM_UP = 9
"""The decay of step n is at most n / (n + 9), as in TensorFlow's ExponentialMovingAverage."""


class AveragedWeights:
    """The average of the weights of one network, as `settings.averaging` says; "none" has none.

    Parameters and floating-point buffers, such as running statistics of batch normalisation, are
    averaged alike. Integer buffers are those of the last step. All are derived from the weights of
    each step and from its number, so that processes with equal weights have equal averages.

    Args:
        model: the network that is trained, with its initial weights. Its forward may be compiled:
            no copy of the module is made.
        settings: of the training loop.
    """

    def __init__(self, model: nn.Module, settings: TrainerSettings) -> None:
        self._model = model
        self._kind = settings.averaging
        self._decay = settings.ema_decay
        averaged_steps = max(1, round(settings.averaged_share * settings.max_steps))
        self._before = settings.max_steps - averaged_steps
        self._average: dict[str, Tensor] = self._copied() if self._kind == "ema" else {}

    def update(self, step: int) -> None:
        """Add the weights after `step` optimizer steps, >= 1; called after every step."""
        if self._kind == "ema":
            decay = min(self._decay, step / (step + WARM_UP))
            self._add(get_ema_multi_avg_fn(decay), step)  # type: ignore[no-untyped-call]
        elif self._kind == "last" and step == self._before + 1:
            self._average = self._copied()
        elif self._kind == "last" and step > self._before:
            self._add(get_swa_multi_avg_fn(), step - self._before - 1)  # type: ignore[no-untyped-call]

    def weights(self) -> dict[str, Tensor]:
        """The weights to evaluate, by name: the average, or those of the network before it begins.

        They are not copied.
        """
        return self._average or self._model.state_dict()

    def unaveraged(self) -> dict[str, Tensor] | None:
        """The weights of the network, by name, to resume from; None where `weights` has them."""
        return self._model.state_dict() if self._average else None

    @contextmanager
    def in_network(self) -> Iterator[None]:
        """Within it, the network has the weights to evaluate; afterwards its own, bit for bit."""
        if not self._average:
            yield
            return
        own = self._copied()
        self._model.load_state_dict(self._average)
        try:
            yield
        finally:
            self._model.load_state_dict(own)

    def restore(self, payload: Mapping[str, dict[str, Tensor]], step: int, source: Path) -> None:
        """Restore the network and its average from a checkpoint of `step`.

        Raises:
            InputError: it is of another network, or of a run with another averaging.
        """
        is_averaged = self._kind == "ema" or (self._kind == "last" and step > self._before)
        if is_averaged != (UNAVERAGED in payload):
            raise InputError(
                f"{source} is a checkpoint of a run {'without' if is_averaged else 'with'} "
                f"averaged weights, but trainer.averaging is {self._kind}. Resume with the "
                "settings that wrote it, or train again in another runs_dir=..."
            )
        if is_averaged:
            restore_weights(self._model, payload["model"], source)
            self._average = self._copied()
        restore_weights(self._model, payload[UNAVERAGED if is_averaged else "model"], source)

    def share_buffers(self) -> None:
        """Give every process the averaged buffers of process 0; called by all processes."""
        if num_processes() == 1 or not self._average:
            return
        named = self._model.state_dict(keep_vars=True)
        buffers = {
            name: self._average[name]
            for name, tensor in named.items()
            if not isinstance(tensor, nn.Parameter)
        }
        for name, value in agreed({name: each.cpu() for name, each in buffers.items()}).items():
            buffers[name].copy_(value)

    def _copied(self) -> dict[str, Tensor]:
        return {name: each.detach().clone() for name, each in self._model.state_dict().items()}

    @torch.no_grad()
    def _add(self, add: AddToAverage, count: int) -> None:
        pairs = [(self._average[name], each) for name, each in self._model.state_dict().items()]
        means, values = zip(*(pair for pair in pairs if pair[0].is_floating_point()), strict=True)
        add(means, values, count)
        for mean, value in pairs:
            if not mean.is_floating_point():
                mean.copy_(value)
