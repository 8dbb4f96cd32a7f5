"""Send ``.cuda()`` in foreign code to the device of the network instead."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn


@contextmanager
def cuda_calls_to(device: torch.device | str | None) -> Iterator[None]:
    """Within it, ``.cuda()`` of tensors and modules moves them to `device`; None: to the GPU."""
    if device is None:
        yield
        return

    def moved(self: Any, *_arguments: Any, **_keywords: Any) -> Any:
        return self.to(device)

    of_modules = nn.Module.cuda
    Tensor.cuda = moved  # type: ignore[method-assign]
    nn.Module.cuda = moved  # type: ignore[method-assign]
    try:
        yield
    finally:
        del Tensor.cuda  # inherited
        nn.Module.cuda = of_modules  # type: ignore[method-assign]
