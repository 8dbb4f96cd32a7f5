"""Compile the forward pass of a network in training with `torch.compile`.

Matching and losses stay outside of the graph. Evaluation uses the network as it is, so that images
of other sizes are not compiled again.
"""

from __future__ import annotations

import warnings
from typing import Any, Literal

import torch
from torch import nn

from rgbt.checks import InputError

MODES: dict[str, str] = {"default": "default", "max-autotune": "max-autotune-no-cudagraphs"}
"""`trainer.compile` -> mode of `torch.compile`. CUDA graphs are left out: the passes of one step
would overwrite each other's results."""


def compile_training(
    network: nn.Module, mode: Literal["default", "max-autotune"], device: torch.device
) -> None:
    """Compile the forward of `network` in place; the keys of its state do not change.

    A graph is made at the first step, for one size of images; a second size makes one for all.

    Raises:
        InputError: the machine has no compiler for `device`.
    """
    check_compiler(mode, device)
    # The graph recomputes what these functions keep per size, which costs little.
    warnings.filterwarnings("ignore", message=r"(?s).*lru_cache", category=UserWarning)
    object.__setattr__(network, "forward", Compiled(network, MODES[mode]))


class Compiled:
    """The forward of a network: compiled in training, the network's own in evaluation.

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


def check_compiler(mode: str, device: torch.device) -> None:
    """Refuse to compile where what `torch.compile` calls is missing.

    Raises:
        InputError: no C++ compiler for a CPU, no Triton for a GPU.
    """
    if device.type == "cuda":
        from torch.utils._triton import has_triton

        if not has_triton():
            raise InputError(
                f"trainer.compile={mode} requires Triton on a GPU, but this Python has none that "
                "supports it; install triton, or set trainer.compile=none."
            )
        return
    from torch._inductor.cpp_builder import get_cpp_compiler
    from torch._inductor.exc import InvalidCxxCompiler

    try:
        get_cpp_compiler()
    except InvalidCxxCompiler as error:
        raise InputError(
            f"trainer.compile={mode} requires a C++ compiler, but this machine has none; install "
            "g++, name one in the environment variable CXX, or set trainer.compile=none."
        ) from error
