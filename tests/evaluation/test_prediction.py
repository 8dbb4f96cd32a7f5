"""What all evaluations share: which view and head predict, and images that are decoded ahead."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.corruptions.noise import Noise
from rgbt.data.cache.dataset import CachedDataset
from rgbt.data.domains import Domain, Domains
from rgbt.data.mfnet import MFNet
from rgbt.evaluation.corrupted_dataset import CorruptedDataset
from rgbt.evaluation.prediction import decode_ahead, heads_of, view_of
from rgbt.requirements import Record


class Network:
    record = Record(views=("rgb", "thermal"))


def session_of(source: dict[str, object], **changes: object) -> SimpleNamespace:
    """The part of a session that `view_of` and `heads_of` use."""
    target = {"split": "x", "view": "rgb", "head": "dark", "labels": "none"}
    given = {
        "source": Domain(**{"split": "x", "view": None, "head": None, "labels": "given", **source}),
        **{"target": None, "target_is": None, "tested_head": "own", **changes},
    }
    if given["target_is"] is not None:
        given["target"] = Domain(**target)
    return SimpleNamespace(model=Network(), dataset=Nights(), domains=Domains(**given))


class Nights:
    def __init__(self) -> None:
        self.calls = 0

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...]:
        self.calls += 1
        if any(name not in ("day", "night") for name in names):
            raise InputError("no such frame")
        return tuple(name == "night" for name in names)


@pytest.mark.parametrize(("view", "seen"), [("thermal", "thermal"), ("rgb", "rgb"), (None, "rgb")])
def test_view_of_defaults_to_the_source_domain(view: str | None, seen: str) -> None:
    """The network's first view only where the domain does not say."""
    session = session_of({"view": view})
    assert view_of(session) == view_of(session, None) == seen
    assert view_of(session, "thermal") == "thermal"
    with pytest.raises(InputError, match="modality: 'rgbt' is not a choice"):
        view_of(session, "rgbt")


def test_heads_of_listed_images() -> None:
    session = session_of({"head": "day", "view": "rgb"}, target_is="night")
    assert heads_of(session, "rgb")(("day", "night", "day")) == ("day", "dark", "day")
    assert heads_of(session, "rgb", "target")(("day", "night")) == ("dark", "dark")
    one = session_of({"head": "day", "view": "rgb"}, target_is="night", tested_head="source")
    assert heads_of(one, "rgb")(("day", "night")) == ("day", "day")
    assert heads_of(one, "rgb", "own")(("day", "night")) == ("day", "dark")


def test_heads_of_unlisted_images() -> None:
    """Own files: whether they are of the night is unknown, and not looked up in vain."""
    session = session_of({"head": "day", "view": "rgb"}, target_is="night")
    for requested, head in (("source", "day"), ("target", "dark")):
        assert heads_of(session, "rgb", requested)(("mine", "night")) == (head, head)
    assert session.dataset.calls == 0
    with pytest.raises(InputError, match=r"night, so no head can be chosen; set head=source"):
        heads_of(session, "rgb")(("mine",))
    alone = session_of({"view": "rgb"})
    assert heads_of(alone, "rgb")(("mine", "yours")) == (None, None)
    assert alone.dataset.calls == 0


@pytest.mark.parametrize("corrupted", [False, True])
def test_decode_ahead_decodes_the_requested_splits(
    write_mfnet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, corrupted: bool
) -> None:
    splits = {"train": ["00001D", "00002N"], "val": ["00003D"], "test": ["00004N"]}
    dataset = CachedDataset(MFNet(str(write_mfnet(splits))), tmp_path / "cache", num_threads=1)
    noise = Noise(image="both", severities=(8.0,))
    session = SimpleNamespace(
        dataset=CorruptedDataset(dataset, noise, 8.0, split="val") if corrupted else dataset
    )
    decode_ahead(session, "train", "val")
    labels = {name: dataset.source.label(name) for name in (*splits["train"], *splits["val"])}

    def refuses(name: str) -> None:
        raise InputError(f"{name} was decoded")

    monkeypatch.setattr(dataset.source, "read", refuses)
    for name, label in labels.items():
        np.testing.assert_array_equal(dataset.read(name).label, label)
    with pytest.raises(InputError, match="00004N was decoded"):
        dataset.read("00004N")


def test_decode_ahead_without_cache_reads_nothing(write_mfnet) -> None:
    dataset = MFNet(str(write_mfnet({"train": ["00001D"]})))
    (dataset.root / "images" / "00001D.png").unlink()
    decode_ahead(SimpleNamespace(dataset=dataset), "train")
