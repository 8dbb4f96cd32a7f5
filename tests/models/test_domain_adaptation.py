"""The networks of domain adaptation as their files have them: sizes, heads, a training step."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from torch.nn import functional as F

from rgbt.config.compose import conf_dir
from tests.models.golden import alone, network
from tests.models.plain import generator, images

HW = (96, 192)
CLASSES = 14
PAIRS = {
    "deeplab": ("deeplabv2_tiny", "deeplabv2"),
    "deeplab_auxiliary": ("deeplabv2_auxiliary_tiny", "deeplabv2_auxiliary"),
    "multi_head": ("deeplabv2_two_heads_tiny", "deeplabv2_two_heads"),
    "multi_head_modified": ("deeplabv2_two_heads_modified_tiny", "deeplabv2_two_heads_modified"),
    "multi_head_literal": ("deeplabv2_two_heads_literal_tiny", "deeplabv2_two_heads_literal"),
    "heatnet_fused": ("heatnet_tiny", "heatnet"),
    "heatnet_rgb_only": ("heatnet_rgb_tiny", "heatnet_rgb"),
    "heatnet_thermal_only": ("heatnet_thermal_tiny", "heatnet_thermal"),
}
MODELS: list[tuple[str, dict[str, Any]]] = [
    ("deeplabv2_tiny", {}),
    ("deeplabv2_auxiliary_tiny", {}),
    *(
        (f"deeplabv2_two_heads{decoder}_tiny", {"head": head})
        for decoder in ("", "_modified", "_literal")
        for head in ("source", "target")
    ),
    ("heatnet_tiny", {}),
    ("heatnet_rgb_tiny", {}),
    ("heatnet_thermal_tiny", {}),
]


@pytest.mark.parametrize("name", PAIRS)
@pytest.mark.parametrize("scale", ["demo", "paper"])
def test_names_of_a_scale_stand_for_the_networks(name: str, scale: str) -> None:
    node = OmegaConf.load(conf_dir() / "model" / f"{name}_{scale}.yaml")
    assert node == {"defaults": [PAIRS[name][scale == "paper"]]}


@pytest.mark.parametrize(("name", "asked"), MODELS)
def test_a_step_at_the_size_of_the_demo(name: str, asked: dict[str, Any]) -> None:
    net = network(name, CLASSES)
    output = net(*images(2, *HW), **asked, generator=generator())
    assert output.logits.shape == (2, CLASSES, *HW)
    label = torch.randint(0, CLASSES, (2, *HW), generator=generator(1))
    scores = [output.logits]
    if "auxiliary" in name:
        assert output.aux["aux_logits"].shape == (2, CLASSES, *HW)
        scores.append(output.aux["aux_logits"])
    sum(F.cross_entropy(each, label) for each in scores).backward()
    other = {"source": "heads.target.", "target": "heads.source."}.get(asked.get("head", ""))
    for key, parameter in net.named_parameters():
        if other is not None and key.startswith(other):
            assert parameter.grad is None
            continue
        assert parameter.grad is not None, key
        assert parameter.grad.isfinite().all()
    assert all(p.grad.any() for n, p in net.named_parameters() if n.endswith("conv1.weight"))


@pytest.mark.parametrize(
    ("name", "heads", "modalities"),
    [
        ("deeplabv2_auxiliary_tiny", ["main"], None),
        ("deeplabv2_two_heads_modified_tiny", ["source", "target"], None),
        ("heatnet_rgb_tiny", None, "rgb"),
        ("heatnet_thermal_tiny", None, "thermal"),
    ],
)
def test_small_networks_are_the_large_ones_in_kind(
    name: str, heads: list[str] | None, modalities: str | None
) -> None:
    """Only sizes and rates differ, and the dropout that a demo has no channels to spare for."""
    small, large = (alone(f"model/{each}").model for each in (name, name[:-5]))
    sizes = {"depths", "base_width", "decoder_width", "rates", "summed_rates", "dropout"}
    kept = [key for key in large if key not in ("num_classes", *sizes)]
    assert [key for key in kept if small[key] != large[key]] == []
    assert small.get("heads") == heads
    assert small.get("modalities") == modalities


def test_auxiliary_network_of_full_size() -> None:
    with torch.device("meta"):
        net = network("deeplabv2_auxiliary", CLASSES)
    assert sum(parameter.numel() for parameter in net.parameters()) == 44_048_560
