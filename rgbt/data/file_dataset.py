"""The base of data sets that read each image and label from a file of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rgbt.data.files import read_label
from rgbt.data.images import PairReader
from rgbt.data.integrity import within
from rgbt.data.named_files import check_lengths, with_label
from rgbt.requirements import Record
from rgbt.types import Sample


class FileDataset:
    """A reader only: it never resizes, augments or remaps, and refuses what it cannot read exactly.

    Args:
        root: its folder, which exists.
        name: used in messages and tables.
        num_classes: number of classes; other nodes of the configuration interpolate it.
        classes: their names, in order of the class index.
        palette: their (red, green, blue) colours, 0..255.

    Attributes:
        images: how its images, and new ones of any folder, are read.

    Raises:
        InputError: numbers of classes, names and colours differ.
    """

    images: PairReader

    unscored: tuple[str, ...] = ()
    """Every class counts in the means, as in the published tables."""

    def __init__(
        self,
        root: Path,
        name: str,
        num_classes: int,
        classes: tuple[str, ...],
        palette: tuple[tuple[int, int, int], ...],
    ) -> None:
        check_lengths(num_classes, classes, palette)
        self.root = root
        self.name = name
        self.num_classes = num_classes
        self.classes = classes
        self.palette = palette

    @property
    def record(self) -> Record:
        """The number of its classes."""
        return Record(num_classes=self.num_classes)

    def files(self, name: str) -> tuple[Path, ...]:
        """RGB and thermal image (one file where thermal is the fourth channel), then the label."""
        raise NotImplementedError

    def read(self, name: str) -> Sample:
        """The sample called `name`, decoded.

        Returns:
            Sample with rgb (H, W, 3), thermal (H, W), label (H, W) or None, all uint8.

        Raises:
            InputError: no such name, a file is missing, leads out of the root, cannot be decoded,
                has other channels, bits or size than expected, or the label holds a value that has
                no meaning.
        """
        pair = self.pair(name)
        return with_label(pair, self.label(name), self.files(name)[-1])

    def pair(self, name: str) -> Sample:
        """The images of `read` alone, without the label; InputError as there."""
        paths = [within(path, self.root) for path in self.files(name)[:-1]]
        return self.images.read(name, paths[0], paths[-1])

    def label(self, name: str) -> NDArray[np.uint8] | None:
        """The label of `read` alone, (H, W) uint8, or None; InputError as there."""
        return read_label(within(self.files(name)[-1], self.root), self.num_classes)
