"""Keep decoded images in memory-mapped files, one for each sample (`data.cache`).

Decoding a PNG of 480x640 pixels takes ten milliseconds, a view of the file almost no time.
"""

from __future__ import annotations

import hashlib
import json
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.dataset import DatasetWrapper, LabelledDataset
from rgbt.files.atomic import cache_folder, replacing
from rgbt.types import Sample


@lru_cache(maxsize=4096)
def opened(path: Path) -> NDArray[np.uint8]:
    """Map the planes of a file, (4 or 5, H, W), once, as mapping costs as much as a crop."""
    return np.asarray(np.load(path, mmap_mode="r"))


class CachedDataset(DatasetWrapper):
    """Decodes samples of a data set once, and then reads them from files of `folder`.

    The name of a file is a hash of the sample, the settings of its decoding, and path, length and
    times of its files, so that a changed file is decoded again. Files of former states are kept.
    The folder "auto" is $XDG_CACHE_HOME/rgbt/decoded or ~/.cache/rgbt/decoded.
    """

    def __init__(self, dataset: LabelledDataset, folder: str) -> None:
        super().__init__(dataset)
        self.folder = cache_folder() / "decoded" if folder == "auto" else Path(folder).expanduser()
        settings = ["upright", type(dataset).__qualname__, dataset.name, dataset.decoding()]
        self._settings = json.dumps(settings, default=str)

    def read(self, name: str) -> Sample:
        """Read the sample as `source.read` does; its images are read-only views of the file.

        InputError: that of `source.read`, or the file cannot be written.
        """
        path = self._path(name)
        try:
            images = opened(path)
        except (OSError, ValueError, EOFError):  # not there yet, or damaged
            sample = self.source.read(name)
            self._write(path, sample)
            return sample
        hw = images.shape[1:]
        # The first three planes are the bytes of the RGB image, whose channels are interleaved.
        rgb, label = images[:3].reshape(*hw, 3), images[4] if len(images) == 5 else None
        return Sample(rgb=rgb, thermal=images[3], label=label, name=name)

    def label(self, name: str) -> NDArray[np.uint8] | None:
        """Return the label of `read` alone, (H, W); None if the pair is unlabelled."""
        return self.read(name).label

    def _path(self, name: str) -> Path:
        digest = hashlib.sha256(f"{self._settings} {name}".encode())
        for file in self.source.files(name):
            try:
                status = file.stat()
            except OSError:  # reading it raises the message
                continue
            state = (status.st_size, status.st_mtime_ns, status.st_ctime_ns)
            digest.update(f"{file.absolute()} {state}".encode())
        return self.folder / f"{digest.hexdigest()[:32]}.npy"

    def _write(self, path: Path, sample: Sample) -> None:
        hw = sample.thermal.shape
        images = [sample.rgb.reshape(3, *hw), sample.thermal[None]]
        images += [] if sample.label is None else [sample.label[None]]
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path) as file:
                np.save(file, np.concatenate(images))
        except OSError as error:
            raise InputError(
                f"data.cache: cannot write {path} ({error.strerror}); name a writable folder with "
                "data.cache=FOLDER, or use none with data.cache=null."
            ) from error
