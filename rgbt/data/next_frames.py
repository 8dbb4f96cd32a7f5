"""Read real second frames of a data set from the folder `next` beside its images.

`synth` writes one (``dataset.ego_forward_m=...``); any data set in MFNet's layout may hold one:

    next/                 the same layout and the same names, one moment later
    next/flow/NAME.npy    (H, W, 2) float32: for every pixel of the second frame, how many (rows,
                          columns) further the same point lies in the first; NaN if it is hidden
                          there or outside
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.data.files import read_array
from rgbt.data.mfnet import MFNet
from rgbt.dataset import LabelledDataset, reader_of

FOLDER = "next"


class NextFrames:
    """The second frames of a data set, and the positions of their points in the first frames.

    Args:
        first: the data set of the first frames, in MFNet's layout.

    Attributes:
        dataset: reader of the second frames.

    Raises:
        InputError: the data set has no second frames, or another layout.
    """

    def __init__(self, first: LabelledDataset) -> None:
        first = reader_of(first)
        if not isinstance(first, MFNet):
            raise InputError(
                f"{first.name} ({first.root}) has no second frames, which require MFNet's layout. "
                "Choose dataset=synth with dataset.ego_forward_m=0.5, or use frames=virtual."
            )
        root = first.root / FOLDER
        if not (root / "flow").is_dir():
            raise InputError(
                f"{first.name} ({first.root}) has no second frames: expected the folder {FOLDER}/ "
                "with images, labels and flow. dataset=synth writes it with "
                "dataset.ego_forward_m=0.5; frames=virtual does not require it."
            )
        self.dataset = MFNet(
            str(root),
            name=f"{first.name}/{FOLDER}",
            num_classes=first.num_classes,
            classes=first.classes,
            background=first.background,
            palette=first.palette,
            splits=dict(first.splits),
            layout=first.layout,
        )

    def flow(self, name: str, image_hw: tuple[int, int]) -> NDArray[np.float32]:
        """Offset (H, W, 2) of each pixel of the second frame to its position in the first.

        Args:
            name: of the frame.
            image_hw: its size, which the flow must have.

        Returns:
            (rows, columns); NaN if the point was not visible.

        Raises:
            InputError: no flow, or one of another size.
        """
        path = self._path(name)
        flow = read_array(path, "one array of rows and columns")
        if flow.dtype.kind != "f" or flow.shape != (*image_hw, 2):
            raise InputError(
                f"{path} must be an array of {image_hw[0]} x {image_hw[1]} x 2 real numbers (rows, "
                f"columns) like its frame, got {' x '.join(map(str, flow.shape))} {flow.dtype}."
            )
        return np.asarray(flow, np.float32)

    def source(self, name: str, image_hw: tuple[int, int]) -> tuple[NDArray[np.int64], ...]:
        """Position of each pixel of the second frame in the first frame.

        Args:
            name: of the frame.
            image_hw: its size, which the flow must have.

        Returns:
            rows and columns (H, W) int64, nearest pixels; -1 if the point was not visible.

        Raises:
            InputError: no flow, one of another size, or one that leads out of the image.
        """
        flow = self.flow(name, image_hw)
        rows, columns = np.indices(image_hw)
        grid = np.stack([rows, columns], axis=-1)
        seen = np.isfinite(flow[..., 0]) & np.isfinite(flow[..., 1])
        first_yx = np.rint(np.where(seen[..., None], grid + flow, 0)).astype(np.int64)
        if (first_yx < 0).any() or (first_yx >= image_hw).any():
            raise InputError(
                f"{self._path(name)} points outside the first frame of "
                f"{image_hw[0]}x{image_hw[1]} pixels; points that were not visible there must be "
                "NaN."
            )
        first_yx[~seen] = -1
        return first_yx[..., 0], first_yx[..., 1]

    def _path(self, name: str) -> Path:
        return self.dataset.root / "flow" / f"{name}.npy"
