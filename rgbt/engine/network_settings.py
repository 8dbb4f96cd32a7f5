"""Settings of the trainer that change how a network computes, but not what.

Memory format, activation checkpointing, and `torch.compile` of the forward pass in training.
"""

from __future__ import annotations

import re
import warnings
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import nn
from torch.utils.checkpoint import checkpoint

from rgbt.checks import InputError
from rgbt.engine.settings import TrainerSettings
from rgbt.requirements import record_of

MODES = {"default": "default", "max-autotune": "max-autotune-no-cudagraphs"}
"""`trainer.compile` -> mode of `torch.compile`. CUDA graphs are left out: the passes of one step
would overwrite each other's results."""


def place(network: nn.Module, device: torch.device, settings: TrainerSettings) -> nn.Module:
    """The network on `device`, its kernels in `settings.memory_format`.

    A convolution whose kernel is "channels_last" returns such maps, so the images need not be
    converted.
    """
    if settings.memory_format == "contiguous":
        return network.to(device)
    moved: nn.Module = network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    return moved


def prepare_training(network: nn.Module, settings: TrainerSettings) -> None:
    """Checkpoint the activations of a network and compile its forward in place, as set.

    The keys of its state do not change, and evaluation uses the network as it is.

    Raises:
        InputError: both, or a network that does not declare what is recomputed.
    """
    if settings.activation_checkpointing and settings.compile != "none":
        raise InputError(
            "trainer.activation_checkpointing: cannot be used with trainer.compile, because a "
            "graph recomputes by rules of its own."
        )
    if settings.activation_checkpointing:
        recompute_activations(network)
    if settings.compile != "none":
        # The graph recomputes what these functions keep per size, which costs little.
        warnings.filterwarnings("ignore", message=r"(?s).*lru_cache", category=UserWarning)
        object.__setattr__(network, "forward", Compiled(network, MODES[settings.compile]))


class Compiled:
    """The forward of a network: compiled in training, the network's own in evaluation.

    Matching and losses stay outside of the graph. A graph is made at the first step, for one size
    of images; a second size makes one for all.

    Args:
        network: its `forward` is compiled at the first call.
        mode: of `torch.compile`.
    """

    def __init__(self, network: nn.Module, mode: str) -> None:
        self.network = network
        self.plain = network.forward
        self.compiled = torch.compile(network.forward, mode=mode)

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """Call the forward."""
        trains = self.network.training and torch.is_grad_enabled()
        return (self.compiled if trains else self.plain)(*arguments, **keywords)


def recompute_activations(network: nn.Module) -> None:
    """Compute activations of the modules in `Record.recomputed` again in the backward pass.

    Losses, gradients and running statistics keep their bits. Networks draw nothing in these
    modules, so no generator has to be restored.

    Raises:
        InputError: the network declares no such module.
    """
    patterns = [
        re.compile(re.escape(each).replace(r"\*", "[^.]*"))
        for each in record_of(network).recomputed
    ]
    modules = [
        module
        for name, module in network.named_modules()
        if any(pattern.fullmatch(name) for pattern in patterns)
    ]
    if not modules:
        raise InputError(
            "trainer.activation_checkpointing: no module of the network has a name that the record "
            f'of {type(network).__name__} declares; write recomputed=("blocks.*",) there.'
        )
    for module in modules:
        object.__setattr__(module, "forward", Recomputed(module))


class Recomputed:
    """The forward of a module that keeps its inputs alone in training.

    Args:
        module: its own `forward` is called; arguments and results are unchanged.
    """

    def __init__(self, module: nn.Module) -> None:
        self.module = module
        self.forward = module.forward

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """Call the forward; with gradient in training mode, keep nothing of what it computes."""
        if not (self.module.training and torch.is_grad_enabled()):
            return self.forward(*arguments, **keywords)
        return checkpoint(
            self.forward,
            *arguments,
            use_reentrant=False,
            preserve_rng_state=False,
            context_fn=lambda: (nullcontext(), KeptStatistics(self.module)),
            **keywords,
        )


class KeptStatistics(AbstractContextManager[None]):
    """Within it, buffers are copies, so that running statistics are updated in the forward alone.

    Batch normalisation returns the same, because training normalises by the statistics of the
    batch. It is entered again in each backward pass through the same graph.
    """

    def __init__(self, module: nn.Module) -> None:
        self.module = module

    def __enter__(self) -> None:
        modules = self.module.modules()
        self.kept = [(each, dict(each.named_buffers(recurse=False))) for each in modules]
        for each, buffers in self.kept:
            for name, buffer in buffers.items():
                setattr(each, name, buffer.clone())

    def __exit__(self, *_: object) -> None:
        for each, buffers in self.kept:
            for name, buffer in buffers.items():
                setattr(each, name, buffer)
