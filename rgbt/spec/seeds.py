"""The seeds of a run by source of its random draws."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rgbt.ranges import Seed


@dataclass(frozen=True, kw_only=True)
class Seeds:
    """Seeds of single sources of random draws; None: that source uses the seed of the run.

    Attributes:
        weights: initial weights of the network and of a discriminator.
        order: order of the training images, and their augmentation.
        masks: all draws of the training steps: masks, dropped layers (stochastic depth), points
            at which masks are compared, and virtual views.
        start: seed of the common start (``common:NAME/last.pt``). "common": that of its experiment,
            so that all seeds begin with the same weights; "run": the same plus the seed of the run,
            so that every seed begins with other weights, and all methods with those of their seed.
    """

    weights: Seed | None = None
    order: Seed | None = None
    masks: Seed | None = None
    start: Literal["common", "run"] = "common"

    def filled(self, seed: int) -> SourceSeeds:
        """The seed of every source; `seed`, that of the run, in place of None."""
        return SourceSeeds(
            weights=seed if self.weights is None else self.weights,
            order=seed if self.order is None else self.order,
            masks=seed if self.masks is None else self.masks,
        )


@dataclass(frozen=True, kw_only=True)
class SourceSeeds:
    """The seed of every source of random draws; attributes as in `Seeds`."""

    weights: int
    order: int
    masks: int
