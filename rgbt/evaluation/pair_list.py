"""Images of pairs of frames that are exported, without a network, and their list."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from rgbt.checks import InputError, nearest
from rgbt.config.command import composing
from rgbt.config.component import build
from rgbt.config.compose import SEARCH_PATH, compose
from rgbt.data.loader_settings import LoaderSettings
from rgbt.dataset import LabelledDataset
from rgbt.evaluation.pair_frames import check_frames
from rgbt.evaluation.pairing import Pairing
from rgbt.metrics.metric import Regions
from rgbt.metrics.pair_list import Frames, ListedPair, PairList, second_name
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


def list_pairs(source: PairSource, split: str, frames: Frames) -> PairList:
    """The pairs of a split.

    Raises:
        InputError: there are no second frames, or a second image would have the name of
            another one.
    """
    check_frames(source, frames)
    pairing = Pairing(frames)
    names = tuple(dict.fromkeys(source.dataset.names(split)))
    pairs = tuple(_pairs(source, names, split, frames))
    taken = set(names)
    for pair in pairs:
        if pair.second in taken:
            raise InputError(
                f"the second frame of '{pair.first}' would have the name '{pair.second}' of "
                f"another image of split '{split}'; rename that image."
            )
    return PairList(
        format="rgbt pairs 1",
        complete=True,
        dataset=source.dataset.fingerprint(),
        name=source.dataset.name,
        split=split,
        frames=frames,
        views=pairing.mark(source, pairing.protocols[0]) or "published",
        sets=tuple(source.consistency.sets) if frames == "virtual" else (),
        pairs=pairs,
    )


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
