"""Pairs of RGB and thermal images without a label: how a data set reads them.

A data set declares the paths of its images (`PairPattern`) and how they are decoded (`PairReader`),
so that new images of any folder are read like the training images.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rgbt.data.files import read_packed, read_rgb
from rgbt.data.named_files import pair_of_one_size
from rgbt.types import Sample

PACKED_ADVICE = "give separate images as rgb=FILE thermal=FILE, or in two folders"


class PairPattern(NamedTuple):
    """Patterns of the files of a pair (`rgbt.data.folder.pattern`), relative to a root.

    Attributes:
        rgb: of the RGB images.
        thermal: of the thermal images; equal to `rgb` where thermal is the fourth channel.
        label: of the labels, which are not read as images; None if they lie elsewhere.
    """

    rgb: str
    thermal: str
    label: str | None = None

    def __str__(self) -> str:
        if self.rgb == self.thermal:
            return f"{self.rgb} of four channels"
        return f"RGB {self.rgb} with thermal {self.thermal}"


class PairReader(Protocol):
    """How the two images of a pair are read."""

    @property
    def layouts(self) -> tuple[PairPattern, ...]:
        """Path patterns of the images of the data set."""
        ...

    def read(self, name: str, rgb: Path, thermal: Path) -> Sample:
        """The pair, read like a training sample, without a label.

        Args:
            name: of the sample.
            rgb: file of the RGB image.
            thermal: file of the thermal image; the same file where it is the fourth channel.

        Raises:
            InputError: a file is missing or damaged, has other channels or bits than those of the
                data set, or sizes differ.
        """
        ...


@runtime_checkable
class ReadsPairs(Protocol):
    """A data set that also reads images without a label.

    Attributes:
        images: how the images of any folder are read.
    """

    images: PairReader

    def pair(self, name: str) -> Sample:
        """The images of a sample, without its label; InputError as in `PairReader.read`."""
        ...


@dataclass(frozen=True)
class GreyImages:
    """RGB and thermal images of 8 bits.

    Attributes:
        layouts: see `PairReader`.
        thermal: reads the grey levels (H, W) of a thermal image.
        packed_advice: what to do with a packed file that has not four channels.
    """

    layouts: tuple[PairPattern, ...]
    thermal: Callable[[Path], NDArray[np.uint8]]
    packed_advice: str = PACKED_ADVICE

    def read(self, name: str, rgb: Path, thermal: Path) -> Sample:
        """See `PairReader.read`."""
        if rgb == thermal:
            return read_packed_pair(name, rgb, self.packed_advice)
        return pair_of_one_size(name, read_rgb(rgb), self.thermal(thermal), thermal)


def read_packed_pair(name: str, path: Path, advice: str = PACKED_ADVICE) -> Sample:
    """The pair of a file with channels R, G, B, thermal: grey levels as the network sees them."""
    return pair_of_one_size(name, *read_packed(path, advice), path)
