"""Files of DINOv2's vision transformers: the published form, that of timm, and what is refused."""

from __future__ import annotations

import re
from collections import OrderedDict
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.assembly.session import differences
from rgbt.checkpoints.load import load_weights, plan_for
from rgbt.checkpoints.read import read
from rgbt.checkpoints.recognise import recognise
from rgbt.checkpoints.starts import STARTS
from rgbt.checks import InputError
from rgbt.weights import entry
from tests.checkpoints.files import named, network, saved, sentence
from tests.checkpoints.test_layouts import on_paper
from tests.commands import Call
from tests.models.plain import images, normal, randomise
from tests.models.test_dinov2_encoder import published_shapes

ENCODER = "backbone.encoder."
SMALL = {"embed_dim": 16, "num_heads": 2, "depth": 2, "layers": [2], "position_grid": 3}


def small(**changes: Any) -> nn.Module:
    """A network of the size of `small_file`, with drawn weights."""
    net = network("dinov2_tiny", **{**SMALL, **changes})
    randomise(net)
    return net.eval()


def small_file(registers: int) -> OrderedDict[str, Tensor]:
    """The published form, written without our network."""
    shapes = {
        name: tuple({384: 16, 3 * 384: 48, 4 * 384: 64, 1370: 10, 14: 8}.get(n, n) for n in shape)
        for name, shape in published_shapes(384, registers).items()
        if not re.match(r"blocks\.([2-9]|1\d)\.", name)
    }
    return OrderedDict(
        (name, normal(*shape, seed=number) / 4)
        for number, (name, shape) in enumerate(shapes.items())
    )


def as_timm(tensors: OrderedDict[str, Tensor]) -> OrderedDict[str, Tensor]:
    """What timm makes of a published file; it adds the position of the class to its token."""
    made = OrderedDict(tensors)
    del made["mask_token"]
    if "register_tokens" in made:
        made["reg_token"] = made.pop("register_tokens")
        made["cls_token"] = made["cls_token"] + made["pos_embed"][:, :1]
        made["pos_embed"] = made["pos_embed"][:, 1:]
    return made


@pytest.mark.parametrize("registers", [0, 4])
@torch.no_grad()
def test_both_forms_of_a_file_give_equal_outputs(tmp_path: Path, registers: int) -> None:
    tensors = small_file(registers)
    first, second = (small(num_registers=registers) for _ in range(2))
    report = load_weights(first, saved(tmp_path, tensors))
    of_timm = load_weights(second, saved(tmp_path, as_timm(tensors), name="timm.pth"))
    assert report.facts.what == "DINOv2 vision transformer"
    assert of_timm.facts.what == "DINOv2 vision transformer of timm"
    assert (report.num_set, of_timm.num_set) == (len(tensors), len(tensors) - 1)
    for name, value in tensors.items():
        assert torch.equal(first.state_dict()[ENCODER + name], value)
    pair = images(1)
    for view in ("rgbt", "rgb", "thermal"):
        logits = [net(*pair, views=(view,)).logits for net in (first, second)]
        assert torch.equal(*logits)
    first.state_dict()[f"{ENCODER}cls_token"].add_(1.0)  # the class token does count
    assert not torch.equal(first(*pair).logits, second(*pair).logits)


def test_entries_outside_the_encoder_keep_their_values(tmp_path: Path) -> None:
    net = small(tuning="lora")
    before = {name: value.clone() for name, value in net.state_dict().items()}
    report = load_weights(net, saved(tmp_path, as_timm(small_file(4))))
    mask_token = f"{ENCODER}mask_token"
    for name, value in net.state_dict().items():
        if not name.startswith(ENCODER) or name == mask_token:
            assert torch.equal(value, before[name]), name
    assert "timm drops it; hidden patches get this one" in report.fresh
    assert report.leftover == {}


@pytest.mark.parametrize("change", ["missing", "more", "nan"])
def test_files_are_read_strictly(tmp_path: Path, change: str) -> None:
    net, tensors = small(), small_file(4)
    if change == "missing":
        del tensors["blocks.1.ls2.gamma"]
    elif change == "more":
        tensors["blocks.2.ls2.gamma"] = torch.ones(16)
    else:
        tensors["norm.bias"][3] = torch.nan
    before = {name: value.clone() for name, value in net.state_dict().items()}
    with pytest.raises(InputError) as error:
        load_weights(net, saved(tmp_path, tensors))
    assert {"missing": "ls2.gamma", "more": "blocks.2.", "nan": "norm.bias"}[change] in sentence(
        error
    )
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())


@pytest.mark.parametrize("timm", [False, True])
@pytest.mark.parametrize("registers", [0, 4])
def test_registers_that_the_network_lacks_or_the_file_are_named(
    tmp_path: Path, registers: int, timm: bool
) -> None:
    tensors = small_file(registers)
    path = saved(tmp_path, as_timm(tensors) if timm else tensors)
    with pytest.raises(InputError) as error:
        load_weights(small(num_registers=4 - registers), path)
    words = ("with", "without") if registers else ("without", "with")
    text = sentence(error)
    assert f"a file {words[0]} registers, while this network is one {words[1]} registers" in text


@pytest.mark.parametrize("registers", [0, 4])
@pytest.mark.parametrize(("width", "size"), [(384, "S"), (768, "B")])
@pytest.mark.parametrize("timm", [False, True])
def test_published_files_are_recognised(
    tmp_path: Path, width: int, size: str, registers: int, timm: bool
) -> None:
    shapes = published_shapes(width, registers)
    if timm:
        del shapes["mask_token"]
        if registers:
            shapes["reg_token"] = shapes.pop("register_tokens")
            shapes["pos_embed"] = (1, 37 * 37, width)
    facts = recognise(read(saved(tmp_path, named(shapes))))
    more = ", 4 registers" if registers else ""
    assert facts.title == (
        f"DINOv2 vision transformer{' of timm' if timm else ''} (ViT-{size}/14{more})"
    )
    model = f"dinov2_vit{size.lower()}14{'_reg' if registers else ''}"
    assert facts.fits == ((f"model={model}",),)
    assert {start.models for start in STARTS if model in start.models} == {(model,)}


def test_the_published_network_takes_its_file(tmp_path: Path) -> None:
    net = on_paper("dinov2_vits14_reg")
    path = saved(tmp_path, named(published_shapes(384, 4)))
    facts, plan, _ = plan_for(net, read(path), ())
    assert plan.fits
    assert len(plan.values) == 176
    assert differences({"position_resize": "factor"}, facts.convention[1:]) == [
        "model.position_resize=size"
    ]


def test_another_size_is_one_sentence(tmp_path: Path) -> None:
    net = on_paper("dinov2_vits14_reg")
    path = saved(tmp_path, named(published_shapes(768, 4)))
    with pytest.raises(InputError) as error:
        load_weights(net, path)
    assert "The file fits model=dinov2_vitb14_reg." in sentence(error)


def test_chunked_blocks_are_refused(tmp_path: Path) -> None:
    tensors = {re.sub(r"^blocks\.", "blocks.0.", k): v for k, v in small_file(4).items()}
    path = saved(tmp_path, OrderedDict(tensors))
    with pytest.raises(InputError) as error:
        load_weights(small(), path)
    assert "blocks are in chunks" in sentence(error)


def test_another_network_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path, named(published_shapes(384, 4)))
    with pytest.raises(InputError) as error:
        load_weights(network("mask2former_tiny"), path)
    assert "it fits model=dinov2_vits14_reg" in sentence(error)
    swin = saved(tmp_path, named({"patch_embed.proj.weight": (4, 3, 4, 4), "cls_token": (1,)}))
    assert recognise(read(swin)).layout == "unknown"


def test_inspect_names_network_and_recipe(tmp_path: Path, call: Call) -> None:
    path = saved(tmp_path, named(published_shapes(384, 4)), name="dinov2_vits14_reg4_pretrain.pth")
    code, out, _ = call(entry, "inspect", str(path))
    assert code == 0
    assert "DINOv2 vision transformer (ViT-S/14, 4 registers)" in out
    assert "dinov2 (with model=dinov2_vits14_reg pretrained=FILE)" in out
    assert "22,058,112" in out
