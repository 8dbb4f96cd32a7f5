"""An image that is missing altogether."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rgbt.checks import InputError
from rgbt.corruptions.corruption import NAMES, Image, RngOf
from rgbt.types import Sample


class Removed:
    """One image of the pair is black: every pixel 0 in the file's grey levels.

    That is before the normalisation, so what a network sees depends on its inputs
    (``conf/model/inputs/``): 0 for RTFNet and MFNet (``unit``) and for CMX as the Temporal release
    feeds it (``temporal``; a thermal image of zeros has no maximum to be divided by and stays 0);
    -2.12, -2.04, -1.80 in R, G, B and -2.12 in thermal for CRM and SpatialSeg (``crm``), the same
    three values in RGB and thermal for CMX as its release feeds it (``cmx``); -1 for HeatNet and
    the thesis (``half``, ``half_three``). Masked cells of a training are different: the networks of
    CRM replace them by a learned token, so that a black image is nothing they were trained on.

    CRM, Table 1 ("RGB drop", "THR drop") does not say how an image is dropped, and no release shows
    it. For a network that always decodes both images a black one is the only way; those that decode
    the features of a single branch can be asked to (``modality=thermal``), which is another test.

    Args:
        image: which one is missing.
    """

    unit = ""
    severities = (1.0,)

    def __init__(self, *, image: Image) -> None:
        self.image: Image = image
        self.title = f"{NAMES[image]} removed (zeroed)"

    def check(self, severity: float) -> None:
        """An image is missing or not."""
        if severity != 1:
            raise InputError(
                f"severity of an image that is missing can only be 1, got {severity:g}."
            )

    def __call__(self, sample: Sample, severity: float, rng_of: RngOf) -> Sample:
        """See `OfPixels`."""
        del severity, rng_of  # there is one way to be missing
        black: dict[str, Any] = {self.image: np.zeros_like(getattr(sample, self.image))}
        return replace(sample, **black)
