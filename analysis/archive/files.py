"""The archive of results: one small file per finished run, kept in the repository.

``results/<key>.zip`` holds the configuration, the result, the provenance and all counts of a run.
What runs on the same images share is in ``results/shared/`` once: names of images and classes, and
the number of pixels of each label. Of the counts a run then keeps the wrong predictions only: the
right ones are what is left of the labelled pixels. Unpacked, a run is a folder that
`rgbt.runs.result.RunResult` reads; its counts are equal, bit for bit.

No file depends on another run, so two machines that add runs never conflict.
"""

from __future__ import annotations

import hashlib
import io
import json
import lzma
import os
import tempfile
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, one_line
from rgbt.files.atomic import write_atomic
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import details_of
from rgbt.metrics.pairs import protocol_of
from rgbt.runs.result import RunResult

SHARED = "shared"
COUNTS = ("counts_*.npz", "evaluations/*.npz", "evaluations/robustness/*/*.npz")
TEXTS = ("config.yaml", "run.json", "result.json", "evaluations/robustness/*/*.json")
"""Files of a run folder that are archived: its counts, and what is kept as it is."""

PROVENANCE = (
    *("started", "command", "git_commit", "git_dirty", "code", "python", "threads"),
    *("platform", "cpu", "cpu_usable", "gpus", "cuda"),
)
PACKAGES = ("torch", "numpy", "opencv-python-headless", "lightning-fabric", "hydra-core", "optuna")
"""Entries of the provenance, and the packages whose versions are archived. Paths and the name of
the machine are of no use elsewhere."""

DAMAGED = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, NotImplementedError),
    *(KeyError, ValueError, TypeError, OSError),
)


@dataclass(frozen=True)
class ArchivedRun:
    """A run in the archive.

    Attributes:
        path: ``results/<key>.zip``, or ``<key>-<digest>.zip`` for other results of the same key.
    """

    path: Path

    @property
    def key(self) -> str:
        """Key of the run."""
        return self.path.stem.partition("-")[0]

    def unpack(self, folder: Path | None = None) -> RunResult:
        """The run as ``<digest of the file>/<key>`` in `folder` (None: the user's cache), once.

        Raises:
            InputError: a damaged file, or one that belongs to another run.
        """
        folder = folder or cache_folder()
        target = folder / hashlib.sha256(self.path.read_bytes()).hexdigest()[:16] / self.key
        if target.is_dir():
            return RunResult(target)
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            unpacked = Path(scratch, "run")
            try:
                self._write(unpacked)
            except DAMAGED as error:
                raise InputError(f"{self.path} is damaged ({one_line(error)}).") from error
            result = RunResult(unpacked).result
            if result.get("key", self.key) != self.key:
                raise InputError(f"{self.path} holds the run {result['key']}; rename the file.")
            target.parent.mkdir(exist_ok=True)
            try:
                unpacked.rename(target)
            except OSError:
                if not target.is_dir():  # another process was not faster
                    raise
        return RunResult(target)

    def _write(self, folder: Path) -> None:
        """Write every member as a file in `folder`."""
        with zipfile.ZipFile(self.path) as archive:
            for entry in archive.namelist():
                path = folder / entry.removesuffix(".xz")
                if not path.resolve().is_relative_to(folder.resolve()):
                    raise ValueError(f"'{entry}' leads out of the folder")
                path.parent.mkdir(parents=True, exist_ok=True)
                if entry.endswith(".npz.xz"):
                    _unpack_counts(archive.read(entry), self.path.parent / SHARED).save(path)
                else:
                    write_atomic(path, archive.read(entry))


def cache_folder() -> Path:
    """Where archived runs are unpacked for reading."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home, "rgbt", "archive")


def archived(folder: Path) -> list[ArchivedRun]:
    """All runs of an archive, by key."""
    return [ArchivedRun(path) for path in sorted(folder.glob("*.zip"))]


def counts_of(folder: Path) -> list[Path]:
    """The files of counts of a run folder."""
    return sorted(each for pattern in COUNTS for each in folder.glob(pattern))


def add(run: RunResult, folder: Path) -> ArchivedRun:
    """Put a finished run into the archive `folder`; the same results are written once.

    Other results of the same key, from another machine, are kept beside as ``<key>-<digest>.zip``.

    Raises:
        InputError: the run is not finished, or one of its files is damaged.
    """
    content = _packed(run, folder / SHARED)
    path = folder / f"{run.key}.zip"
    if path.exists() and path.read_bytes() != content:
        digest = hashlib.sha256(content).hexdigest()[:8]
        path = folder / f"{run.key}-{digest}.zip"
    if not path.exists():
        write_atomic(path, content)
    return ArchivedRun(path)


def _packed(run: RunResult, shared: Path) -> bytes:
    """The bytes of ``<key>.zip``, equal for equal runs; shared arrays are written to `shared`."""
    if not run.is_finished:
        raise InputError(f"{run.folder} is not finished; rerun its command.")
    shared.mkdir(parents=True, exist_ok=True)
    texts = [path for name in TEXTS for path in sorted(run.folder.glob(name))]
    members = {path.relative_to(run.folder).as_posix(): path.read_bytes() for path in texts}
    entries = [
        {name: entry.get(name) for name in PROVENANCE}
        | {"packages": {name: entry.get("packages", {}).get(name) for name in PACKAGES}}
        for entry in run.provenance
    ]
    members["provenance.json"] = json.dumps(entries, indent=1).encode()
    for path in counts_of(run.folder):
        name = path.relative_to(run.folder).as_posix()
        members[f"{name}.xz"] = _packed_counts(Counts.load(path), shared)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in members.items():
            how = zipfile.ZIP_STORED if name.endswith(".xz") else zipfile.ZIP_DEFLATED
            archive.writestr(zipfile.ZipInfo(name), content, how)  # the time of an info is fixed
    return file.getvalue()


def _is_confusion(partition: str) -> bool:
    """Whether counts are confusion matrices, whose rows sum to the pixels of the label."""
    return details_of(partition) is None and protocol_of(partition) is None


def _packed_counts(counts: Counts, shared: Path) -> bytes:
    """LZMA of a JSON line and of the bytes of the counts, images last and by significance."""
    array = counts.counts
    common: dict[str, Any] = {
        "names": np.array(counts.names),
        "night": np.array(() if counts.night is None else counts.night, bool),
        "classes": np.array(counts.classes),
        "unscored": np.array(counts.unscored, str),
    }
    if _is_confusion(counts.partition):
        common["labelled"] = array.sum(-1, dtype=np.int64)
        array = array.copy()
        array[..., range(array.shape[-1]), range(array.shape[-1])] = 0
    header = {
        "shared": _write_shared(common, shared),
        "dtype": array.dtype.str,
        "shape": array.shape,
        **{key: getattr(counts, key) for key in ("partition", "dataset", "split", "absent", "run")},
    }
    images_last = np.ascontiguousarray(np.moveaxis(array, 0, -1))
    planes = images_last.view(np.uint8).reshape(-1, array.itemsize).T
    return lzma.compress(json.dumps(header).encode() + b"\n" + planes.tobytes(), preset=9)


def _unpack_counts(content: bytes, shared: Path) -> Counts:
    line, _, planes = lzma.decompress(content).partition(b"\n")
    header = json.loads(line)
    common = _read_shared(header.pop("shared"), shared)
    dtype, (images, *rest) = np.dtype(header.pop("dtype")), header.pop("shape")
    flat = np.frombuffer(planes, np.uint8).reshape(dtype.itemsize, -1).T
    images_last = np.ascontiguousarray(flat).view(dtype).reshape(*rest, images)
    array = np.ascontiguousarray(np.moveaxis(images_last, -1, 0))
    if "labelled" in common:
        classes = range(array.shape[-1])
        array[..., classes, classes] = common["labelled"] - array.sum(-1)
    texts = {name: tuple(common[name].tolist()) for name in ("names", "classes", "unscored")}
    night = tuple(common["night"].tolist()) or None
    fields: dict[str, Any] = {**texts, **header, "counts": array, "night": night}
    return Counts(**fields)


def _write_shared(arrays: dict[str, NDArray[Any]], shared: Path) -> str:
    """The name of the file with these arrays, which is a digest of its content."""
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    name = hashlib.sha256(file.getvalue()).hexdigest()[:16]
    if not (shared / f"{name}.npz.xz").exists():
        write_atomic(shared / f"{name}.npz.xz", lzma.compress(file.getvalue(), preset=9))
    return name


def _read_shared(name: str, shared: Path) -> dict[str, NDArray[Any]]:
    path = shared / f"{Path(name).name}.npz.xz"
    content = lzma.decompress(path.read_bytes())
    if hashlib.sha256(content).hexdigest()[:16] != name:
        raise ValueError(f"{path} does not match its digest")
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return dict(arrays)
