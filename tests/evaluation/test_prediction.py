"""What all evaluations share: which view and head predict, and images that are decoded ahead."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.assembly.session import open_session
from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.data.domains import Domain, Domains
from rgbt.engine.prediction import Prediction
from rgbt.evaluation.measure import measurement_of
from rgbt.evaluation.predict import Predictor, heads_of, view_of
from rgbt.requirements import NetworkRecord
from rgbt.runs.specify import specify
from rgbt.types import Batch, Output
from tests.commands import ON_CPU
from tests.data.layouts import PATTERNS, write_folder
from tests.engine.test_evaluate import FABRIC, ROW, Ramp, grey


class Network:
    record = NetworkRecord(views=("rgb", "thermal"))


def session_of(source: dict[str, object], **changes: object) -> SimpleNamespace:
    """The part of a session that `view_of` and `heads_of` use."""
    target = {"split": "x", "view": "rgb", "head": "dark", "labels": "none"}
    given = {
        "source": Domain(**{"split": "x", "view": None, "head": None, "labels": "given", **source}),
        "target": None,
        "target_is": None,
        "tested_head": "own",
        **changes,
    }
    if given["target_is"] is not None:
        given["target"] = Domain(**target)
    return SimpleNamespace(model=Network(), dataset=Nights(), domains=Domains(**given))


class Nights:
    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...]:
        return tuple(name == "night" for name in names)


@pytest.mark.parametrize(("view", "seen"), [("thermal", "thermal"), ("rgb", "rgb"), (None, "rgb")])
def test_view_of_defaults_to_the_source_domain(view: str | None, seen: str) -> None:
    """The network's first view only where the domain does not say."""
    session = session_of({"view": view})
    assert view_of(session) == view_of(session, None) == seen
    assert view_of(session, "thermal") == "thermal"
    with pytest.raises(InputError, match="modality"):
        view_of(session, "rgbt")


def test_heads_of_listed_images() -> None:
    session = session_of({"head": "day", "view": "rgb"}, target_is="night")
    assert heads_of(session, "rgb")(("day", "night", "day")) == ("day", "dark", "day")
    assert heads_of(session, "rgb", "target")(("day", "night")) == ("dark", "dark")
    one = session_of({"head": "day", "view": "rgb"}, target_is="night", tested_head="source")
    assert heads_of(one, "rgb")(("day", "night")) == ("day", "day")
    assert heads_of(one, "rgb", "own")(("day", "night")) == ("day", "dark")


def test_predictor_chooses_heads_by_the_names_of_a_batch() -> None:
    calls: list[tuple[int, str | None]] = []

    class Heads(nn.Module):
        record = NetworkRecord(views=("rgb",))

        def forward(self, rgb: Tensor, thermal: Tensor, *, views: object, head: str) -> Output:
            calls.append((len(rgb), head))
            scores = torch.eye(2)[("day", "dark").index(head)]
            return Output(scores[:, None, None].expand(len(rgb), 2, *rgb.shape[2:]), {})

    session: Any = session_of({"head": "day", "view": "rgb"}, target_is="night")
    session.model, session.autocast = Heads(), nullcontext
    session.prediction = Prediction()
    predictor = Predictor(session)
    batch = Batch(
        rgb=torch.zeros(3, 3, 2, 2),
        thermal=torch.zeros(3, 1, 2, 2),
        position=None,
        label=torch.zeros(3, 2, 2, dtype=torch.int64),
        name=("day", "night", "day"),
        centre_yx=torch.zeros(3, 2, dtype=torch.int64),
        original_hw=torch.full((3, 2), 2),
    )
    assert predictor.classes(batch)[:, 0, 0].tolist() == [0, 1, 0]
    assert calls == [(2, "day"), (1, "dark")]
    found = predictor.probabilities(batch)[:, 1, 0, 0].tolist()
    assert found == pytest.approx([0.269, 0.731, 0.269], abs=1e-3)
    assert not session.model.training


def test_classes_and_confidences_agree_with_the_probabilities() -> None:
    data = grey([ROW, ROW[::-1]], (4, 14))
    session: Any = session_of({"head": None, "view": "rgb"})
    session.model, session.autocast = Ramp(), FABRIC.autocast
    session.model.record = NetworkRecord(views=("rgb",))
    session.prediction = Prediction(mirrored=True, window_hw=(2, 4), align_corners=True)
    predictor = Predictor(session)
    shares = predictor.probabilities(data)
    classes, confidence = predictor.confident_classes(data)
    assert classes.dtype == torch.uint8
    assert torch.equal(classes.long(), shares.argmax(1))
    torch.testing.assert_close(confidence, shares.amax(1))
    assert torch.equal(predictor.classes(data), classes)
    torch.testing.assert_close(shares.sum(1), torch.ones(1, 4, 14))


OF_FOLDER = (
    *(f"dataset.{key}='{text}'" for key, text in PATTERNS.items()),
    *("dataset.num_classes=3", "dataset.classes=[background,person,car]", "model=mfnet_tiny"),
    *("masker=none", "loss=cross_entropy", "data.num_workers=0", *ON_CPU),
)


def test_images_that_are_read_otherwise_are_another_measurement(tmp_path: Path) -> None:
    """The range of the thermal values is a setting of the reader, which changes every image."""
    root = write_folder(tmp_path / "data")
    one, same, other = (
        open_session(specify(compose([*OF_FOLDER, *words])))
        for words in (
            ("dataset=folder", f"dataset.root={root}", f"dataset.thermal_range=[20000,{highest}]")
            for highest in (24000, 24000, 20100)
        )
    )
    assert measurement_of(one, "test") == measurement_of(same, "test")
    images = [
        session.dataset.read(session.dataset.names("test")[0]).thermal for session in (one, other)
    ]
    assert (images[0] != images[1]).any()
    assert measurement_of(one, "test") != measurement_of(other, "test")
