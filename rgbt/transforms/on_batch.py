"""Resize, crop, flip and colours of a whole batch at once, on the device that trains.

What is drawn, and what comes out, is what `rgbt.transforms.crm.CrmTransform.train` draws and makes
of uint8 images, bit for bit: coordinates and tables are computed with each example's own draws, and
pixels with whole numbers, so that neither the batch, the number of workers nor the device matters.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rgbt.checks import InputError
from rgbt.transforms.hsv import to_hsv, to_rgb
from rgbt.transforms.joint import Indices, Taps, View
from rgbt.transforms.photometric import LEVELS, Colours, scale_and_truncate
from rgbt.types import IGNORE, Batch, Sample

Pixels = NDArray[np.uint8]


class Axis(NamedTuple):
    """What is read of one axis of an original, counted from the first place that is.

    Attributes:
        span: all places of the original from the first to the last that is read.
        taps: (3, n) int64, first and second place of every pixel, and weight (see `Taps`).
        nearest: (n,) int64, place of every pixel of the label.
    """

    span: slice
    taps: Indices
    nearest: Indices

    @classmethod
    def of(cls, taps: Taps, nearest: Indices) -> Axis:
        """From places in the original."""
        start = int(min(taps.first.min(), nearest.min()))
        stop = int(max(taps.second.max(), nearest.max())) + 1
        relative = np.stack([taps.first - start, taps.second - start, taps.weight])
        return cls(slice(start, stop), relative, nearest - start)


@dataclass(frozen=True)
class Drawn:
    """The pixels that one example reads, and the changes to apply.

    Nothing is copied: the arrays are parts of those of the sample.

    Attributes:
        name: name in the split list.
        rgb: (H', W', 3) uint8, the part of the original that the view reads.
        thermal: (H', W') uint8, the same part.
        label: (H', W') uint8, the same part.
        confidence: (H', W') float32, or None.
        rows: which rows of the original are read, and how.
        columns: likewise.
        view: resize, crop and flip, of the original.
        colours: colour changes.
    """

    name: str
    rgb: Pixels
    thermal: Pixels
    label: Pixels
    confidence: NDArray[np.float32] | None
    rows: Axis
    columns: Axis
    view: View
    colours: Colours

    @classmethod
    def of(cls, sample: Sample, view: View, colours: Colours) -> Drawn:
        """Cut out what is read; no label: all pixels are ignored."""
        taps = view.taps()
        rows, columns = Axis.of(taps[0], view.rows()), Axis.of(taps[1], view.columns())
        part = (rows.span, columns.span)
        return cls(
            name=sample.name,
            rgb=sample.rgb[part],
            thermal=sample.thermal[part],
            label=np.full_like(sample.thermal[part], IGNORE)
            if sample.label is None
            else sample.label[part],
            confidence=None if sample.confidence is None else sample.confidence[part],
            rows=rows,
            columns=columns,
            view=view,
            colours=colours,
        )


@dataclass(frozen=True)
class DrawnBatch:
    """Examples before their augmentation, which `to` makes on a device.

    Parts of originals differ in size; they lie in the top left corner of H' x W' pixels, and what
    is beside them is never read.

    Attributes:
        name: B names.
        rgb: (B, H', W', 3) uint8.
        thermal: (B, H', W') uint8.
        label: (B, H', W') uint8.
        confidence: (B, H', W') float32, or None.
        rows: (B, 3, h) int64, first and second row that is read, and weight (see `Taps`).
        columns: (B, 3, w) int64, likewise.
        nearest_rows: (B, h) int64, row of the label.
        nearest_columns: (B, w) int64, column of the label.
        corner_yx: (B, 2) int64, of each part in its original.
        tables: (B, 4, 256) uint8, value of every grey level: of RGB before HSV, of the HSV
            saturation, of RGB after HSV, of thermal.
        hue: (B,) int64, added to the HSV hue.
        saturated: examples whose saturation changes, by their place in the batch.
        turned: examples whose hue changes.
        centre_yx: (B, 2) int64, see `rgbt.types.Batch`, like all below.
        original_hw: (B, 2) int64.
        track_position: whether the batch gets the map of source positions.
    """

    name: tuple[str, ...]
    rgb: Tensor
    thermal: Tensor
    label: Tensor
    confidence: Tensor | None
    rows: Tensor
    columns: Tensor
    nearest_rows: Tensor
    nearest_columns: Tensor
    corner_yx: Tensor
    tables: Tensor
    hue: Tensor
    saturated: tuple[int, ...]
    turned: tuple[int, ...]
    centre_yx: Tensor
    original_hw: Tensor
    track_position: bool

    @classmethod
    def of(cls, drawn: Sequence[Drawn], *, track_position: bool) -> DrawnBatch:
        """Stack examples; InputError where their sizes differ, or only some carry confidences."""
        _check_alike(drawn)
        hw = tuple(max(each.label.shape[axis] for each in drawn) for axis in (0, 1))
        confidences = [each.confidence for each in drawn if each.confidence is not None]
        return cls(
            name=tuple(each.name for each in drawn),
            rgb=_padded([each.rgb for each in drawn], hw),
            thermal=_padded([each.thermal for each in drawn], hw),
            label=_padded([each.label for each in drawn], hw),
            confidence=_padded(confidences, hw) if confidences else None,
            rows=_stacked(each.rows.taps for each in drawn),
            columns=_stacked(each.columns.taps for each in drawn),
            nearest_rows=_stacked(each.rows.nearest for each in drawn),
            nearest_columns=_stacked(each.columns.nearest for each in drawn),
            corner_yx=torch.tensor(
                [[each.rows.span.start, each.columns.span.start] for each in drawn]
            ),
            tables=_stacked(_tables(each.colours) for each in drawn),
            hue=torch.tensor([each.colours.hue or 0 for each in drawn]),
            saturated=_places(each.colours.saturation is not None for each in drawn),
            turned=_places(each.colours.hue is not None for each in drawn),
            centre_yx=torch.tensor([each.view.centre_yx() for each in drawn]),
            original_hw=torch.tensor([each.view.source_hw for each in drawn]),
            track_position=track_position,
        )

    def to(self, device: torch.device | str) -> Batch:
        """The augmented batch on `device`, images as float32 in [0, 1]."""
        moved: dict[str, Any] = {
            each.name: getattr(self, each.name).to(device, non_blocking=True)
            for each in fields(self)
            if isinstance(getattr(self, each.name), Tensor)
        }
        there = replace(self, **moved)
        images = there._resized()
        rgb = there._coloured(images[..., :3])
        thermal = there._looked_up(3, images[..., 3])
        rows, columns = there.nearest_rows, there.nearest_columns
        return Batch(
            rgb=rgb.movedim(-1, 1).contiguous().float() / 255.0,
            thermal=thermal[:, None].float() / 255.0,
            label=_at(there.label, rows, columns).long(),
            name=self.name,
            centre_yx=there.centre_yx,
            position=there._position() if self.track_position else None,
            original_hw=there.original_hw,
            confidence=None if there.confidence is None else _at(there.confidence, rows, columns),
        )

    def _resized(self) -> Tensor:
        """(B, h, w, 4) int64: bilinear, rounded as `View.bilinear` rounds uint8 images."""
        # Four channels of eight bits are read as one number.
        whole = torch.cat([self.rgb, self.thermal[..., None]], dim=-1).view(torch.int32)[..., 0]

        def read(rows: Tensor, columns: Tensor) -> Tensor:
            pixels = _at(whole, rows, columns)
            return pixels[..., None].view(torch.uint8).int()

        top, bottom, down = self.rows.unbind(1)
        left, right, along = self.columns.unbind(1)
        along = along.int()[:, None, :, None]
        down = down.int()[:, :, None, None]
        upper, lower = (
            read(rows, left) * (256 - along) + read(rows, right) * along for rows in (top, bottom)
        )
        return ((upper * (256 - down) + lower * down + (1 << 15)) >> 16).long()

    def _coloured(self, rgb: Tensor) -> Tensor:
        """(B, h, w, 3) int64 after `Colours.rgb`."""
        rgb = self._looked_up(0, rgb)
        if self.saturated:
            which = torch.tensor(self.saturated, device=rgb.device)
            hue, saturation, value = to_hsv(rgb[which])
            saturation = self._looked_up(1, saturation, which)
            rgb = rgb.index_copy(0, which, to_rgb(hue, saturation, value))
        if self.turned:
            which = torch.tensor(self.turned, device=rgb.device)
            hue, saturation, value = to_hsv(rgb[which])
            hue = (hue + self.hue[which, None, None]) % 180
            rgb = rgb.index_copy(0, which, to_rgb(hue, saturation, value))
        return self._looked_up(2, rgb)

    def _looked_up(self, table: int, levels: Tensor, which: Tensor | None = None) -> Tensor:
        """Levels (B, ...) int64 through one of the tables of each example."""
        tables = self.tables[:, table] if which is None else self.tables[which, table]
        found = tables.gather(1, levels.flatten(1))
        return found.view(levels.shape).long()

    def _position(self) -> Tensor:
        """(B, 2, h, w) float32, as `View.position`."""
        rows = self.nearest_rows + self.corner_yx[:, :1]
        columns = self.nearest_columns + self.corner_yx[:, 1:]
        shape = (len(rows), rows.shape[1], columns.shape[1])
        both = rows[:, :, None].expand(shape), columns[:, None].expand(shape)
        return torch.stack(both, dim=1).float()


def _at(image: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """(B, h, w): pixels of images (B, H, W) at every row (B, h) and column (B, w)."""
    index = rows[:, :, None] * image.shape[2] + columns[:, None, :]
    return image.flatten(1).gather(1, index.flatten(1)).view(index.shape)


def _tables(colours: Colours) -> NDArray[np.uint8]:
    """(4, 256) uint8, see `DrawnBatch.tables`."""
    before = after = LEVELS
    if colours.brightness is not None:
        before = scale_and_truncate(LEVELS, offset=colours.brightness)
    contrast = LEVELS if colours.contrast is None else scale_and_truncate(LEVELS, colours.contrast)
    if colours.contrast_first:
        before = contrast[before]
    else:
        after = contrast
    saturation = LEVELS
    if colours.saturation is not None:
        saturation = scale_and_truncate(LEVELS, colours.saturation)
    return np.stack([each.ravel() for each in (before, saturation, after, colours.thermal(LEVELS))])


def _stacked(arrays: Iterable[NDArray[Any]]) -> Tensor:
    return torch.from_numpy(np.stack(list(arrays)))


def _padded(parts: Sequence[NDArray[Any]], hw: tuple[int, ...]) -> Tensor:
    """Parts in the top left corners of one array of H' x W'."""
    first = parts[0]
    stacked = np.empty((len(parts), *hw, *first.shape[2:]), first.dtype)
    for place, part in zip(stacked, parts, strict=True):
        place[: part.shape[0], : part.shape[1]] = part
    return torch.from_numpy(stacked)


def _places(changed: Any) -> tuple[int, ...]:
    return tuple(place for place, yes in enumerate(changed) if yes)


def _check_alike(drawn: Sequence[Drawn]) -> None:
    first = drawn[0]
    for each in drawn[1:]:
        one, other = first.view.window_hw, each.view.window_hw
        if one != other:
            raise InputError(
                f"all images of one batch must have one size, got {one[0]}x{one[1]} "
                f"('{first.name}') and {other[0]}x{other[1]} ('{each.name}'); choose "
                "transform.crop_hw so that it fits into every resized image, or choose the sizes "
                "for this data set (recipe=kp, ...)."
            )
        if (first.confidence is None) != (each.confidence is None):
            raise InputError(
                f"all labels of one batch must carry confidences, or none, but '{first.name}' and "
                f"'{each.name}' differ. Write the pseudo-labels of the whole split again."
            )
