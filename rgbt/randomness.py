"""Derive every random generator from (run seed, purpose, index); global generators are never used.

Results therefore do not depend on the number of loader workers. A resumed run draws the same
numbers as an uninterrupted one, and a single mask or augmentation can be reproduced alone.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    import torch


def derive(seed: int, purpose: str, *index: int) -> int:
    """Derive a 63-bit seed from every argument (SHA-256), the same on every machine.

    Args:
        seed: run seed, any integer; 0 is a seed.
        purpose: what is drawn, e.g. "mask"; different purposes never share draws.
        index: step, epoch or sample numbers.
    """
    text = ":".join([str(seed), purpose, *map(str, index)])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


def torch_generator(
    seed: int, purpose: str, *index: int, device: torch.device | str = "cpu"
) -> torch.Generator:
    """Make a torch generator on `device`, seeded by `derive`."""
    import torch  # not at the top: data sets are read without it

    return torch.Generator(device=device).manual_seed(derive(seed, purpose, *index))


def generators_of_step(
    seed: int, step: int, device: torch.device
) -> Callable[[str], torch.Generator]:
    """Return a function that makes the generators of one step (`rgbt.types.GeneratorOf`)."""
    return lambda purpose: torch_generator(seed, purpose, step, device=device)


def numpy_generator(seed: int, purpose: str, *index: int) -> np.random.Generator:
    """Make a NumPy generator (PCG64), seeded by `derive`."""
    return np.random.default_rng(derive(seed, purpose, *index))
