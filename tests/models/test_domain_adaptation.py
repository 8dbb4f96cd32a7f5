"""The networks of domain adaptation as their files have them: sizes, heads, a training step."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch.nn import functional as F

from tests.models.golden import alone, network
from tests.models.plain import generator, images

HW = (96, 192)
CLASSES = 14
TWO = {"heads": "[source,target]"}
MODIFIED = "deeplabv2_two_heads_modified_tiny"
HEADED: list[tuple[str, dict[str, Any]]] = [
    ("deeplabv2_tiny", TWO),
    (MODIFIED, {}),
    (MODIFIED, {"decoder": "modified_thesis"}),
]
MODELS: list[tuple[str, dict[str, Any], str | None]] = [
    ("deeplabv2_tiny", {}, None),
    ("deeplabv2_tiny", {"auxiliary": True}, None),
    *((*each, head) for each in HEADED for head in ("source", "target")),
    ("heatnet_tiny", {}, None),
    ("heatnet_tiny", {"modalities": "rgb"}, None),
    ("heatnet_tiny", {"modalities": "thermal"}, None),
]


@pytest.mark.parametrize(("name", "changes", "head"), MODELS)
def test_step_at_demo_size_reaches_every_parameter(
    name: str, changes: dict[str, Any], head: str | None
) -> None:
    net = network(name, CLASSES, **changes)
    chosen = {} if head is None else {"head": head}
    output = net(*images(2, *HW), **chosen, generator=generator())
    assert output.logits.shape == (2, CLASSES, *HW)
    label = torch.randint(0, CLASSES, (2, *HW), generator=generator(1))
    scores = [output.logits]
    if "auxiliary" in changes:
        assert output.aux["aux_logits"].shape == (2, CLASSES, *HW)
        scores.append(output.aux["aux_logits"])
    sum(F.cross_entropy(each, label) for each in scores).backward()
    other = {"source": "heads.target.", "target": "heads.source."}.get(head or "")
    for key, parameter in net.named_parameters():
        if other is not None and key.startswith(other):
            assert parameter.grad is None
            continue
        assert parameter.grad is not None, key
        assert parameter.grad.isfinite().all()
    assert all(p.grad.any() for n, p in net.named_parameters() if n.endswith("conv1.weight"))


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("deeplabv2_tiny", ["model.auxiliary=true"]),
        (MODIFIED, []),
        ("heatnet_tiny", ["model.modalities=rgb"]),
    ],
)
def test_tiny_networks_are_the_large_ones_in_kind(name: str, changes: list[str]) -> None:
    """Only sizes and rates differ, and the dropout that a demo has no channels to spare for."""
    small, large = (alone(f"model/{each}", *changes).model for each in (name, name[:-5]))
    sizes = {"depths", "base_width", "decoder_width", "rates", "summed_rates", "dropout"}
    kept = [key for key in large if key not in ("num_classes", *sizes)]
    assert [key for key in kept if small[key] != large[key]] == []


def test_auxiliary_network_of_full_size() -> None:
    with torch.device("meta"):
        net = network("deeplabv2", CLASSES, auxiliary=True)
    assert sum(parameter.numel() for parameter in net.parameters()) == 44_048_560
