"""Data sets that wrap another one: what each leaves unchanged."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from pathlib import Path

import pytest

from rgbt.config.corruption_node import choose_corruption
from rgbt.data.cache import CachedDataset
from rgbt.data.mfnet import CLASSES, MFNet
from rgbt.data.pseudo_labels import FORMAT, PseudoLabelled, Unlabelled
from rgbt.dataset import DatasetWrapper, reader_of
from rgbt.evaluation.corruption import CorruptedDataset
from rgbt.files.plain_files import write_json

NAMES = ("00001D", "00002N")


def pseudo(source: MFNet, folder: Path) -> PseudoLabelled:
    manifest = {"format": FORMAT, "classes": CLASSES, "digest": "abc"}
    write_json(folder / "pseudo_labels.json", manifest)
    return PseudoLabelled(source, folder, with_confidence=True)


WRAPPERS: dict[str, Callable[[MFNet, Path], DatasetWrapper]] = {
    "cached": lambda source, folder: CachedDataset(source, str(folder / "cache")),
    "pseudo-labelled": pseudo,
    "unlabelled": lambda source, folder: Unlabelled(source),
    "corrupted": lambda source, _: CorruptedDataset(source, choose_corruption("noise"), 8, "train"),
}


@pytest.mark.parametrize("kind", WRAPPERS)
def test_other_members_are_those_of_source(
    write_mfnet: Callable[..., Path], tmp_path: Path, kind: str
) -> None:
    source = MFNet(str(write_mfnet({"train": list(NAMES)}, (2, 3))))
    wrapped = WRAPPERS[kind](source, tmp_path)
    # As worker processes get it.
    for each in (wrapped, pickle.loads(pickle.dumps(wrapped)), copy.deepcopy(wrapped)):
        members = ("root", "name", "num_classes", "classes", "palette", "unscored", "background")
        for key in (*members, "splits", "record"):
            assert getattr(each, key) == getattr(source, key)
        assert each.names("train") == NAMES
        assert (each.has("train"), each.has("val")) == (True, False)
        assert each.files("00001D") == source.files("00001D")
        assert each.decoding().items() >= source.decoding().items()
        assert each.nights(NAMES) == (False, True)
        assert each.fingerprint() == source.fingerprint()
        assert not hasattr(each, "nothing")
    assert reader_of(Unlabelled(wrapped)) is source
