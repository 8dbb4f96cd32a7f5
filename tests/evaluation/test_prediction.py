"""What all evaluations share: which view and head predict, and images that are decoded ahead."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.checks import InputError
from rgbt.data.domains import Domain, Domains
from rgbt.engine.prediction import Prediction
from rgbt.evaluation.prediction import Predictor, heads_of, view_of
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
        record = Record(views=("rgb",))

        def forward(self, rgb: Tensor, thermal: Tensor, *, views: object, head: str) -> Output:
            calls.append((len(rgb), head))
            scores = torch.eye(2)[("day", "dark").index(head)]
            return Output(scores[:, None, None].expand(len(rgb), 2, *rgb.shape[2:]), {})

    session: Any = session_of({"head": "day", "view": "rgb"}, target_is="night")
    session.model, session.autocast = Heads(), nullcontext
    session.prediction = Prediction()
    predictor = Predictor(session, session.model, EvaluationRequest(split="test"))
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
