"""What is written: read again bit by bit, and with exactly the released names."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import IO

import pytest
import torch
from torch import Tensor, nn

from rgbt.checkpoints.kinds import family_of
from rgbt.checkpoints.load import load_weights
from rgbt.checkpoints.release import convention_of, position_index, save
from rgbt.checks import InputError
from tests.checkpoints.files import network, released
from tests.models import golden
from tests.models.golden import requires_golden

NOTE = {
    "family": "cmx",
    "inputs": '{"rgb_order": "rgb"}',
    "run": "0123",
    "checkpoint": "best",
    "step": "240",
}


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


def check_equal(model: nn.Module, other: nn.Module) -> None:
    expected = model.state_dict()
    for key, value in other.state_dict().items():
        assert torch.equal(value, expected[key]), key


ROUND_TRIPS = [
    *itertools.product(
        (
            *("mask2former_tiny", "cmx_tiny", "cmnext_tiny"),
            *("rtfnet_tiny", "mfnet_tiny", "heatnet_tiny"),
        ),
        ("safetensors", "released"),
    ),
    ("deeplabv2_tiny", "safetensors"),
    ("cmx_tiny", "released_temporal"),
]


@pytest.mark.parametrize(("yaml", "layout"), ROUND_TRIPS)
def test_round_trip(tmp_path: Path, yaml: str, layout: str) -> None:
    model, other = filled(yaml), network(yaml)
    path = tmp_path / "out" / "file"
    save(path, layout, family(model), model.state_dict(), NOTE)
    load_weights(other, path)
    check_equal(model, other)
    assert [each.name for each in path.parent.iterdir()] == ["file"]


def test_round_trip_of_shared_stages(tmp_path: Path) -> None:
    """What two branches share is written under both names, in a format that cannot share."""
    for layout in ("safetensors", "released"):
        model = filled("mask2former_tiny", share_start=1)
        other = network("mask2former_tiny", share_start=1)
        save(tmp_path / layout, layout, "mask2former", model.state_dict(), {})
        load_weights(other, tmp_path / layout)
        check_equal(model, other)


def unwrapped(path: Path) -> dict[str, Tensor]:
    """The names as the authors' code gets them, by torch alone."""
    content = torch.load(path, map_location="cpu", weights_only=True)
    for key in ("state_dict", "model"):
        content = content.get(key, content)
    assert all(isinstance(value, Tensor) for value in content.values())
    return content


RELEASED = [
    ("cmx_b0", "cmx_mit_b0", "released", ""),
    ("cmnext_b0", "cmnext/cmnext_b0", "released", ""),
    ("mfnet", "mfnet", "released", ""),
    pytest.param("cmx_b2", "cmx_mit_b2", "released", "", marks=pytest.mark.slow),
    pytest.param("cmx_b2", "temporal_cmx_b2", "released_temporal", "", marks=pytest.mark.slow),
    pytest.param("mask2former_swin_t", "crm_swin_t", "released", "", marks=pytest.mark.slow),
    pytest.param("mask2former_swin_s", "crm_swin_s", "released", "", marks=pytest.mark.slow),
    pytest.param("rtfnet_50", "rtfnet_50", "released", "", marks=pytest.mark.slow),
    pytest.param("heatnet", "heatnet", "released", "module.", marks=pytest.mark.slow),
]


@requires_golden
@pytest.mark.parametrize(("yaml", "name", "layout", "prefix"), RELEASED)
def test_released_layouts_have_exactly_the_released_names(
    tmp_path: Path, yaml: str, name: str, layout: str, prefix: str
) -> None:
    with torch.device("meta"):
        model = golden.network(yaml, 13 if name == "heatnet" else 9)
    # One number per tensor, so that big networks are written in no time.
    state = {
        key: torch.zeros(1, dtype=value.dtype).expand(value.shape or (1,)).reshape(value.shape)
        for key, value in model.state_dict().items()
    }
    path = tmp_path / "file.pth"
    remark = save(path, layout, family(model), state, NOTE)
    expected = {
        f"{prefix}{key}": (value.shape, value.dtype) for key, value in released(name).items()
    }
    if name == "heatnet":
        critics = {key for key in expected if key.startswith("module.critics.")}
        assert remark is not None
        assert "module.critics." in remark
        expected = {key: expected[key] for key in expected.keys() - critics}
    found = {key: (value.shape, value.dtype) for key, value in unwrapped(path).items()}
    assert found == expected


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


def test_unused_convolution_of_the_temporal_release(tmp_path: Path) -> None:
    model = network("cmx_tiny", 5)
    save(tmp_path / "0.pth", "released_temporal", "cmx", model.state_dict(), {})
    state = torch.load(tmp_path / "0.pth", weights_only=True)
    assert state["voting.weight"].shape == (5, 10, 3, 3)
    assert state["voting.bias"].shape == (5,)
    assert not state["voting.weight"].any()


def test_an_export_says_what_it_is(tmp_path: Path) -> None:
    model = network("cmx_tiny")
    for layout in ("safetensors", "released"):
        save(tmp_path / layout, layout, "cmx", model.state_dict(), NOTE)
        plan = load_weights(model, tmp_path / layout)
        assert (plan.contents.note, plan.convention) == (NOTE, ())
        assert plan.inputs == {"rgb_order": "rgb"}


def test_conventions_of_the_authors_code() -> None:
    crm = ("model/inputs=crm", "model.fusion=max")
    assert convention_of("released", "mask2former") == crm
    assert convention_of("released", "cmx")[0] == "model/inputs=cmx_released"
    assert convention_of("released_temporal", "cmx") == ("model/inputs=temporal",)
    assert convention_of("released", "external") == convention_of("safetensors", "cmx") == ()


def test_what_cannot_be_written(tmp_path: Path) -> None:
    state = {"a": torch.zeros(1)}
    cases = {
        ("released", "deeplabv2"): "format=released does not exist for deeplabv2",
        ("released", ""): "does not exist for this network",
        ("released_temporal", "mfnet"): "format=released_temporal",
        ("onnx", "cmx"): "format: 'onnx'",
    }
    for (layout, of), said in cases.items():
        with pytest.raises(InputError, match=said):
            save(tmp_path / "file", layout, of, state, {})
    (tmp_path / "file").write_text("dear")
    with pytest.raises(InputError, match="already exists"):
        save(tmp_path / "file", "safetensors", "cmx", state, {})
    assert (tmp_path / "file").read_text() == "dear"
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


def test_a_file_that_could_not_be_written_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: object, file: IO[bytes]) -> None:
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(OSError, match="disk full"):
        save(tmp_path / "file", "released", "mfnet", {"a": torch.zeros(1)}, {})
    assert not list(tmp_path.iterdir())
