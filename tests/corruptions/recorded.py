"""Small data sets whose images follow from their names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rgbt.checks import InputError
from rgbt.randomness import numpy_generator
from rgbt.types import Sample

HW = (120, 160)
NAMES = ("00001D", "00002N", "00003D", "00004D", "00005N", "00006D")


def sample(name: str = "00001D", hw: tuple[int, int] = HW) -> Sample:
    """Noise from 1 to 255: a pixel that is 0 was made so."""
    rng = numpy_generator(0, name)
    return Sample(
        rgb=rng.integers(1, 256, (*hw, 3), dtype=np.uint8),
        thermal=rng.integers(1, 256, hw, dtype=np.uint8),
        label=rng.integers(0, 9, hw, dtype=np.uint8),
        name=name,
    )


class Recorded:
    """Stands for a data set; notes what is read."""

    root, name, num_classes = Path("root"), "recorded", 9
    classes = tuple(f"class{index}" for index in range(9))
    palette, unscored, background = ((0, 0, 0),) * 9, (), ()
    splits = {"test": "test.txt", "val": "val.txt"}

    def __init__(
        self, names: tuple[str, ...] = NAMES, *, by_night: bool = True, sizes: Any = None
    ) -> None:
        self.listed, self.by_night, self.sizes = names, by_night, sizes or {}
        self.reads: list[str] = []

    def has(self, split: str) -> bool:
        return split in self.splits

    def names(self, split: str) -> tuple[str, ...]:
        if split not in self.splits:
            raise InputError(f"no split '{split}'")
        return self.listed if split == "test" else ("00009D",)

    def read(self, name: str) -> Sample:
        self.reads.append(name)
        return sample(name, self.sizes.get(name, HW))

    def label(self, name: str) -> Any:
        return sample(name).label

    def files(self, name: str) -> tuple[Path, ...]:
        return (Path(f"{name}.png"), Path(f"{name}_label.png"))

    def decoding(self) -> dict[str, Any]:
        return {"layout": "recorded"}

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        return tuple(name.endswith("N") for name in names) if self.by_night else None

    def fingerprint(self) -> str:
        return "fingerprint"
