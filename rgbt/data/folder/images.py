"""Reads images of a user's own data: RGB of 8 bits, thermal values as grey levels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from rgbt.data.files import read_packed, read_rgb
from rgbt.data.folder.values import Range, grey, read_values
from rgbt.data.images import PairPattern, read_packed_pair
from rgbt.data.named_files import pair_of_one_size
from rgbt.types import Sample

PACKED_ADVICE = "give dataset.thermal its own pattern"
RGB_ADVICE = "dataset.thermal with the same pattern reads a fourth channel as thermal"


@dataclass(frozen=True)
class FolderImages:
    """See `rgbt.data.images.PairReader`.

    Attributes:
        layouts: the patterns of the configuration.
        thermal_range: (low, high) thermal values that become black and white; None: 8 bit.
    """

    layouts: tuple[PairPattern]
    thermal_range: Range | None

    def read(self, name: str, rgb: Path, thermal: Path) -> Sample:
        """See `rgbt.data.images.PairReader`.

        A packed file given to a data set of separate images holds grey levels, used unchanged.
        """
        (own,) = self.layouts
        if rgb != thermal:
            pixels, values = read_rgb(rgb, RGB_ADVICE), self.values(thermal, packed=False)
        elif own.rgb == own.thermal:
            pixels, values = read_packed(rgb, PACKED_ADVICE)
        else:
            return read_packed_pair(name, rgb)
        return pair_of_one_size(name, pixels, grey(values, self.thermal_range, thermal), thermal)

    def values(self, path: Path, *, packed: bool) -> NDArray[Any]:
        """Values of the thermal camera, (H, W); InputError as of `read`."""
        return read_packed(path, PACKED_ADVICE)[1] if packed else read_values(path)
