"""Every family of networks as an ONNX graph: the scores are those of PyTorch."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from rgbt.config.component import build
from rgbt.config.compose import available, compose
from rgbt.evaluation.export import compare
from rgbt.exported.description import Description
from rgbt.exported.graph import OPSET, ScoresOfImages, onnx_bytes, traced
from rgbt.exported.onnx_network import ExportedNetwork
from rgbt.requirements import record_of

TINY = sorted(name for name in available("model") if name.endswith("_tiny"))
HW = (64, 96)


def description(network: torch.nn.Module, head: str | None) -> Description:
    record = record_of(network)
    return Description(
        version="0",
        network=type(network).__name__,
        run="random",
        step=0,
        dataset="none",
        fingerprint="",
        classes=tuple(map(str, range(9))),
        view=record.views[0],
        head=head,
        outputs=record.outputs,
        image_hw=HW,
        opset=OPSET,
        settings={},
    )


def test_each_family_has_a_tiny_network() -> None:
    families = {name.split("_")[0] for name in available("model")}
    assert {name.split("_")[0] for name in TINY} == families


@pytest.mark.slow
@pytest.mark.parametrize("name", TINY)
def test_scores_of_the_graph_are_those_of_the_network(name: str) -> None:
    torch.manual_seed(0)
    network = build(compose([f"model={name}", "model.num_classes=9"]).model).eval()
    made = description(network, next(iter(record_of(network).heads), None))
    graph = ScoresOfImages(network, view=made.view, head=made.head)
    content = onnx_bytes(traced(graph, HW), made)
    exported = ExportedNetwork(content, Path(name))
    images = [(torch.rand(1, 3, *HW), torch.rand(1, 1, *HW)) for _ in range(6)]
    found = compare(graph, lambda *pair: exported(*pair).logits, images)
    assert found.difference <= 1e-5 * found.largest
    assert found.equal == 1.0


def test_a_network_that_reads_values_is_refused_with_advice() -> None:
    class Branching(torch.nn.Module):
        def forward(self, rgb: torch.Tensor, thermal: torch.Tensor, views: object) -> object:
            from rgbt.types import Output

            del views
            return Output(rgb if float(thermal.sum()) > 1 else thermal, {})

    graph = ScoresOfImages(Branching(), view="rgbt", head=None)
    with pytest.raises(ValueError, match="Branching cannot be traced by torch.export"):
        traced(graph, (4, 4))
