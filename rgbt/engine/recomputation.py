"""Activation checkpointing: compute activations again in the backward pass instead of keeping them.

Losses, gradients and running statistics keep their bits. Networks draw nothing in the modules
that are recomputed (`rgbt.requirements.Record.recomputed`), so no generator has to be restored.
"""

from __future__ import annotations

import re
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import nn
from torch.utils.checkpoint import checkpoint

from rgbt.checks import InputError
from rgbt.requirements import record_of

SETTING = "trainer.activation_checkpointing=true"


def recompute_activations(network: nn.Module) -> None:
    """Checkpoint every module that the record of `network` names in `recomputed`.

    Modules stay where they are, so the keys of a checkpoint do not change. Evaluation and passes
    without gradient are not affected.

    Raises:
        InputError: the network declares no such module, or a name fits none.
    """
    kind = type(network).__name__
    patterns = record_of(network).recomputed
    if not patterns:
        raise InputError(
            f"{SETTING} requires a network that declares which modules are recomputed, but the "
            f'record of {kind} does not; add recomputed=("blocks.*",) with the names of its '
            "modules, or set trainer.activation_checkpointing=false."
        )
    modules = dict(network.named_modules())
    for pattern in patterns:
        names = [name for name in modules if _fits(pattern, name)]
        if not names:
            raise InputError(
                f"{SETTING}: the record of {kind} names '{pattern}' in `recomputed`, but no module "
                f"of the network has such a name; choose from its named_modules(), such as "
                f"{', '.join(list(modules)[1:4])}."
            )
        for name in names:
            object.__setattr__(modules[name], "forward", Recomputed(modules[name]))


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
            context_fn=self._contexts,
            **keywords,
        )

    def _contexts(self) -> tuple[AbstractContextManager[None], AbstractContextManager[None]]:
        """Of the forward pass, and of the recomputation."""
        return nullcontext(), KeptStatistics(self.module)


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


def _fits(pattern: str, name: str) -> bool:
    """Whether a dotted name fits a pattern, in which * is any part of a name without a dot."""
    return re.fullmatch(re.escape(pattern).replace(r"\*", "[^.]*"), name) is not None
