"""HeatNet's PSPNet and discriminator against tensors recorded from the release."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rgbt.models.critic import Critic
from tests.models import golden

NETWORK, CRITIC = "trgb_segnet.", "critics.0."
ENCODER = ("conv1", "conv1_2", "layer1", "layer1_2", "layer2", "layer2_2", "layer3", "layer4")
RECORDED_AS = {
    "features": "layer4",
    "layer3": "layer3",
    "layer2": "layer2_concat",
    "layer1": "layer1_concat",
    "stem": "stem_concat",
}


@pytest.mark.parametrize(("name", "_"), golden.recorded(r"(heatnet).*", fast=["heatnet"]))
def test_every_recorded_tensor(name: str, _: str) -> None:
    record = golden.load(name)
    classes = record.classes(f"{NETWORK}final.0.bias")
    net = golden.network("heatnet", num_classes=classes).eval()
    golden.fill_network(net, record, NETWORK, unused=(CRITIC,))
    critic = Critic(in_channels=classes, base_width=64, upsample=True, align_corners=False)
    golden.fill_network(critic, record, CRITIC, unused=(NETWORK,))

    inner = {name: f"feats.{name}" for name in ENCODER}
    inner |= {f"psp.stage{index}": f"psp.stages.{index}" for index in range(4)}
    seen = golden.hook(net, inner | {name: name for name in ("psp", "up_1", "up_2", "up_3")})
    layers = ("conv1", "conv2", "conv3", "conv4", "classifier")
    judged = golden.hook(critic, {f"critic.{name}": name for name in layers})

    with torch.no_grad():
        output = net(*record.image)
        found: dict[str, Tensor] = {"logits": output.logits}
        found["critic_on_logits"] = critic(output.logits)
    assert set(output.aux) == set(RECORDED_AS)
    found |= {f"critic_tensor.{RECORDED_AS[name]}": x for name, x in output.aux.items()}
    golden.check_all(record, found | seen | judged)
    assert torch.equal(output.logits[0].argmax(0), torch.from_numpy(record.arrays["argmax"]).long())
