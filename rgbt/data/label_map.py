"""Map class ids of one data set to those of another, for networks trained on other classes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Len
from numpy.typing import NDArray

from rgbt.checks import InputError, check_choice
from rgbt.ranges import Byte, Names, NumClasses, Text


@dataclass(frozen=True, kw_only=True)
class LabelMap:
    """Maps classes of a network to classes of a data set; `groups`: class -> ids that become it.

    Ids are mapped after the argmax, as in the thesis: probabilities of classes that map to one
    class are not added up. The confidence is that of the most probable class.

    InputError: a name that is no target, an id that is missing, unknown or there twice.
    """

    num_source: NumClasses
    targets: Annotated[Names, Len(1, 255)]
    groups: dict[Text, tuple[Byte, ...]]

    def __post_init__(self) -> None:
        for name in self.groups:
            check_choice("label_map.groups", name, self.targets)
        mapped = sorted(source for group in self.groups.values() for source in group)
        if mapped != list(range(self.num_source)):
            raise InputError(
                f"label_map.groups: expected every id from 0 to {self.num_source - 1} once, got "
                f"{mapped}."
            )

    def __call__(self, classes: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Map ids of the network, any shape, below `num_source`, to ids of the data set."""
        table = np.empty(self.num_source, np.uint8)
        for name, group in self.groups.items():
            table[list(group)] = self.targets.index(name)
        return table[classes]

    def check(self, num_source: int, targets: tuple[str, ...], dataset: str) -> None:
        """Refuse a network or a data set with other classes than those of this map."""
        if (num_source, targets) != (self.num_source, self.targets):
            raise InputError(
                f"label_map maps {self.num_source} classes to {', '.join(self.targets)}, but the "
                f"network has {num_source} classes and {dataset} has {', '.join(targets)}."
            )
