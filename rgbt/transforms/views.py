"""Virtual views: a labelled frame as it looks after a small turn of the camera (VVIG).

A turn moves every pixel by a homography; cutting the result to the largest rectangle without empty
pixels and enlarging it again imitates moving forward (`rgbt.geometry` has the arithmetic).
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
from annotated_types import Interval, doc
from torch import Tensor

from rgbt.checks import InputError, nearest
from rgbt.files.plain_files import read_bytes
from rgbt.geometry.camera import Camera, Order, Rule, homography, inner_rectangle
from rgbt.geometry.warp import Resampling, Warp
from rgbt.ranges import Names, Rising
from rgbt.requirements import Record, Requirement, record_of
from rgbt.types import IGNORE, Batch

Angle = Annotated[float, Interval(ge=-60, le=60), doc("degrees")]

# Least share of the frame that the smallest rectangle of the drawn angles covers.
LEAST = 0.1

# The three sets of the Temporal release: 393 triples each, one per image of MFNet's test list.
PUBLISHED = Path(__file__).with_name("angles")

# Digest of ``conf/consistency/views.yaml``, on which published TC and CA were measured.
PUBLISHED_VIEWS = "e93922"


@dataclass(kw_only=True, eq=False)
class VirtualView:
    """Draws turns of the camera, and warps images, labels and predictions to the new view.

    Paper: Temporal, Sec. III-B and Eq. 1: ``M = K Rz(roll) Ry(yaw) Rx(pitch) K^-1``, angles from
        closed intervals, cut to the largest inner rectangle, one interpolation.
    Released: ``K Rz Rx Ry K^-1``, whole degrees without the upper end, second extremes of the
        corners for the rectangle, interpolated twice (warp, then cut and resize) with images
        rounded to bytes each time, empty pixels are background. Its intrinsics are those of
        another camera (see ``conf/camera``).
    """

    camera: Camera
    order: Order
    yaw: Rising[Angle]
    pitch: Rising[Angle]
    roll: Rising[Angle]
    angles: Literal["uniform", "integer"]
    mode: Literal["both", "rotation", "translation"]
    rectangle: Rule
    resampling: Resampling
    outside: Literal["ignore", "background"]

    def __post_init__(self) -> None:
        self.outside_label = IGNORE if self.outside == "ignore" else 0
        self.ranges = {"yaw": self.yaw, "pitch": self.pitch, "roll": self.roll}
        for name, (low, high) in self.ranges.items():
            whole = float(low).is_integer() and float(high).is_integer() and low < high
            if self.angles == "integer" and not whole:
                raise InputError(f"view.{name}: expected two whole degrees, got {low, high}.")
        # A grid of turns over the ranges, so that no step has to wait for a check.
        steps = [torch.linspace(low, high, 5).tolist() for low, high in self.ranges.values()]
        self.check(torch.tensor(list(product(*steps)), dtype=torch.float64), LEAST)

    @property
    def record(self) -> Record:
        """State its camera; class 0, which is painted where nothing is seen, is the background."""
        painted = Requirement.of_background("view.outside=background")
        requires = () if self.outside == "ignore" else (painted,)
        return Record(requires=requires, others={"camera": self.camera})

    def check(self, angles: Tensor, least: float = 0.0) -> None:
        """Refuse (InputError) angles (B, 3) that leave at most a share of the camera's images."""
        size = (self.camera.height, self.camera.width)
        turn = homography(angles, self.camera.matrix(size), self.order)
        left, top, right, bottom = inner_rectangle(turn, size, self.rectangle).unbind(1)
        share = ((right - left) * (bottom - top) / (size[0] * size[1])).nan_to_num(0)
        if float(share.min()) <= least:
            worst = "yaw {:g}, pitch {:g}, roll {:g}".format(*angles[share.argmin()].tolist())
            raise InputError(
                f"view: {worst} degrees leave a rectangle of {100 * float(share.min()):.2g} % of "
                f"the frame; more than {100 * least:g} % is required."
            )

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Draw yaw, pitch, roll in degrees, (count, 3) float64, on the device of `generator`."""
        device = generator.device
        ranges = torch.tensor(list(self.ranges.values()), dtype=torch.float64, device=device)
        low, high = ranges.unbind(1)
        drawn = torch.rand(count, 3, dtype=torch.float64, generator=generator, device=device)
        angles = low + (high - low) * drawn
        return angles.floor() if self.angles == "integer" else angles

    def warp(self, angles: Tensor, image_hw: tuple[int, int]) -> Warp:
        """Say where pixels of the view by `angles` (B, 3) come from; errors as `Camera.matrix`."""
        turn = homography(angles, self.camera.matrix(image_hw), self.order)
        if self.mode == "rotation":
            height, width = image_hw
            whole = turn.new_tensor([-0.5, -0.5, width - 0.5, height - 0.5])
            rectangle = whole.expand(len(turn), 4)
        else:
            rectangle = inner_rectangle(turn, image_hw, self.rectangle)
        if self.mode == "translation":
            turn = torch.eye(3, dtype=turn.dtype, device=turn.device).expand_as(turn)
        return Warp(turn, rectangle, image_hw, self.resampling)

    def batch(self, batch: Batch, warp: Warp) -> Batch:
        """Warp the frames to the view: images bilinear, the other maps nearest.

        Images are float in [0, 1] and have the size of `warp`; the label may have another one, as
        in evaluation. What the first frame does not show has the confidence 1 where it is trained
        on as background.

        Networks that divide thermal by its own maximum do so for the view again. The release
        divides before, so that its second frame is 1.5 to 4.4 % darker (eight frames of MFNet).
        """
        levels = 255 if self.resampling == "twice" else None
        images = warp.bilinear(torch.cat([batch.rgb, batch.thermal], 1), levels)
        of_label = warp.resized((batch.label.shape[1], batch.label.shape[2]))
        position, confidence = batch.position, batch.confidence
        sure = float(self.outside_label != IGNORE)
        return replace(
            batch,
            rgb=images[:, :3],
            thermal=images[:, 3:],
            label=of_label.nearest(batch.label, self.outside_label),
            centre_yx=warp.moved(batch.centre_yx),
            position=None if position is None else warp.nearest(position, 0),
            confidence=None if confidence is None else of_label.nearest(confidence, sure),
        )

    def valid(self, warp: Warp) -> Tensor:
        """Return the pixels that losses count, (B, H, W) bool."""
        inside = warp.inside()
        return inside if self.outside_label == IGNORE else torch.ones_like(inside)


class ViewSets:
    """Holds the virtual views and splits on which consistency (TC and CA) is measured.

    Source: Temporal, Table I: the mean over three sets of angles, those of its release. The k-th
    triple belongs to the k-th image of the split's list; longer lists begin again with the first.

    Args:
        view: how a triple becomes a view; its ranges of angles are not drawn from.
        sets: names of published sets ("released_1" .. "released_3"), or CSV files with the columns
            yaw,pitch,roll in degrees. None: a run measures no consistency.
        splits: what a run measures at its end, with its best checkpoint.
        scenes_per_count: neighbouring scenes whose counts are kept as one (`Counts.added`).
    """

    def __init__(
        self,
        *,
        view: VirtualView,
        sets: Names,
        splits: tuple[Literal["val", "test"], ...],
        scenes_per_count: Annotated[int, Interval(ge=1, le=1000)] = 1,
    ) -> None:
        self.view, self.sets, self.splits = view, sets, splits
        self.scenes_per_count = scenes_per_count
        if sets and not splits:
            raise InputError("consistency.splits: consistency.sets requires val or test.")
        self._triples = [read_angles(name) for name in sets]
        for name, triples in zip(sets, self._triples, strict=True):
            try:
                view.check(triples)
            except InputError as error:
                raise InputError(f"consistency.sets: {name}: {error}") from error

    @property
    def record(self) -> Record:
        """State what its views require of the data set."""
        requires = record_of(self.view, Record).requires if self.sets else ()
        return Record(requires=tuple(need.inside("consistency") for need in requires))

    @cached_property
    def mark(self) -> str:
        """Return a part of file names: "" for the published views, six digits for others."""
        names = ("order", "mode", "rectangle", "resampling")
        settings = {name: getattr(self.view, name) for name in names}
        settings |= {"camera": asdict(self.view.camera), "outside": self.view.outside_label}
        triples = [triples.tolist() for triples in self._triples]
        text = json.dumps([settings, triples], sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()[:6]
        return "" if digest == PUBLISHED_VIEWS else digest

    def angles(self, number: int, indices: list[int]) -> Tensor:
        """Return triples of set `number` (0-based) at places in a split's list, (B, 3) degrees."""
        triples = self._triples[number]
        return triples[torch.tensor(indices) % len(triples)]


def read_angles(name: str) -> Tensor:
    """Read the triples (N, 3) float64 of a published set, or of a file; InputError for none."""
    published = {path.stem: path for path in PUBLISHED.glob("*.csv")}
    path = published.get(name, Path(name).expanduser())
    if not path.is_file():
        known = nearest(name, published)
        raise InputError(f"consistency.sets: '{name}' is not a file nor a published set; {known}.")
    try:
        header, *lines = read_bytes(path).decode("utf-8-sig").replace(" ", "").split() or [""]
        triples = np.loadtxt(lines, delimiter=",", ndmin=2) if lines else np.empty((0, 0))
    except ValueError as error:  # also a wrong encoding
        raise InputError(f"consistency.sets: {path}: {error}") from error
    if header != "yaw,pitch,roll" or triples.shape[1] != 3 or not np.isfinite(triples).all():
        lines_of = "the line yaw,pitch,roll, then three finite numbers (degrees) per line"
        raise InputError(f"consistency.sets: {path}: expected {lines_of}.")
    return torch.from_numpy(triples)
