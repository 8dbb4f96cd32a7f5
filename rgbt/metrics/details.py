"""Counts beside the confusion matrices: boundaries, calibration, distance, size of objects.

They are `rgbt.metrics.counts.Counts` too. Their partition names the regions, the kind and its
setting, such as "ring5-distance-10-20-40". Region r has a row for each of G groups:

    kind         G            M x K of a group, in pixels of the region
    boundary     1            boundaries of label and prediction, `rgbt.metrics.boundary`
    calibration  bins         confidence of the prediction, `rgbt.metrics.calibration`
    distance     bins + 1     label by prediction (K x K); the last group is the sky
    size         bins + 1     label by prediction (K x K); the last group is in no object

Summed over the groups, the counts of the last two are the usual ones.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Literal, cast, get_args

from rgbt.checks import InputError, check_choice, check_range, split_list
from rgbt.metrics import names

DetailKind = Literal["boundary", "calibration", "distance", "size"]
KINDS: tuple[DetailKind, ...] = get_args(DetailKind)

OF_SCENES: tuple[DetailKind, ...] = ("distance", "size")
"""Kinds that need `rgbt.types.SceneMaps`."""

WIDTH: Final = 0.02
"""Width of a boundary as a share of the image diagonal (Cheng et al., CVPR 2021, Sec. 4)."""

CALIBRATION_BINS: Final = 15
"""Equal bins of confidence (Guo et al., ICML 2017, Sec. 5)."""

DISTANCES: Final = (10.0, 20.0, 40.0)
"""Edges in metres."""

SIZES: Final = (64.0, 256.0, 1024.0)
"""Edges in pixels of the image: squares of 8, 16 and 32 pixels."""

MOST_EDGES: Final = 20


@dataclass(frozen=True)
class Details:
    """A kind of counts and its setting.

    Attributes:
        kind: see the module.
        setting: of boundaries their width as a share of the image diagonal, 0.001..0.2, and then
            1 if the border of the image is an outline; of calibration the number of bins; of
            distance (metres) and size (pixels of the image) the rising edges between bins, above
            0.

    Raises:
        InputError: a value out of range.
    """

    kind: DetailKind
    setting: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.kind == "boundary":
            check_range("boundary_width", self.setting[0], 0.001, 0.2)
        elif self.kind != "calibration":
            edges = self.setting
            rising = all(low < high for low, high in pairwise((0.0, *edges, math.inf)))
            if not rising or not 1 <= len(edges) <= MOST_EDGES:
                given = ",".join(map(_text, edges))
                raise InputError(
                    f"{self.kind}s={given}: expected 1 to {MOST_EDGES} rising numbers above 0."
                )

    @property
    def with_border(self) -> bool:
        """Of boundaries, whether the border of the image is an outline."""
        return self.kind == "boundary" and len(self.setting) > 1

    @property
    def bins(self) -> tuple[str, ...]:
        """Names of the bins of distance and size: "0-10", "10-20", "20-inf"; else ()."""
        if self.kind not in OF_SCENES:
            return ()
        edges = pairwise((0.0, *self.setting, math.inf))
        return tuple(f"{_text(low)}-{_text(high)}" for low, high in edges)

    @property
    def groups(self) -> int:
        """G, rows of counts of one region."""
        if self.kind == "calibration":
            return int(self.setting[0])
        return len(self.bins) + 1

    def measures(self, num_classes: int) -> int:
        """M, second last dimension of the counts."""
        return num_classes if self.kind in OF_SCENES else 3

    def partition(self, regions: str) -> str:
        """Name of the partition of such counts; `regions` is that of the regions: "ring5"."""
        return "-".join([regions, self.kind, *map(_text, self.setting)])


def default(kind: DetailKind) -> Details:
    """A kind with the setting that it has unless another one is chosen."""
    settings: dict[DetailKind, tuple[float, ...]] = {
        "boundary": (WIDTH,),
        "calibration": (float(CALIBRATION_BINS),),
        "distance": DISTANCES,
        "size": SIZES,
    }
    return Details(kind, settings[kind])


def requested(
    kinds: str, boundary: tuple[float, bool], distances: str, sizes: str
) -> tuple[Details, ...]:
    """The details that options of a command request; `kinds` is a list, "all" or "none".

    `boundary` is the width, and whether the border of the image is an outline; `distances` and
    `sizes` are lists of edges.

    Raises:
        InputError: an unknown kind, or a setting out of range.
    """
    if kinds in ("none", "[]"):
        return ()
    named = list(KINDS) if kinds == "all" else split_list(kinds, "details")
    chosen: dict[str, Callable[[], tuple[float, ...]]] = {
        "boundary": lambda: (boundary[0], *([1.0] if boundary[1] else [])),
        "calibration": lambda: (float(CALIBRATION_BINS),),
        "distance": lambda: _edges("distances", distances),
        "size": lambda: _edges("sizes", sizes),
    }
    for name in named:
        check_choice("details", name, (*KINDS, "all", "none"))
        if name not in KINDS:
            raise InputError(f"details={kinds}: '{name}' stands alone; remove it from the list.")
    return tuple(Details(cast(DetailKind, name), chosen[name]()) for name in dict.fromkeys(named))


def details_of(partition: str) -> Details | None:
    """The details that counts with this partition are; None: other counts."""
    found = re.fullmatch(rf"(.+?)-({'|'.join(KINDS)})-([0-9.e+-]+)", partition)
    if found is None:
        return None
    setting = tuple(float(word) for word in re.split(r"(?<!e)-", found[3]))
    return Details(cast(DetailKind, found[2]), setting)


def regions_of(partition: str) -> str:
    """The name of the regions of a partition: "ring5" of "ring5-boundary-0.02" and of "ring5"."""
    details = details_of(partition)
    return partition if details is None else partition.rpartition(f"-{details.kind}-")[0]


def _text(number: float) -> str:
    return f"{number:.12g}"


def _edges(key: str, text: str) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in split_list(text, key))
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{key}={text}: expected numbers, separated by commas.") from error


@dataclass(frozen=True)
class DetailScore:
    """The last part of a metric name that details have.

    Attributes:
        kind: of the counts that it needs.
        class_name: of one class alone, or None.
        region: number from 1, or None for the whole image.
        bin: of distance and size, e.g. "10-20"; "" of other kinds.
    """

    kind: DetailKind
    class_name: str | None = None
    region: int | None = None
    bin: str = ""


def details_of_metric(metric: str) -> DetailScore | None:
    """The details that a metric name needs, also after day/ or night/; None: other counts."""
    words = metric.split("/")
    return parse_detail(words[1:] if words[0] in (names.DAY, names.NIGHT) else words)


BIN = re.compile(r"\d+(\.\d+)?-(\d+(\.\d+)?|inf)")


def parse_detail(words: Sequence[str]) -> DetailScore | None:
    """Take a metric name apart, split at "/" and without day or night; None: another metric."""
    rest, class_name, region = list(words), None, None
    if len(rest) > 2 and rest[0] == "class" and rest[1]:
        class_name, rest = rest[1], rest[2:]
    if len(rest) > 2 and rest[0] == "region" and rest[1].isdecimal() and int(rest[1]) >= 1:
        region, rest = int(rest[1]), rest[2:]
    match rest:
        case [names.BOUNDARY_MIOU] if class_name is None:
            return DetailScore("boundary", None, region)
        case [names.BOUNDARY_IOU] if class_name is not None:
            return DetailScore("boundary", class_name, region)
        case [names.ECE]:
            return DetailScore("calibration", class_name, region)
        case [names.DISTANCE | names.SIZE as kind, which] if BIN.fullmatch(which):
            return DetailScore(cast(DetailKind, kind), class_name, region, which)
    return None
