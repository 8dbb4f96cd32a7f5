"""The list of the pairs of frames that are exported as images, and what they are made of."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from rgbt.checks import InputError, nearest
from rgbt.config.command import composing
from rgbt.config.component import build
from rgbt.config.compose import SEARCH_PATH, compose
from rgbt.data.loader_settings import LoaderSettings
from rgbt.dataset import LabelledDataset
from rgbt.evaluation.pair_frames import PROTOCOLS, Frames, check_frames, frames_mark
from rgbt.files.atomic import write_atomic
from rgbt.files.budgets import read_json
from rgbt.metrics.metric import Regions
from rgbt.metrics.pairs import PAIR_LIST
from rgbt.transforms.view_sets import ViewSets

HEEDED = ("dataset", "consistency", "metric.absent", "scale", SEARCH_PATH)
"""Settings that decide which images are written and how predictions are counted."""


@dataclass(frozen=True)
class PairSource:
    """The images of pairs, without a network; see `rgbt.evaluation.prediction.EvaluationData`."""

    dataset: LabelledDataset
    transform: Any
    loading: LoaderSettings
    regions: Regions
    consistency: ViewSets

    @classmethod
    def compose(cls, overrides: Sequence[str]) -> PairSource:
        """From overrides of the configuration; images have the size of their files.

        Raises:
            InputError: no data set is named, an override without effect, or wrong settings.
        """
        keys = [word.lstrip("+~").partition("=")[0].rpartition("@")[2] for word in overrides]
        for key in keys:
            if not any(f"{key}.".startswith(f"{each}.") for each in HEEDED):
                raise InputError(
                    f"'{key}' has no effect on images of pairs and their predictions; "
                    f"{nearest(key, HEEDED)}."
                )
        if "dataset" not in keys:
            raise InputError(
                "no data set is named; set dataset=mfnet dataset.root=/data/MFNet, or "
                "dataset=synth for the embedded data set."
            )
        words = [*overrides, "transform=none"]
        with composing(words):
            config = compose(words)
            return cls(
                dataset=build(config.dataset),
                transform=build(config.transform),
                # One at a time, because the images may have any sizes.
                loading=LoaderSettings(batch_size=1, eval_batch_size=1, num_workers=0),
                regions=build(config.metric),
                consistency=build(config.consistency),
            )


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
    """The content of ``pairs.json``.

    Attributes:
        format: version of the file.
        complete: whether all images are written.
        dataset: fingerprint of the data set.
        name: of the data set.
        split: of the data set.
        frames: what the second frames are.
        views: mark of the second frames (`rgbt.evaluation.pair_frames.frames_mark`); "published":
            the published sets of virtual views.
        sets: names of the sets of views.
        pairs: in the order of the split.
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

    @classmethod
    def of(cls, source: PairSource, split: str, frames: Frames) -> PairList:
        """The pairs of a split.

        Raises:
            InputError: there are no second frames, or a second image would have the name of
                another one.
        """
        check_frames(source, frames)
        names = tuple(dict.fromkeys(source.dataset.names(split)))
        pairs = tuple(_pairs(source, names, split, frames))
        taken = set(names)
        for pair in pairs:
            if pair.second in taken:
                raise InputError(
                    f"the second frame of '{pair.first}' would have the name '{pair.second}' of "
                    f"another image of split '{split}'; rename that image."
                )
        return cls(
            format="rgbt pairs 1",
            complete=True,
            dataset=source.dataset.fingerprint(),
            name=source.dataset.name,
            split=split,
            frames=frames,
            views=frames_mark(source, PROTOCOLS[frames][0]) or "published",
            sets=tuple(source.consistency.sets) if frames == "virtual" else (),
            pairs=pairs,
        )

    @property
    def images(self) -> tuple[str, ...]:
        """Names of all images, each once."""
        names = (name for pair in self.pairs for name in (pair.first, pair.second))
        return tuple(dict.fromkeys(names))

    def write(self, folder: Path) -> None:
        """Write ``pairs.json``."""
        write_atomic(folder / PAIR_LIST, f"{json.dumps(asdict(self), indent=1)}\n".encode())


def second_name(first: str, frames: Frames, number: int) -> str:
    """Name of a second frame; `number` of the set of views, from 0."""
    return f"{first}_next" if frames == "next" else f"{first}_view{number + 1}"


def _pairs(
    source: PairSource, names: Sequence[str], split: str, frames: Frames
) -> Iterator[ListedPair]:
    if frames == "next":
        yield from (ListedPair(name, second_name(name, frames, 0), 1) for name in names)
        return
    listed = source.dataset.names(split)
    position = dict(zip(reversed(listed), reversed(range(len(listed))), strict=True))
    for name in names:
        for number in range(len(source.consistency.sets)):
            (angles,) = source.consistency.angles(number, [position[name]]).tolist()
            yield ListedPair(name, second_name(name, frames, number), number + 1, *angles)


def read_list(place: Path) -> PairList:
    """The list of pairs in a folder, or at the path of the file itself.

    Raises:
        InputError: there is none, or it is damaged.
    """
    path = place / PAIR_LIST if place.is_dir() else place
    if not path.is_file():
        raise InputError(
            f"{path} does not exist; name the folder of the export with pairs=FOLDER, or copy its "
            f"{PAIR_LIST} to the predictions."
        )
    listed: PairList = read_json(path, PairList, "write the images again with export=...")
    return listed


def check_same(listed: PairList, wanted: PairList) -> None:
    """Refuse predictions of other images than those that are counted."""
    if not listed.complete:
        raise InputError(
            f"the export of {listed.name} was interrupted; rerun its command, then predict again."
        )
    for key in ("split", "frames"):
        given, expected = getattr(wanted, key), getattr(listed, key)
        if given != expected:
            raise InputError(
                f"the pairs were exported with {key}={expected}, but {key}={given} is counted; "
                f"set {key}={expected}."
            )
    if listed.dataset != wanted.dataset:
        raise InputError(
            f"the pairs were exported from other images ({listed.name}, {listed.dataset[:8]}) than "
            f"those of {wanted.name} ({wanted.dataset[:8]}); name the data set of the export."
        )
    if (listed.views, listed.pairs) != (wanted.views, wanted.pairs):
        sets = ", ".join(listed.sets) or "real frames"
        raise InputError(
            f"the pairs were exported with another set of views ({sets}; {listed.views}) than the "
            f"one that is counted ({', '.join(wanted.sets) or 'real frames'}; {wanted.views}); "
            "give the consistency settings of the export."
        )
