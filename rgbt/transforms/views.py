"""Virtual views: a labelled frame as it looks after a small turn of the camera (VVIG).

A turn moves every pixel by a homography; cutting the result to the largest rectangle without empty
pixels and enlarging it again imitates moving forward. Where pixels come from is arithmetic in
`rgbt.geometry`; here it is drawn, or read from fixed sets of angles, and applied to batches.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from annotated_types import Interval, Predicate, doc
from torch import Tensor

from rgbt.checks import InputError, nearest
from rgbt.files.plain_files import read_bytes
from rgbt.geometry.camera import Camera
from rgbt.geometry.homography import Order, homography
from rgbt.geometry.rectangle import Rule, check_rectangle, inner_rectangle
from rgbt.geometry.warp import Resampling, Warp
from rgbt.ranges import Names, rising
from rgbt.requirements import Record, Requirement, record_of
from rgbt.types import IGNORE, Batch

Angle = Annotated[float, Interval(ge=-60, le=60), doc("degrees")]
"""A camera of ordinary width that turns further sees nothing of what it saw."""

Degrees = Annotated[tuple[Angle, Angle], Predicate(rising), doc("the smaller one first")]

LEAST = 0.1
"""Share of the frame that the smallest rectangle of the drawn angles must hold."""

BYTE = 255

HEADER = "yaw,pitch,roll"
PUBLISHED = Path(__file__).with_name("angles")
"""The three sets of the Temporal release: 393 triples each, one per image of MFNet's test list."""

PUBLISHED_VIEWS = "e93922"
"""Digest of ``conf/consistency/views.yaml``, on which published TC and CA were measured."""


@dataclass(kw_only=True, eq=False)
class VirtualView:
    """Draws turns of the camera, and warps images, labels and predictions to the new view.

    Paper: Temporal, Sec. III-B and Eq. 1: ``M = K Rz(roll) Ry(yaw) Rx(pitch) K^-1``, angles from
        closed intervals, cut to the largest inner rectangle, one interpolation.
    Released: ``K Rz Rx Ry K^-1``, whole degrees without the upper end, second extremes of the
        corners for the rectangle, interpolated twice (warp, then cut and resize) with images
        rounded to bytes each time, empty pixels are background. Its intrinsics are those of
        another camera (see ``conf/camera``).

    Raises:
        InputError: angles out of range, or so large that no rectangle is left.
    """

    camera: Camera
    order: Order
    yaw: Degrees
    pitch: Degrees
    roll: Degrees
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
        # A grid of turns over the ranges, looked at here so that no step has to wait for it.
        steps = [torch.linspace(low, high, 5).tolist() for low, high in self.ranges.values()]
        turns = torch.tensor(list(product(*steps)), dtype=torch.float64)
        left, top, right, bottom = self.check(turns).unbind(1)
        share = (right - left) * (bottom - top) / (self.camera.height * self.camera.width)
        if bool((share < LEAST).any()):
            worst = "yaw {:g}, pitch {:g}, roll {:g}".format(*turns[share.argmin()].tolist())
            raise InputError(
                f"view: {worst} degrees leave a rectangle of {100 * float(share.min()):.2g} % of "
                f"the frame, but at least {100 * LEAST:g} % is required."
            )

    @property
    def record(self) -> Record:
        """Its camera; class 0 is painted where nothing is seen, if that is the background."""
        painted = Requirement.of_background("view.outside=background")
        requires = () if self.outside == "ignore" else (painted,)
        return Record(requires=requires, camera=self.camera)

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """(count, 3) float64: yaw, pitch, roll in degrees, on the device of `generator`."""
        device = generator.device
        ranges = torch.tensor(list(self.ranges.values()), dtype=torch.float64, device=device)
        low, high = ranges.unbind(1)
        drawn = torch.rand(count, 3, dtype=torch.float64, generator=generator, device=device)
        angles = low + (high - low) * drawn
        return angles.floor() if self.angles == "integer" else angles

    def warp(self, angles: Tensor, image_hw: tuple[int, int]) -> Warp:
        """Where the pixels of the view come from.

        Args:
            angles: (B, 3) degrees: yaw, pitch, roll.
            image_hw: size of both frames in pixels.

        Raises:
            InputError: the camera is one of images of another shape.
        """
        turn = self._turn(angles, image_hw)
        if self.mode == "rotation":
            height, width = image_hw
            whole = turn.new_tensor([-0.5, -0.5, width - 0.5, height - 0.5])
            rectangle = whole.expand(len(turn), 4)
        else:
            rectangle = inner_rectangle(turn, image_hw, self.rectangle)
        if self.mode == "translation":
            turn = torch.eye(3, dtype=turn.dtype, device=turn.device).expand_as(turn)
        return Warp(turn, rectangle, image_hw, self.resampling)

    def settings(self) -> dict[str, Any]:
        """What decides how given angles become a view, as plain values."""
        return {
            "camera": asdict(self.camera),
            "order": self.order,
            "mode": self.mode,
            "rectangle": self.rectangle,
            "resampling": self.resampling,
            "outside": self.outside_label,
        }

    def check(self, angles: Tensor) -> Tensor:
        """(B, 4): the rectangles that angles leave of the camera's own images.

        Raises:
            InputError: one leaves none. Looking for that waits for the device.
        """
        size = (self.camera.height, self.camera.width)
        rectangle = inner_rectangle(self._turn(angles, size), size, self.rectangle)
        check_rectangle(rectangle, angles)
        return rectangle

    def batch(self, batch: Batch, warp: Warp) -> Batch:
        """The frames as seen from the view: images bilinear, the other maps nearest.

        What the first frame does not show has the confidence 1 where it is trained on as
        background.

        Networks that divide thermal by its own maximum do so for the view again. The release
        divides before the view is made, so that its second frame is the darker by what the view
        lost of the maximum: 1.5 to 4.4 % on eight frames of MFNet.

        Args:
            batch: images float in [0, 1], see `rgbt.types.Batch.to`. The label may have another
                size than the images, as in evaluation.
            warp: of the images' size.
        """
        levels = BYTE if self.resampling == "twice" else None
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
        """(B, H, W) bool: pixels that losses count."""
        inside = warp.inside()
        return inside if self.outside_label == IGNORE else torch.ones_like(inside)

    def _turn(self, angles: Tensor, image_hw: tuple[int, int]) -> Tensor:
        return homography(angles, self.camera.matrix(image_hw).to(angles.device), self.order)


class ViewSets:
    """The virtual views and splits on which consistency (TC and CA) is measured.

    Source: Temporal, Table I: the mean over the same three sets of angles; the sets are those of
    its release. The k-th triple belongs to the k-th image of the split's list; a split with more
    images than triples begins again with the first triple.

    Args:
        view: how a triple becomes a view; its ranges of angles are not drawn from.
        sets: names of published sets ("released_1" .. "released_3"), or CSV files with the columns
            yaw,pitch,roll in degrees. None: a run measures no consistency.
        splits: what a run measures at its end, with its best checkpoint.

    Raises:
        InputError: no such set, a line that is no triple, or a triple that leaves no rectangle.
    """

    def __init__(
        self, *, view: VirtualView, sets: Names, splits: tuple[Literal["val", "test"], ...]
    ) -> None:
        self.view = view
        self.sets = sets
        self.splits = splits
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
        """What its views require of the data set."""
        requires = record_of(self.view).requires if self.sets else ()
        return Record(requires=tuple(each.inside("consistency") for each in requires))

    @cached_property
    def mark(self) -> str:
        """Empty for the published views; six hexadecimal digits of any others, for names of files.

        Depends on the triples and on how they become views, not on names or places of files.
        """
        triples = [each.tolist() for each in self._triples]
        text = json.dumps([self.view.settings(), triples], sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()[:6]
        return "" if digest == PUBLISHED_VIEWS else digest

    def angles(self, number: int, indices: list[int]) -> Tensor:
        """(B, 3) float64 degrees: the triples of set `number` (0-based) for images of a split.

        `indices` are the places of the images in the split's list.
        """
        triples = self._triples[number]
        return triples[torch.tensor(indices) % len(triples)]


def read_angles(name: str) -> Tensor:
    """(N, 3) float64: the triples of a published set, or of a file.

    Raises:
        InputError: neither a published set nor a file, or a line that is no triple of numbers.
    """
    published = {path.stem: path for path in PUBLISHED.glob("*.csv")}
    path = published.get(name, Path(name).expanduser())
    if not path.is_file():
        known = nearest(name, published)
        raise InputError(f"consistency.sets: '{name}' is not a file nor a published set; {known}.")
    try:
        header, *lines = read_bytes(path).decode("utf-8-sig").replace(" ", "").split() or [""]
        triples = np.loadtxt(lines, delimiter=",", ndmin=2) if lines else np.empty((0, 0))
    except ValueError as error:  # of the encoding, too
        raise InputError(f"consistency.sets: {path}: {error}") from error
    if header != HEADER or triples.shape[1] != 3 or not np.isfinite(triples).all():
        raise InputError(
            f"consistency.sets: {path}: expected the line {HEADER}, then three finite numbers "
            "(degrees) per line."
        )
    return torch.from_numpy(triples)
