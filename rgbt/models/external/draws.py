"""Let foreign code draw from the global generators without a trace, from a given seed.

Dropout and the like of other authors draw from the generators of torch, NumPy and Python. Inside
`seeded` these are seeded; outside, their states are as if nothing had been drawn.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

_python = importlib.import_module("random")
_numpy = np.random.mtrand._rand  # NumPy's global generator


@contextmanager
def seeded(seed: int, device: torch.device) -> Iterator[None]:
    """Within it, the global generators begin at `seed`; afterwards they are as before.

    Args:
        seed: from 0 to 2^32 - 1.
        device: of the network, whose generator is seeded beside those of the CPU.
    """
    states = _python.getstate(), _numpy.get_state()
    on_gpu = device.type == "cuda"
    index = (torch.cuda.current_device() if device.index is None else device.index) if on_gpu else 0
    try:
        with torch.random.fork_rng(devices=[index] if on_gpu else []):
            torch.default_generator.manual_seed(seed)
            if on_gpu:
                torch.cuda.default_generators[index].manual_seed(seed)
            _python.seed(seed)
            _numpy.seed(seed)
            yield
    finally:
        _python.setstate(states[0])
        _numpy.set_state(states[1])
