"""The list of exported pairs of frames, ``pairs.json``: names, angles, and their origin."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from rgbt.checks import InputError, one_line
from rgbt.files.plain_files import read_json, write_json

PAIR_LIST = "pairs.json"

# Kind of the second frames: virtual views, stored beside the first, or the next of a video.
Frames = Literal["virtual", "next", "video"]


@dataclass(frozen=True)
class ListedPair:
    """One pair: names of both images, the set of views (from 1), and its angles in degrees."""

    first: str
    second: str
    set: int
    yaw: float | None = None
    pitch: float | None = None
    roll: float | None = None


@dataclass(frozen=True)
class PairList:
    """The content of ``pairs.json``; `complete`: all images are written.

    `name` is that of the data set, `dataset` its fingerprint. `views` marks the second frames
    (`rgbt.evaluation.pairs.frames.FramePairs`); "published": the published sets of virtual views.
    """

    format: Literal["rgbt pairs 1"]
    complete: bool
    dataset: str
    name: str
    split: str
    frames: Frames
    views: str
    sets: tuple[str, ...]
    pairs: tuple[ListedPair, ...]

    @property
    def images(self) -> tuple[str, ...]:
        """Return the names of all images, each once."""
        names = (name for pair in self.pairs for name in (pair.first, pair.second))
        return tuple(dict.fromkeys(names))

    def write(self, folder: Path) -> None:
        """Write ``pairs.json``."""
        write_json(folder / PAIR_LIST, asdict(self))


def second_name(first: str, frames: Frames, number: int) -> str:
    """Return the name of a second frame; `number` of the set of views, from 0."""
    return f"{first}_next" if frames == "next" else f"{first}_view{number + 1}"


def read_list(place: Path) -> PairList:
    """Read the list of pairs in a folder, or at the path of the file; InputError: no list."""
    path = place / PAIR_LIST if place.is_dir() else place
    if not path.is_file():
        raise InputError(f"{path} does not exist; name the folder of the export: pairs=FOLDER.")
    listed: PairList = read_json(path, PairList, "write the images again with export=...")
    return listed


def check_same(listed: PairList, wanted: PairList) -> None:
    """Refuse predictions of other images than those that are counted, by InputError."""
    if not listed.complete:
        raise InputError(f"the export of {listed.name} was interrupted; rerun it, then predict.")
    for key in ("split", "frames", "dataset", "views", "pairs"):
        exported, counted = getattr(listed, key), getattr(wanted, key)
        if exported != counted:
            said = f"the pairs were exported from {one_line(exported)}, but {one_line(counted)}"
            said += " is counted"
            raise InputError(f"{key}: {said}; give the settings of the export.")
