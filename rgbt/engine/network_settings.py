"""Apply the settings of the trainer that change how a network computes, but not what."""

from __future__ import annotations

import torch
from torch import nn

from rgbt.checks import InputError
from rgbt.engine.settings import TrainerSettings


def place(network: nn.Module, device: torch.device, settings: TrainerSettings) -> nn.Module:
    """The network on `device`, its kernels in `settings.memory_format`.

    A convolution whose kernel is "channels_last" returns such maps, so the images need not be
    converted.

    Raises:
        InputError: a network without two-dimensional convolutions.
    """
    if settings.memory_format == "contiguous":
        return network.to(device)
    if not any(isinstance(module, nn.Conv2d) for module in network.modules()):
        raise InputError(
            f"trainer.memory_format=channels_last requires two-dimensional convolutions, but "
            f"{type(network).__name__} has none; set trainer.memory_format=contiguous."
        )
    moved: nn.Module = network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    return moved


def prepare_training(network: nn.Module, settings: TrainerSettings, device: torch.device) -> None:
    """Checkpoint the activations of a network and compile it in place, as the settings say.

    Raises:
        InputError: a network or a machine that cannot follow a setting.
    """
    if settings.activation_checkpointing and settings.compile != "none":
        raise InputError(
            f"trainer.activation_checkpointing=true cannot be used with trainer.compile="
            f"{settings.compile}, because a graph recomputes by rules of its own; set one of them "
            "to its default (false or none)."
        )
    if settings.activation_checkpointing:
        from rgbt.engine.recomputation import recompute_activations

        recompute_activations(network)
    if settings.compile != "none":
        from rgbt.engine.compilation import compile_training

        compile_training(network, settings.compile, device)
