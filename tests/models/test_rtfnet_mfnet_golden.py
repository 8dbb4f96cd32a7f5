"""RTFNet-50 and MFNet against tensors recorded from their releases, and MFNet's trained weights.

The trained weights and the images come with a known answer: the confusion counts of the release.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from rgbt.data.files import read_packed
from rgbt.data.mfnet import MFNet as MFNetFiles
from tests.models import golden

REAL = golden.SHARED / "realdata"

requires_weights = pytest.mark.skipif(
    not (REAL / "mfnet_weights" / "final.pth").exists(), reason="reference material is not here"
)


def hook_inputs(net: nn.Module, named: dict[str, str]) -> dict[str, Tensor]:
    """Inputs of submodules, filled by the next forward: name in the record -> module path."""
    seen: dict[str, Tensor] = {}

    def note(name: str) -> Callable[..., None]:
        def called(_module: nn.Module, inputs: tuple[Tensor]) -> None:
            seen[name] = inputs[0]

        return called

    for name, path in named.items():
        net.get_submodule(path).register_forward_pre_hook(note(name))
    return seen


def compare(name: str, outputs: dict[str, str], inputs: dict[str, str]) -> None:
    recorded = golden.load(name)
    net = golden.network(name).eval()
    golden.fill_network(net, recorded)
    assert set(net.state_dict()) == set(recorded.facts["keys"])
    after, before = golden.hook(net, outputs), hook_inputs(net, inputs)
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


@pytest.mark.slow  # fills 185 million parameters
@golden.requires_golden
def test_rtfnet_50_every_recorded_tensor() -> None:
    outputs = {}
    for stream in ("rgb", "thermal"):
        outputs[f"{stream}.conv1"] = f"encoder_{stream}_conv1"
        for stage in range(1, 5):
            outputs[f"{stream}.layer{stage}"] = f"encoder_{stream}_layer{stage}"
    for block in range(1, 6):
        outputs |= {f"deconv{block}.a": f"deconv{block}.0", f"deconv{block}": f"deconv{block}"}
    inputs = {"thermal.stem": "encoder_thermal_maxpool", "fusion0": "encoder_rgb_maxpool"}
    inputs |= {f"fusion{stage}": f"encoder_rgb_layer{stage + 1}" for stage in (1, 2, 3)}
    compare("rtfnet_50", outputs, {**inputs, "fusion4": "deconv1"})


@golden.requires_golden
def test_mfnet_every_recorded_tensor() -> None:
    recorded = set(golden.load("mfnet").facts["outputs"]) - {"network_input", "logits", "argmax"}
    inputs = {name: name.removeprefix("in.") for name in recorded if name.startswith("in.")}
    outputs = {name: name for name in recorded if name not in inputs}
    compare("mfnet", outputs, inputs)


def released_network() -> Any:
    """MFNet with the weights that its authors' PyTorch release holds."""
    state = torch.load(REAL / "mfnet_weights" / "final.pth", "cpu", weights_only=True)
    net = golden.network("mfnet").eval()
    # Saved before batch normalisations counted: torch itself adds the 38 counters that are missing.
    assert len(state) == 228
    net.load_state_dict(state)
    return net


def images(rgb: np.ndarray, thermal: np.ndarray) -> tuple[Tensor, Tensor]:
    return (
        torch.from_numpy(rgb).permute(2, 0, 1)[None].float() / 255,
        torch.from_numpy(thermal)[None, None].float() / 255,
    )


@requires_weights
def test_trained_mfnet_on_two_frames() -> None:
    """Pixels per class and one pixel's logits, as the release gives them."""
    net = released_network()
    folder = REAL / "mfnet_author_samples" / "images"
    counts = {
        "01234N": [300176, 521, 4026, 3, 2474, 0, 0, 0, 0],
        "01477D": [260143, 27031, 16184, 1710, 2132, 0, 0, 0, 0],
    }
    pixel = [7.3818, 0.3724, 2.1691, -0.0677, -0.0565, -0.1236, 0.3181, -0.2634, -0.2349]
    for name, expected in counts.items():
        with torch.inference_mode():
            logits = net(*images(*read_packed(folder / f"{name}.png"))).logits
        assert torch.bincount(logits[0].argmax(0).flatten(), minlength=9).tolist() == expected
        if name == "01477D":
            assert logits[0, :, 240, 320].tolist() == pytest.approx(pixel, abs=6e-5)


def confusion(net: Any, names: Iterable[str], files: MFNetFiles) -> np.ndarray:
    """(9, 9) counts, rows = label, columns = prediction."""

    def numbers() -> Iterator[np.ndarray]:
        for name in names:
            sample = files.read(name)
            with torch.inference_mode():
                logits = net(*images(sample.rgb, sample.thermal)).logits
            assert sample.label is not None
            yield sample.label.ravel() * np.int64(9) + logits[0].argmax(0).numpy().ravel()

    return sum(np.bincount(number, minlength=81) for number in numbers()).reshape(9, 9)


@pytest.mark.slow  # 200 images of 480 x 640
@requires_weights
@pytest.mark.parametrize("split", ["train", "val"])
def test_trained_mfnet_confusion_counts(split: str) -> None:
    answers = json.loads((REAL / "mfnet_weights" / "expected_confusions.json").read_text())
    files = MFNetFiles(str(REAL / "mfnet200"))
    found = confusion(released_network(), files.names(split), files)
    expected = np.array(answers[f"MFNet_final_pth/{split}"]["confusion"])
    assert found.sum() == expected.sum() == 100 * 480 * 640
    moved = int(np.abs(found - expected).sum()) // 2
    assert moved == 0, f"{moved} of {found.sum()} pixels are counted elsewhere"
