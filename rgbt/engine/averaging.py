"""Which weights of a network are evaluated: those of the last step, or an average over steps.

The network trains with its own weights. Its average is a copy of the network, which is evaluated in
its place, and whose weights `best.pt` and `last.pt` hold. Other networks, such as a discriminator,
are not averaged.

Sources: "ema" is the teacher of Tarvainen and Valpola, "Mean teachers are better role models"
(2017). "last" is stochastic weight averaging of Izmailov et al., "Averaging Weights Leads to Wider
Optima and Better Generalization" (2018), but statistics of batch normalisation are averaged, not
estimated again on the training images.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor, nn

from rgbt.averaging import AveragedNetwork
from rgbt.engine.checkpoint import UNAVERAGED, restore_weights
from rgbt.engine.settings import TrainerSettings

WARM_UP = 9
"""The decay of step n is at most n / (n + 9), as in TensorFlow's ExponentialMovingAverage."""


class EvaluatedWeights:
    """The weights of a network that are evaluated, as `settings.averaging` says.

    Parameters and floating-point buffers are averaged alike. All are derived from the weights of
    each step and from its number, so that processes with equal weights have equal averages.

    Args:
        model: the network that is trained, with its initial weights.
        settings: of the training loop.
    """

    def __init__(self, model: nn.Module, settings: TrainerSettings) -> None:
        self._model = model
        self._settings = settings
        self._average = None
        if settings.averaging != "none":
            self._average = AveragedNetwork(model, buffers=True)
        self._is_begun = settings.averaging == "ema"

    def share(self, step: int) -> float:
        """Weight of the network after `step` steps, >= 1, in its average; 0: it has none yet."""
        settings = self._settings
        if settings.averaging == "ema":
            return 1 - min(settings.ema_decay, step / (step + WARM_UP))
        averaged = max(1, round(settings.averaged_share * settings.max_steps))
        number = step - (settings.max_steps - averaged)
        return 1 / number if settings.averaging == "last" and number > 0 else 0.0

    def update(self, step: int) -> None:
        """Add the weights after `step` optimizer steps, >= 1; called after every step."""
        share = self.share(step)
        if self._average is not None and share:
            self._average.update(self._model, share)
            self._is_begun = True

    @property
    def network(self) -> nn.Module:
        """The network to evaluate: the average, or the trained one before an average begins."""
        average = self._average if self._is_begun else None
        return self._model if average is None else average.module

    def state(self) -> dict[str, dict[str, Tensor]]:
        """Weights to evaluate ("model"), and to resume from where these are others."""
        weights = {"model": self.network.state_dict()}
        own = {UNAVERAGED: self._model.state_dict()}
        return weights if self.network is self._model else weights | own

    def restore(self, payload: Mapping[str, dict[str, Tensor]], source: Path) -> None:
        """Restore the network and its average from a checkpoint; InputError: of another network."""
        self._is_begun = UNAVERAGED in payload
        restore_weights(self.network, payload["model"], source)
        if self._is_begun:
            restore_weights(self._model, payload[UNAVERAGED], source)
