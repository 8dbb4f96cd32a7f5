"""How the masks of RGB and of thermal relate: pure functions of drawn masks."""

from __future__ import annotations

import torch
from torch import Tensor

from rgbt.types import MaskPair


def complementary(taken: Tensor) -> MaskPair:
    """RGB hides the taken cells, thermal all others.

    Source: CRM, Sec. 3.2 (there 1 keeps a cell; here True hides it); SpatialSeg, Eqs 6 and 10.

    Args:
        taken: (B, h, w) bool.
    """
    return MaskPair(rgb=taken, thermal=~taken)


def random_complementary(
    taken: Tensor, probabilities: tuple[float, float, float], generator: torch.Generator
) -> MaskPair:
    """One of three patterns per sample: only thermal hidden, only RGB hidden, both complementary.

        (M_rgb, M_th) = (0, 1 - m), (m, 0) or (m, 1 - m)

    Source: SpatialSeg, Eq. 11, and the default of both releases (`rand_comp`), each pattern with
    probability 1/3. The CRM paper describes the third alone (`complementary`).

    Args:
        taken: m, (B, h, w) bool.
        probabilities: of the three patterns in this order, sum 1.
        generator: on the device of `taken`.
    """
    batch = len(taken)
    weights = torch.tensor(probabilities, device=taken.device)
    pattern = torch.multinomial(weights, batch, replacement=True, generator=generator)
    pattern = pattern[:, None, None]
    return MaskPair(rgb=taken & (pattern != 0), thermal=~taken & (pattern != 1))
