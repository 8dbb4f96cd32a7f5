"""Every family of networks as an ONNX graph: the scores are those of PyTorch."""

from __future__ import annotations

import pytest
import torch

from rgbt.config.component import build
from rgbt.config.compose import available, compose
from rgbt.evaluation.export import compare
from rgbt.exported.graph import ScoresOfImages, traced
from rgbt.exported.onnx_network import exported_network
from rgbt.requirements import record_of

TINY = sorted(name for name in available("model") if name.endswith("_tiny"))
HW = (64, 96)


def test_each_family_has_a_tiny_network() -> None:
    families = {name.split("_")[0] for name in available("model")} - {"external"}
    assert {name.split("_")[0] for name in TINY} == families


@pytest.mark.slow
@pytest.mark.parametrize("name", TINY)
def test_scores_of_the_graph_are_those_of_the_network(name: str) -> None:
    torch.manual_seed(0)
    network = build(compose([f"model={name}", "model.num_classes=9"]).model).eval()
    view = record_of(network).views[0]
    exported = exported_network(network, view, HW, name)
    graph = ScoresOfImages(network, view=view, head=None)
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
