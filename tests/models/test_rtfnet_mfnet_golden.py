"""RTFNet and MFNet against tensors recorded from their releases, and MFNet's trained weights.

Confusion counts on real pairs are compared in tests/test_weights_run.py, by the command.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from rgbt.data.files import read_packed
from tests.models import golden

REAL = golden.SHARED / "realdata"

requires_weights = pytest.mark.skipif(
    not (REAL / "mfnet_weights" / "final.pth").exists(), reason="reference material is not here"
)


def check_record(
    recorded: golden.Golden, net: nn.Module, outputs: dict[str, str], inputs: dict[str, str]
) -> None:
    golden.fill_network(net, recorded)
    assert set(net.state_dict()) == set(recorded.facts["keys"])
    after, before = golden.hook(net, outputs), golden.hook(net, inputs, inputs=True)
    with torch.inference_mode():
        logits = net(*recorded.image).logits
        images = net.inputs(*recorded.image)
    found = {**after, **before, "logits": logits}
    golden.check_all(recorded, found)
    assert np.array_equal(logits[0].argmax(0).numpy(), recorded.arrays["argmax"])
    about = recorded.facts["outputs"]["network_input"]
    fed = torch.cat(images, 1).numpy().ravel()
    fed = fed[recorded.fill.sample_positions("network_input", fed.size, about["count"])]
    assert np.abs(fed - recorded.arrays["network_input"]).max() <= about["tol_abs"]


@pytest.mark.parametrize(("name", "depth"), golden.recorded(r"rtfnet_(\d+).*", fast=[]))
def test_rtfnet_every_recorded_tensor(name: str, depth: str) -> None:
    recorded = golden.load(name)
    outputs = {}
    for stream in ("rgb", "thermal"):
        outputs[f"{stream}.conv1"] = f"encoder_{stream}_conv1"
        for stage in range(1, 5):
            outputs[f"{stream}.layer{stage}"] = f"encoder_{stream}_layer{stage}"
    for block in range(1, 6):
        outputs |= {f"deconv{block}.a": f"deconv{block}.0", f"deconv{block}": f"deconv{block}"}
    inputs = {"thermal.stem": "encoder_thermal_maxpool", "fusion0": "encoder_rgb_maxpool"}
    inputs |= {f"fusion{stage}": f"encoder_rgb_layer{stage + 1}" for stage in (1, 2, 3)}
    net = golden.network(f"rtfnet_{depth}", recorded.classes("deconv5.1.bn1.bias")).eval()
    check_record(recorded, net, outputs, {**inputs, "fusion4": "deconv1"})


@pytest.mark.parametrize(("name", "_"), golden.recorded(r"(mfnet).*", fast=["mfnet"]))
def test_mfnet_every_recorded_tensor(name: str, _: str) -> None:
    recorded = golden.load(name)
    inner = set(recorded.facts["outputs"]) - {"network_input", "logits", "argmax"}
    inputs = {key: key.removeprefix("in.") for key in inner if key.startswith("in.")}
    outputs = {key: key for key in inner if key not in inputs}
    net = golden.network("mfnet", recorded.classes("decode1.bn.bias")).eval()
    check_record(recorded, net, outputs, inputs)


def images(rgb: np.ndarray, thermal: np.ndarray) -> tuple[Tensor, Tensor]:
    return (
        torch.from_numpy(rgb).permute(2, 0, 1)[None].float() / 255,
        torch.from_numpy(thermal)[None, None].float() / 255,
    )


@requires_weights
def test_trained_mfnet_on_two_frames() -> None:
    """Pixels per class and one pixel's logits, as the release gives them."""
    state = torch.load(REAL / "mfnet_weights" / "final.pth", "cpu", weights_only=True)
    net = golden.network("mfnet").eval()
    # Saved before batch normalisations counted: torch itself adds the 38 counters that are missing.
    assert len(state) == 228
    net.load_state_dict(state)
    folder = REAL / "mfnet_author_samples" / "images"
    counts = {
        "01234N": [300176, 521, 4026, 3, 2474, 0, 0, 0, 0],
        "01477D": [260143, 27031, 16184, 1710, 2132, 0, 0, 0, 0],
    }
    pixel = [7.3818, 0.3724, 2.1691, -0.0677, -0.0565, -0.1236, 0.3181, -0.2634, -0.2349]
    for name, expected in counts.items():
        with torch.inference_mode():
            logits = net(*images(*read_packed(folder / f"{name}.png", ""))).logits
        assert torch.bincount(logits[0].argmax(0).flatten(), minlength=9).tolist() == expected
        if name == "01477D":
            assert logits[0, :, 240, 320].tolist() == pytest.approx(pixel, abs=6e-5)
