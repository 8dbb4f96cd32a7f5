"""What is written is read again bit by bit; `test_golden_import` reads the released names."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import nn

from rgbt.checkpoints.kinds import family_of
from rgbt.checkpoints.load import load_weights
from rgbt.checkpoints.release import convention_of, position_index, save
from rgbt.checks import InputError
from tests.checkpoints.files import network

NOTE = {"family": "cmx", "inputs": '{"rgb_order": "rgb"}', "run": "0123", "step": "240"}


def family(model: nn.Module) -> str:
    return family_of(type(model))


def filled(yaml: str, **changed: object) -> nn.Module:
    """A network whose counters and statistics are not those of a new one."""
    model = network(yaml, **changed)
    generator = torch.Generator().manual_seed(0)
    for value in model.state_dict().values():
        if value.is_floating_point():
            value.copy_(torch.rand(value.shape, generator=generator))
        else:
            value.fill_(7)
    return model


@pytest.mark.parametrize("layout", ["safetensors", "released"])
@pytest.mark.parametrize(
    ("yaml", "changes"),
    [
        # What two branches share is written under both names, in a format that cannot share.
        ("mask2former_tiny", {"share_start": 1}),
        *((f"{name}_tiny", {}) for name in ("mask2former", "cmx", "cmnext", "rtfnet", "mfnet")),
        *((f"{name}_tiny", {}) for name in ("heatnet", "semseg", "deeplabv2")),
    ],
)
def test_round_trip(tmp_path: Path, yaml: str, changes: dict[str, int], layout: str) -> None:
    if (yaml, layout) == ("deeplabv2_tiny", "released"):
        pytest.skip("has no released layout")
    model, other = filled(yaml, **changes), network(yaml, **changes)
    path = tmp_path / "out" / "file"
    save(path, layout, family(model), model.state_dict(), NOTE)
    plan = load_weights(other, path)
    expected = model.state_dict()
    for key, value in other.state_dict().items():
        assert torch.equal(value, expected[key]), key
    assert [file.name for file in path.parent.iterdir()] == ["file"]
    has_place = layout == "safetensors" or yaml[:3] in ("mas", "cmx", "sem")
    assert plan.contents.note == (NOTE if has_place else {})
    assert plan.inputs == ({"rgb_order": "rgb"} if has_place else None)


def test_what_crm_needs_beside_the_parameters(tmp_path: Path) -> None:
    model = network("mask2former_tiny", 9)
    path = tmp_path / "file.ckpt"
    save(path, "released", "mask2former", model.state_dict(), {"step": "240"})
    content = torch.load(path, weights_only=True)
    assert content["global_step"] == 240
    state = content["state_dict"]
    assert state["network.criterion.empty_weight"].tolist() == pytest.approx([1.0] * 9 + [0.1])
    tables = [key for key in state if key.endswith("bias_table")]
    assert all(state[key.replace("bias_table", "index")].dtype == torch.int64 for key in tables)


def test_positions_in_a_window_of_two() -> None:
    assert position_index(9).tolist() == [[4, 3, 1, 0], [5, 4, 2, 1], [7, 6, 4, 3], [8, 7, 5, 4]]


def test_conventions_of_the_authors_code() -> None:
    crm = ("model/inputs=crm", "model.fusion=max")
    assert convention_of("released", "mask2former") == crm
    assert convention_of("released", "cmx")[0] == "model/inputs=cmx_released"
    assert convention_of("released", "external") == convention_of("safetensors", "cmx") == ()


def test_what_cannot_be_written(tmp_path: Path) -> None:
    state = {"a": torch.zeros(1)}
    cases = {
        ("released", "deeplabv2"): "format=released does not exist for deeplabv2",
        ("released", ""): "does not exist for this network",
        ("onnx", "cmx"): "format: 'onnx'",
    }
    for (layout, of), said in cases.items():
        with pytest.raises(InputError, match=said):
            save(tmp_path / "file", layout, of, state, {})
    (tmp_path / "file").write_text("dear")
    with pytest.raises(InputError, match="already exists"):
        save(tmp_path / "file", "safetensors", "cmx", state, {})
    assert (tmp_path / "file").read_text() == "dear"
    assert [file.name for file in tmp_path.iterdir()] == ["file"]
