"""The interface of transforms for the loader, and code that stacks examples to a batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.types import Batch, Example, Sample


class Transform(Protocol):
    """Makes examples of samples (see `rgbt.transforms.crm.CrmTransform`)."""

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Augmented example; every draw comes from `rng`."""
        ...

    def test(self, sample: Sample) -> Example:
        """Example for evaluation, the same every time."""
        ...


def collate(examples: Sequence[Example], advice: str = "") -> Batch:
    """Stack examples of one size (see `rgbt.types.Batch` for shapes and dtypes).

    `advice` ends the message if sizes differ; it names the key to change.

    Raises:
        InputError: images or labels differ in size, naming the first two that do; only some of the
            labels carry confidences.
    """
    first = examples[0]
    for example in examples[1:]:
        for what in ("rgb", "label"):
            expected, found = getattr(first, what).shape[:2], getattr(example, what).shape[:2]
            if found != expected:
                raise InputError(
                    f"all {what} images of one batch must have one size, got "
                    f"{expected[0]}x{expected[1]} ('{first.name}') and {found[0]}x{found[1]} "
                    f"('{example.name}'){advice}."
                )
    confidences = _confidences(examples)
    positions = [example.position for example in examples if example.position is not None]
    rgb_BHWC = torch.from_numpy(np.stack([example.rgb for example in examples]))
    thermal_BHW = torch.from_numpy(np.stack([example.thermal for example in examples]))
    label = torch.from_numpy(np.stack([example.label for example in examples]))
    return Batch(
        rgb=rgb_BHWC.permute(0, 3, 1, 2).contiguous(),
        thermal=thermal_BHW[:, None],
        label=label,
        name=tuple(example.name for example in examples),
        centre_yx=torch.tensor([example.centre_yx for example in examples]),
        position=torch.from_numpy(np.stack(positions)) if positions else None,
        original_hw=torch.tensor([example.original_hw for example in examples]),
        confidence=torch.from_numpy(np.stack(confidences)) if confidences else None,
    )


def _confidences(examples: Sequence[Example]) -> list[NDArray[np.float32]]:
    """Those of all examples, or none."""
    found = [each.confidence for each in examples if each.confidence is not None]
    if 0 < len(found) < len(examples):
        with_one, without = (
            next(each.name for each in examples if (each.confidence is None) == missing)
            for missing in (False, True)
        )
        raise InputError(
            f"all labels of one batch must carry confidences, or none. Those of '{with_one}' do "
            f"and those of '{without}' do not; write the pseudo-labels of the whole split again."
        )
    return found
