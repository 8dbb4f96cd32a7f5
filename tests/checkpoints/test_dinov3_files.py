"""Files of DINOv3's vision transformers: the published form, those of other programs, refusals."""

from __future__ import annotations

import re
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from rgbt.assembly.session import differences
from rgbt.checkpoints.dinov3 import FORMS
from rgbt.checkpoints.load import load_weights, plan_for
from rgbt.checkpoints.read import read
from rgbt.checkpoints.recognise import recognise
from rgbt.checkpoints.report import count_parameters
from rgbt.checkpoints.starts import STARTS
from rgbt.checks import InputError
from tests.checkpoints import test_dinov2_files as dinov2
from tests.checkpoints.files import named, network, saved, sentence
from tests.checkpoints.test_layouts import on_paper
from tests.models.plain import images, normal, randomise
from tests.models.test_dinov2_encoder import published_shapes as published_dinov2
from tests.models.test_dinov3_encoder import published_shapes

Tensors = OrderedDict[str, Tensor]
ENCODER = "backbone.encoder."
SMALL = {"embed_dim": 16, "num_heads": 2, "depth": 2, "layers": [2]}


def small(mlp: str = "gelu") -> nn.Module:
    """A network of the size of `small_file`, with drawn weights."""
    net = network("dinov3_tiny", **SMALL, mlp=mlp)
    periods = net.backbone.encoder.rope_embed.periods.clone()
    randomise(net)
    net.backbone.encoder.rope_embed.periods.copy_(periods)
    return net.eval()


def small_file(mlp: str = "gelu") -> Tensors:
    """The published form, written without our network; the bias of the keys is 0."""
    sizes = {384: 16, 3 * 384: 48, 4 * 384: 64, 1536: 64, 16: 8}
    shapes = {
        name: tuple(sizes.get(n, n) for n in shape)
        for name, shape in published_shapes(384, gated=mlp == "swiglu").items()
        if not re.match(r"blocks\.([2-9]|1\d)\.", name)
    }
    made = OrderedDict(
        (name, normal(*shape, seed=number) / 4)
        for number, (name, shape) in enumerate(shapes.items())
    )
    made["rope_embed.periods"] = 100.0 ** torch.tensor([0.0, 0.5])
    for name in made:
        if name.endswith("bias_mask"):
            made[name] = torch.tensor([1.0, 0.0, 1.0]).repeat_interleave(16)
            made[name.removesuffix("_mask")][16:32] = 0
    return made


def as_hugging_face(tensors: Tensors) -> Tensors:
    """What transformers makes of a published file."""
    layers = {"w1": "gate_proj", "w2": "up_proj", "w3": "down_proj"}
    layers |= {"fc1": "up_proj", "fc2": "down_proj"}
    made: Tensors = OrderedDict()
    for name, value in tensors.items():
        block, _, rest = re.sub(r"^blocks\.", "layer.", name).partition(".attn.")
        if name.startswith("rope_embed.") or name.endswith("bias_mask"):
            continue
        if rest.startswith("qkv."):
            end = rest.removeprefix("qkv.")
            for letter, part in zip("qkv", value.chunk(3), strict=True):
                if (letter, end) != ("k", "bias"):
                    made[f"{block}.attention.{letter}_proj.{end}"] = part.clone()
        elif rest:
            made[f"{block}.attention.o_{rest}"] = value
        elif ".mlp." in name:
            start, _, end = block.partition(".mlp.")
            layer, _, kind = end.partition(".")
            made[f"{start}.mlp.{layers[layer]}.{kind}"] = value
        elif name.startswith("blocks."):
            made[re.sub(r"\.ls(\d)\.gamma$", r".layer_scale\1.lambda1", block)] = value
        elif name.startswith("norm."):
            made[name] = value
        else:
            stem = name.replace("patch_embed.proj", "patch_embeddings")
            made["embeddings." + stem.replace("storage", "register")] = value
    made["embeddings.mask_token"] = made["embeddings.mask_token"][None]
    return made


def as_timm(tensors: Tensors, *, bias: bool = True) -> Tensors:
    """What timm makes of a published file, with and without biases of queries and values."""
    words = {"storage_tokens": "reg_token", "ls1.gamma": "gamma_1", "ls2.gamma": "gamma_2"}
    words |= {"mlp.w1": "mlp.fc1_g", "mlp.w2": "mlp.fc1_x", "mlp.w3": "mlp.fc2"}
    made: Tensors = OrderedDict()
    for name, value in tensors.items():
        if name.endswith((".periods", "bias_mask", "mask_token")):
            continue
        if name.endswith("qkv.bias"):
            if bias:
                made[name.replace("qkv.bias", "q_bias")] = value.chunk(3)[0].clone()
                made[name.replace("qkv.bias", "v_bias")] = value.chunk(3)[2].clone()
            continue
        made[re.sub("|".join(words), lambda found: words[found[0]], name)] = value
    return made


OTHERS: dict[str, tuple[Callable[[Tensors], Tensors], int]] = {
    "Hugging Face": (as_hugging_face, 1),
    "timm": (as_timm, 2),
}
"""Form -> how it is made, and how many entries of the encoder it does not hold."""


def written(folder: Path, tensors: Tensors) -> Path:
    """A file of safetensors, as both programs publish."""
    save_file({name: value.contiguous() for name, value in tensors.items()}, folder / "file.st")
    return folder / "file.st"


@pytest.mark.parametrize("mlp", ["gelu", "swiglu"])
@pytest.mark.parametrize("form", OTHERS)
@torch.no_grad()
def test_every_form_gives_equal_outputs(tmp_path: Path, form: str, mlp: str) -> None:
    tensors, (made, absent) = small_file(mlp), OTHERS[form]
    first, second = small(mlp), small(mlp)
    report = load_weights(first, saved(tmp_path, tensors))
    other = load_weights(second, written(tmp_path, made(tensors)))
    assert report.facts.what == "DINOv3 vision transformer"
    assert other.facts.what == f"DINOv3 vision transformer of {form}"
    assert report.num_set - other.num_set == absent
    assert report.leftover == {"the bias of the keys is 0 in this network too": 2}
    assert other.leftover == {}
    own = first.state_dict()
    for name, value in tensors.items():
        if not name.endswith("bias_mask"):
            assert torch.equal(own[ENCODER + name.replace("storage", "register")], value), name
    pair = images(1)
    assert torch.equal(first(*pair).logits, second(*pair).logits)
    first.state_dict()[f"{ENCODER}register_tokens"].add_(1.0)  # they do count
    assert not torch.equal(first(*pair).logits, second(*pair).logits)


def test_a_file_of_timm_without_biases_sets_them_to_0(tmp_path: Path) -> None:
    net = small()
    load_weights(net, written(tmp_path, as_timm(small_file(), bias=False)))
    assert not any(block.attn.qkv.bias.any() for block in net.backbone.encoder.blocks)


def test_periods_are_those_of_the_file(tmp_path: Path) -> None:
    """The published files hold them rounded to bfloat16."""
    net, tensors = small(), small_file()
    tensors["rope_embed.periods"] = torch.tensor([1.0, 9.0])
    load_weights(net, saved(tmp_path, tensors))
    assert net.backbone.encoder.rope_embed.periods.tolist() == [1.0, 9.0]


@pytest.mark.parametrize(
    ("form", "lost"),
    [
        (as_hugging_face, "layer.1.attention.k_proj.weight"),
        (as_hugging_face, "layer.1.attention.v_proj.bias"),
        (as_hugging_face, "layer.1.layer_scale2.lambda1"),
        (as_timm, "blocks.1.attn.q_bias"),
        (dict, "more"),
        (dict, "blocks.1.ls2.gamma"),
    ],
)
def test_files_are_read_strictly(tmp_path: Path, form: Any, lost: str) -> None:
    net, tensors = small(), form(small_file())
    tensors.pop(lost, None)
    if lost == "more":
        tensors["blocks.2.ls2.gamma"] = torch.ones(16)
    before = {name: value.clone() for name, value in net.state_dict().items()}
    with pytest.raises(InputError, match="does not fit this network"):
        load_weights(net, written(tmp_path, tensors))
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())


def test_an_added_bias_of_keys_is_refused(tmp_path: Path) -> None:
    """The network has none, so its values would be lost."""
    tensors = as_hugging_face(small_file())
    tensors["layer.0.attention.k_proj.bias"] = torch.ones(16)
    with pytest.raises(InputError, match="1 entry of the file unknown to the network"):
        load_weights(small(), written(tmp_path, tensors))


@pytest.mark.parametrize("form", [dict, as_hugging_face, as_timm])
def test_a_file_of_the_other_generation_is_one_sentence(tmp_path: Path, form: Any) -> None:
    with pytest.raises(InputError) as error:
        load_weights(dinov2.small(), written(tmp_path, form(small_file())))
    text = sentence(error)
    assert "a file of DINOv3, while the encoder of this network is one of DINOv2" in text


@pytest.mark.parametrize("form", [dict, dinov2.as_timm])
def test_a_file_of_dinov2_is_one_sentence(tmp_path: Path, form: Any) -> None:
    with pytest.raises(InputError) as error:
        load_weights(small(), written(tmp_path, form(dinov2.small_file(4))))
    text = sentence(error)
    assert "a file of DINOv2, while the encoder of this network is one of DINOv3" in text


@pytest.mark.parametrize(
    ("model", "size", "width", "values"),
    [
        ("vits16", "S", 384, 21_601_152),
        ("vits16plus", "S+", 384, 28_697_472),
        ("vitb16", "B", 768, 85_669_632),
    ],
)
@pytest.mark.parametrize("layout", FORMS)
def test_published_files_are_recognised(
    tmp_path: Path, model: str, size: str, width: int, values: int, layout: str
) -> None:
    tensors = named(published_shapes(width, gated="plus" in model))
    if layout == "dinov3":
        assert count_parameters(tensors) == values
    else:
        tensors = (as_timm if layout == "dinov3_timm" else as_hugging_face)(tensors)
    facts = recognise(read(saved(tmp_path, tensors)))
    assert facts.layout == layout
    assert facts.title.endswith(f"(ViT-{size}/16)")
    assert facts.fits == ((f"model=dinov3_{model}",),)
    assert [start.file for start in STARTS if f"dinov3_{model}" in start.models]


def test_the_published_network_takes_its_file(tmp_path: Path) -> None:
    net = on_paper("dinov3_vits16")
    facts, plan, _ = plan_for(net, read(saved(tmp_path, named(published_shapes(384)))), ())
    assert plan.fits
    assert len(plan.values) == 176
    assert differences({"norm_eps": 1e-6}, facts.convention[1:]) == ["model.norm_eps=1e-05"]
    assert differences({"norm_eps": 1e-5, "rope_base": 100.0}, facts.convention[1:]) == []


def test_refusals_of_whole_sizes_name_the_network(tmp_path: Path) -> None:
    net = on_paper("dinov3_vits16")
    for shapes, words in (
        (published_shapes(384, gated=True), "The file fits model=dinov3_vits16plus."),
        (published_dinov2(384, 4), "; use model=dinov2_vits14_reg."),
    ):
        with pytest.raises(InputError) as error:
            load_weights(net, saved(tmp_path, named(shapes)))
        assert words in sentence(error)
