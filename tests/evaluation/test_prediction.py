"""What all evaluations share: which view and head predict, and images that are decoded ahead."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from rgbt.checks import InputError
from rgbt.corruptions.pixels import Noise
from rgbt.data.cache.dataset import CachedDataset
from rgbt.data.domains import Domain, Domains
from rgbt.data.mfnet import MFNet
from rgbt.engine.prediction import Prediction
from rgbt.evaluation.corrupted_dataset import CorruptedDataset
from rgbt.evaluation.prediction import Predictor, decode_ahead, heads_of, view_of
from rgbt.evaluation.request import EvaluationRequest
from rgbt.requirements import Record
from rgbt.types import Batch, Output


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
    with pytest.raises(InputError, match="modality: 'rgbt' is not a valid choice"):
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
    with pytest.raises(InputError, match=r"night, so no head can be selected. Set head=source"):
        heads_of(session, "rgb")(("mine",))
    alone = session_of({"view": "rgb"})
    assert heads_of(alone, "rgb")(("mine", "yours")) == (None, None)
    assert alone.dataset.calls == 0


def test_predictor_chooses_heads_by_the_names_of_a_batch() -> None:
    calls: list[tuple[int, str | None]] = []

    class Heads(nn.Module):
        record = Record(views=("rgb",))

        def forward(self, rgb: Tensor, thermal: Tensor, *, views: object, head: str) -> Output:
            calls.append((len(rgb), head))
            index = ("day", "dark").index(head)
            return Output(
                torch.eye(2)[index][:, None, None].expand(len(rgb), 2, *rgb.shape[2:]), {}
            )

    session: Any = session_of({"head": "day", "view": "rgb"}, target_is="night")
    session.model, session.fabric = Heads(), Fabric(accelerator="cpu", devices=1)
    session.prediction = Prediction()
    predictor = Predictor(session, session.model, EvaluationRequest(split="test"))
    batch = Batch(
        rgb=torch.zeros(3, 3, 2, 2),
        thermal=torch.zeros(3, 1, 2, 2),
        label=torch.zeros(3, 2, 2, dtype=torch.int64),
        name=("day", "night", "day"),
        centre_yx=torch.zeros(3, 2, dtype=torch.int64),
        position=None,
        original_hw=torch.full((3, 2), 2),
    )
    assert predictor.classes(batch)[:, 0, 0].tolist() == [0, 1, 0]
    assert calls == [(2, "day"), (1, "dark")]
    assert predictor.probabilities(batch)[:, 1, 0, 0].tolist() == pytest.approx(
        [0.269, 0.731, 0.269], abs=1e-3
    )
    assert not session.model.training
    assert predictor.view == "rgb"


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


def test_decode_ahead_without_cache_reads_nothing(
    write_mfnet, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = MFNet(str(write_mfnet({"train": ["00001D"]})))
    (dataset.root / "images" / "00001D.png").unlink()
    decode_ahead(SimpleNamespace(dataset=dataset), "train")
    assert capsys.readouterr().err == "", "no progress bar"
    with pytest.raises(InputError, match="00001D.png is missing"):
        dataset.read("00001D")
