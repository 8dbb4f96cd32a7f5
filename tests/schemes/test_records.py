"""What every scheme requires of the other components."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from torch import nn

from rgbt.models.critic import Critic
from rgbt.requirements import Record, record_of
from tests.schemes.linear import K, domains, network
from tests.schemes.test_domains import HEATNET, labelled, scheme_of, unlabelled
from tests.schemes.test_schemes import Halves, Nothing
from tests.schemes.test_schemes import scheme as crm
from tests.schemes.test_self_training import DISTANCE
from tests.schemes.test_self_training import scheme_of as self_training
from tests.schemes.test_temporal import Net
from tests.schemes.test_temporal import scheme as temporal


def of_masks() -> Net:
    net = Net(nn.Identity())
    net.record = Record(outputs="masks")
    return net


TWO = {
    ("model", "outputs"): "scores",
    ("masker", "hides_cells"): False,
    ("domains", "num_domains"): 2,
}
LABELS, HEADS = ("domains", "target_labels"), ("domains", "separate_heads")
WEIGHED = {**TWO, LABELS: False, ("loss", "weighs_confidence"): True}
FRAMES = {("loss", "frames"): 2, ("masker", "hides_cells"): False}
ALL_VIEWS = {("model", "views"): ("rgbt", "rgb", "thermal"), ("model", "stacks_passes"): True}
OFF = {"complementary_weight": 0.0, "nonlocal_weight": 0.0}
CRITIC = {"in_channels": K, "base_width": 4, "upsample": False, "align_corners": False}

CASES: dict[str, tuple[Callable[[], Any], dict[tuple[str, str], Any]]] = {
    "labels": (lambda: labelled(network(False), False, "apart"), {**TWO, LABELS: True}),
    "gradients": (
        lambda: labelled(network(True), True, "kept"),
        {**TWO, HEADS: True, LABELS: True},
    ),
    "no labels": (lambda: unlabelled(network(False)), {**TWO, LABELS: False}),
    "guidance": (
        lambda: unlabelled(network(False), guidance_weight=0.1),
        {**TWO, LABELS: False, ("model", "auxiliary"): True},
    ),
    "adversarial": (
        lambda: scheme_of(network(False), critic=Critic(**CRITIC)),
        {**TWO, LABELS: False, ("dataset", "num_classes"): K},
    ),
    "HeatNet": (
        lambda: scheme_of(network(False), **HEATNET),
        {**TWO, LABELS: True, ("domains", "target_confidence"): True},
    ),
    "self-training": (
        lambda: self_training(network(False)),
        {**WEIGHED, ("masker", "hides_cells"): True},
    ),
    "self-training without masked images": (
        lambda: self_training(network(False), masked_weight=0.0),
        {**WEIGHED, ("masker", "hides_cells"): False},
    ),
    "self-training with feature distance": (
        lambda: self_training(network(False), **DISTANCE),
        {
            **{**WEIGHED, ("masker", "hides_cells"): True, ("model", "features"): True},
            ("model.weights", "pretrained"): True,
        },
    ),
    "CRM": (lambda: crm(Halves()), {**ALL_VIEWS, ("masker", "hides_cells"): True}),
    "CRM without masks": (lambda: crm(Nothing(), **OFF), ALL_VIEWS),
    "two frames": (lambda: temporal(Net(nn.Identity())), FRAMES),
    "two frames of masks": (
        lambda: temporal(of_masks()),
        {**FRAMES, ("model", "dense_logits"): True},
    ),
}


@pytest.mark.parametrize(("make", "expected"), CASES.values(), ids=CASES)
def test_scheme_requires(make: Callable[[], Any], expected: dict[tuple[str, str], Any]) -> None:
    requires = record_of(make()).requires
    assert {(each.node, each.key): each.value for each in requires} == expected


def test_records_provide_what_the_engine_reads() -> None:
    record = record_of(labelled(network(True), True, "apart"))
    assert (record.num_domains, record.shows_views) == (2, True)
    assert set(record.optimizers) == {"source", "target"}
    assert record_of(domains(True)).separate_heads
    assert not record_of(domains(False)).separate_heads
    frames = temporal(Net(nn.Identity()))
    assert (record_of(frames).frames, record_of(frames).camera) == (2, frames.view.camera)
    judge = Critic(**CRITIC)
    assert record_of(scheme_of(network(False), critic=judge)).networks["critic"] is judge
    settings = [each.setting for each in record_of(crm(Halves())).requires if each.setting]
    assert settings == ["scheme.complementary_weight=1", "scheme.nonlocal_weight=1"]
