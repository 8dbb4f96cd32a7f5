"""Counts beside the confusion matrices: boundaries, calibration, distance, size of objects.

They are `rgbt.metrics.counts.Counts` too. Their partition names the regions, the kind and its
setting, such as "ring5-distance-10-20-40". Region r has a row for each of G groups:

    kind         G            M x K of a group, in pixels of the region
    boundary     1            rows `BOTH`, `LABEL`, `PREDICTED`: |G_d and P_d|, |G_d|, |P_d|
    calibration  bins         rows `NUMBER`, `CORRECT`, `CONFIDENCE`: pixels of the predicted class,
                              right ones, sum of their confidences
    distance     bins + 1     label by prediction (K x K); the last group is the sky
    size         bins + 1     label by prediction (K x K); the last group is in no object

Summed over the groups, the counts of the last two are the usual ones. Depth and object are those of
the labelled scene. A wrong pixel has no object of its class, so that recall by size is defined, and
IoU is not. The size of an object is its visible area in the whole image, in pixels.

The boundary of a class are the pixels of its mask within d pixels of its outline, as left by d
erosions with 3x3 pixels. d is a share of the image diagonal, at least 1 pixel. Ignored pixels are
not counted, and their edges are no outlines. Source: Cheng et al.: "Boundary IoU", CVPR 2021, Sec.
4. In its released code the border of the image is an outline too.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Literal, cast, get_args

from rgbt.checks import InputError, check_choice, check_range, split_list

DetailKind = Literal["boundary", "calibration", "distance", "size"]
KINDS: tuple[DetailKind, ...] = get_args(DetailKind)

BOTH, LABEL, PREDICTED = range(3)
NUMBER, CORRECT, CONFIDENCE = range(3)
SCENE_KINDS: tuple[DetailKind, ...] = ("distance", "size")  # need `rgbt.types.SceneMaps`
WIDTH: Final = 0.02  # width of a boundary, share of the image diagonal (Cheng et al., Sec. 4)
DEFAULTS: dict[DetailKind, tuple[float, ...]] = {
    "boundary": (WIDTH,),
    "calibration": (15.0,),  # equal bins (Guo et al., ICML 2017, Sec. 5)
    "distance": (10.0, 20.0, 40.0),
    "size": (64.0, 256.0, 1024.0),  # squares of 8, 16 and 32 pixels
}
MOST_EDGES: Final = 20
# Units of a confidence of 1, to which that of a pixel is rounded, so that all counts are integers;
# this changes an error by at most 0.005 percent points.
UNITS: Final = 10_000


@dataclass(frozen=True)
class Details:
    """A kind of counts and its setting.

    The setting is: of boundaries their width as a share of the image diagonal, 0.001..0.2, and then
    1 if the border of the image is an outline; of calibration the number of bins; of distance
    (metres) and size (pixels) the rising edges between bins. InputError: out of range.
    """

    kind: DetailKind
    setting: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.kind == "boundary":
            check_range("boundary_width", self.setting[0], 0.001, 0.2)
        elif self.kind in SCENE_KINDS:
            rising = all(low < high for low, high in self._edges())
            if not rising or not 1 <= len(self.setting) <= MOST_EDGES:
                given = f"{self.kind}s={','.join(map(_text, self.setting))}"
                raise InputError(f"{given}: expected 1 to {MOST_EDGES} rising numbers above 0.")

    def _edges(self) -> pairwise[tuple[float, float]]:
        return pairwise((0.0, *self.setting, math.inf))

    @property
    def bins(self) -> tuple[str, ...]:
        """Return the names of the bins of distance and size: "0-10", "10-20", "20-inf"; else ()."""
        if self.kind not in SCENE_KINDS:
            return ()
        return tuple(f"{_text(low)}-{_text(high)}" for low, high in self._edges())

    @property
    def groups(self) -> int:
        """Return G, rows of counts of one region."""
        return int(self.setting[0]) if self.kind == "calibration" else len(self.bins) + 1

    def measures(self, num_classes: int) -> int:
        """Return M, second last dimension of the counts."""
        return num_classes if self.kind in SCENE_KINDS else 3

    def partition(self, regions: str) -> str:
        """Name the partition of such counts; `regions` is the name of the regions: "ring5"."""
        return "-".join([regions, self.kind, *map(_text, self.setting)])


def requested(
    kinds: str, boundary: tuple[float, bool], distances: str, sizes: str
) -> tuple[Details, ...]:
    """Return the details that options of a command request; `kinds` is a list, "all" or "none".

    `boundary` is the width, and whether the border of the image is an outline; `distances` and
    `sizes` are lists of edges.
    """
    if kinds in ("none", "[]"):
        return ()
    found = []
    for name in KINDS if kinds == "all" else dict.fromkeys(split_list(kinds, "details")):
        check_choice("details", name, KINDS)
        kind = cast(DetailKind, name)
        setting = DEFAULTS[kind]
        if kind == "boundary":
            setting = (boundary[0], *([1.0] if boundary[1] else []))
        elif kind in SCENE_KINDS:
            text = distances if kind == "distance" else sizes
            try:
                setting = tuple(map(float, split_list(text, f"{kind}s")))
            except ValueError as error:
                raise InputError(f"{kind}s={text}: {error}.") from error
        found.append(Details(kind, setting))
    return tuple(found)


def details_of(partition: str) -> Details | None:
    """Return the details that counts with this partition are; None: other counts."""
    found = re.fullmatch(rf"(.+?)-({'|'.join(KINDS)})-([0-9.e+-]+)", partition)
    if found is None:
        return None
    setting = tuple(float(word) for word in re.split(r"(?<!e)-", found[3]))
    return Details(cast(DetailKind, found[2]), setting)


def regions_of(partition: str) -> str:
    """Return the regions of a partition: "ring5" of "ring5-boundary-0.02" and of "ring5"."""
    details = details_of(partition)
    return partition if details is None else partition.rpartition(f"-{details.kind}-")[0]


def _text(number: float) -> str:
    return f"{number:.12g}"
