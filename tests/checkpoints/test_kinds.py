"""Every kind of file: where each of its tensors goes in a network."""

from __future__ import annotations

import argparse
import re
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.checkpoints.files import read
from rgbt.checkpoints.kinds import CMNEXT
from rgbt.checkpoints.load import Plan, load_weights, plan_for
from rgbt.checks import InputError
from tests.checkpoints.files import MIT, SWIN, holds, like, named, network, saved
from tests.checkpoints.imagenet import deep_resnet_file, mit_file, resnet_file, swin_file
from tests.models import golden
from tests.models.plain import images, normal, randomise

Tensors = OrderedDict[str, Tensor]
DINO = {"embed_dim": 16, "num_heads": 2, "depth": 2, "layers": [2]}
ENCODER = "backbone.encoder."


def planned(folder: Path, yaml: str, content: Any) -> Plan:
    """What a file sets in a network that takes no memory for its weights."""
    with torch.device("meta"):
        model = golden.network(yaml)
    return plan_for(model, read(saved(folder, content)))


def test_imagenet_swin_is_loaded_into_both_branches(tmp_path: Path) -> None:
    model, tensors = network("mask2former_tiny", **SWIN), swin_file()
    stem = torch.arange(32 * 3 * 16.0).reshape(32, 3, 4, 4)
    tensors["patch_embed.proj.weight"] = stem
    before = {key: value.clone() for key, value in model.state_dict().items()}
    load_weights(model, saved(tmp_path, {"model": tensors}))
    after = model.state_dict()
    rgb, thermal = "backbone.RGB_branch.", "backbone.THR_branch."
    assert torch.equal(after[f"{rgb}patch_embed.proj.weight"], stem)
    found = after[f"{thermal}patch_embed.proj.weight"]
    assert torch.allclose(found[:, 0], (stem[:, 0] + stem[:, 1] + stem[:, 2]) / 3)
    for name in (name for name in tensors if name.startswith("layers.") and rgb + name in after):
        assert holds(after[f"{rgb}{name}"], name)
        assert holds(after[f"{thermal}{name}"], name)
    for key in after:
        if key.startswith("sem_seg_head.") or ".norm3." in key or key.endswith("mask_token"):
            assert torch.equal(after[key], before[key]), key


@pytest.mark.parametrize("yaml", ["mask2former_lite0", "cmx_lite0"])
def test_imagenet_efficientnet_fills_both_encoders(tmp_path: Path, yaml: str) -> None:
    """The file has no prefix; its head is not used, and has a normalisation called _bn1."""
    model = network(yaml, width=0.2, depth=0.5, **({"num_heads": [1] * 4} if "cmx" in yaml else {}))
    beginning = "backbone.encoders.rgb."
    names = [name for name in model.state_dict() if name.startswith(beginning)]
    file = OrderedDict(
        (name.removeprefix(beginning), like({name.removeprefix(beginning): value}).popitem()[1])
        for name, value in model.state_dict().items()
        if name in names
    )
    head = {"_conv_head.weight": (1280, 64, 1, 1), "_bn1.weight": (1280,), "_fc.bias": (1000,)}
    plan = load_weights(model, saved(tmp_path, file | named(head)))
    assert plan.kind.title == "ImageNet EfficientNet-Lite"
    assert plan.convention == ("model/inputs=lite",)
    assert set(plan.unused) == set(head)
    for modality in ("rgb", "thermal"):
        for name in file:
            found = model.state_dict()[f"backbone.encoders.{modality}.{name}"]
            assert name.endswith("num_batches_tracked") or holds(found, name), name
    assert not any(name.startswith("backbone.encoders.") for name in plan.fresh)


def timm_swin() -> Tensors:
    """timm has the merging between two stages in the second of them, and head.fc."""

    def renamed(name: str) -> str:
        merging = re.match(r"layers\.(\d)\.downsample", name)
        later = f"layers.{int(merging[1]) + 1}" if merging else ""
        return re.sub(r"^layers\.\d(?=\.down)", later, name).replace("head.", "head.fc.")

    return OrderedDict((renamed(name), value) for name, value in swin_file().items())


def test_timm_swin_has_the_merging_in_the_next_stage(tmp_path: Path) -> None:
    model = network("mask2former_tiny", **SWIN)
    plan = load_weights(model, saved(tmp_path, timm_swin()))
    assert plan.kind.title == "ImageNet Swin Transformer of timm"
    state = model.state_dict()
    for branch in ("RGB", "THR"):
        for name in ("downsample.reduction.weight", "blocks.0.norm1.bias"):
            found = state[f"backbone.{branch}_branch.layers.1.{name}"]
            # The file was made of the original names, so that each value tells its place there.
            assert holds(found, f"layers.1.{name}")
    second, third = (f"layers.{n}.downsample.reduction.weight" for n in (2, 3))
    tensors = timm_swin()
    missing = OrderedDict((name, value) for name, value in tensors.items() if name != second)
    swapped = tensors | {second: tensors[third], third: tensors[second]}
    for content in (missing, swapped):
        with pytest.raises(InputError, match="does not fit this network"):
            load_weights(model, saved(tmp_path, content))


@pytest.mark.parametrize("yaml", ["cmx_tiny", "cmnext_tiny"])
def test_imagenet_mit_fills_streams_of_cmx_and_cmnext(tmp_path: Path, yaml: str) -> None:
    model = network(yaml, **MIT)
    before = {key: value.clone() for key, value in model.state_dict().items()}
    load_weights(model, saved(tmp_path, mit_file()))
    rgb = ("backbone.patch_embed", "backbone.block", "backbone.norm")
    both = (*rgb, *(name.replace("backbone.", "backbone.extra_") for name in rgb))
    for key, value in model.state_dict().items():
        if key.startswith(both if yaml == "cmx_tiny" else rgb):
            assert holds(value, re.sub(r"backbone\.(extra_)?", "", key)), key
        else:
            assert torch.equal(value, before[key]), key


def test_thermal_stem_of_rtfnet_is_mean_or_drawn_anew(tmp_path: Path) -> None:
    tensors = resnet_file(18, counters=False, width=4)
    stem = torch.arange(4 * 3 * 49.0).reshape(4, 3, 7, 7)
    tensors["conv1.weight"] = stem
    path, key = saved(tmp_path, tensors), "encoder_thermal_conv1.weight"
    released, drawn = (
        network("rtfnet_18", base_width=4, thermal_stem=stem) for stem in ("rgb_mean", "xavier")
    )
    before = drawn.state_dict()[key].clone()
    plan = load_weights(released, path)
    load_weights(drawn, path)
    assert torch.equal(released.state_dict()[key], stem.mean(1, keepdim=True))
    assert torch.equal(drawn.state_dict()[key], before)
    for model in (released, drawn):
        assert torch.equal(model.state_dict()["encoder_rgb_conv1.weight"], stem)
    assert len(plan.zeros) == 40
    # A checkpoint of the whole network holds what was drawn.
    own = saved(tmp_path, {"model": drawn.state_dict(), "step": 1})
    again = network("rtfnet_18", base_width=4, thermal_stem="xavier")
    again.state_dict()[key].zero_()
    load_weights(again, own)
    assert torch.equal(again.state_dict()[key], before)


@pytest.mark.parametrize("modalities", ["late_fusion", "early_fusion", "rgb", "thermal"])
def test_a_resnet_fills_the_encoder_of_pspnet(tmp_path: Path, modalities: str) -> None:
    tensors = resnet_file(50, width=8)
    stem = torch.arange(8 * 3 * 49.0).reshape(8, 3, 7, 7)
    tensors["conv1.weight"] = stem
    model = network("heatnet", 13, modalities=modalities, base_width=8)
    plan, state = load_weights(model, saved(tmp_path, tensors)), model.state_dict()
    mean = stem.mean(1, keepdim=True)
    expected = {
        "late_fusion": (stem, mean),
        "early_fusion": (torch.cat([stem, mean], 1),),
        "rgb": (stem,),
        "thermal": (mean,),
    }[modalities]
    for end, value in zip(("", "_2"), expected, strict=False):
        assert torch.equal(state[f"feats.conv1{end}.weight"], value)
        assert holds(state[f"feats.layer2{end}.3.conv2.weight"], "layer2.3.conv2.weight")
    assert holds(state["feats.layer4.2.bn3.running_var"], "layer4.2.bn3.running_var")
    two = modalities == "late_fusion"
    projection = {name for name in plan.unused if name.startswith("layer3.0.")}
    assert len(projection) == (7 if two else 0)  # conv1, and 6 of the projection
    assert ("feats.layer3.0.conv1.weight" in plan.fresh) == two


def test_only_own_file_fills_deep_stem_of_semseg(tmp_path: Path) -> None:
    """resnet50_v2.pth: conv1 to conv3 and bn1 to bn3 before the stages."""
    model, deep = network("semseg_tiny", 14, depths="[3,4,6,3]"), deep_resnet_file(8)
    plan, state = load_weights(model, saved(tmp_path, deep)), model.state_dict()
    places = {"0": "conv1", "1": "bn1", "3": "conv2", "4": "bn2", "6": "conv3", "7": "bn3"}
    for number, name in places.items():
        assert holds(state[f"layer0.{number}.weight"], f"{name}.weight")
    assert holds(state["layer3.5.conv2.weight"], "layer3.5.conv2.weight")
    assert {name.split(".")[0] for name in plan.fresh} == {"ppm", "cls", "aux"}
    plain = resnet_file(50, width=8)
    for yaml, other in (("semseg_tiny", plain), ("heatnet_tiny", deep)):
        with pytest.raises(InputError):
            load_weights(network(yaml, 14), saved(tmp_path, other))


def test_released_names_of_cmnext(tmp_path: Path) -> None:
    """Patch embeddings of the thermal stream are numbered from 0; all other names are ours."""
    extra, fuse = "backbone.extra_", "decode_head.linear_fuse"
    expected = {
        f"{extra}patch_embed1.proj.bias": f"{extra}downsample_layers.0.proj.module.bias",
        f"{extra}patch_embed4.norm.bias": f"{extra}downsample_layers.3.norm.ln_0.bias",
        f"{fuse}.0.weight": f"{fuse}.conv.weight",
        f"{fuse}.1.running_var": f"{fuse}.bn.running_var",
        f"{extra}block1.0.c_nets.0.weight": f"{extra}block1.0.c_nets.0.weight",
    }
    assert {name: CMNEXT.source(name) for name in expected} == expected
    model = network("cmnext_tiny")
    content = like({CMNEXT.source(key): value for key, value in model.state_dict().items()})
    plan = load_weights(model, saved(tmp_path, {"model_state_dict": content, "epoch": 7}))
    assert plan.convention == ("model/inputs=imagenet_unit",)
    assert all(holds(value, CMNEXT.source(key)) for key, value in model.state_dict().items())
    # A third modality has no place.
    third = f"{extra}downsample_layers.0.norm.ln_1.weight"
    with pytest.raises(InputError, match="ln_1.weight is unknown"):
        load_weights(model, saved(tmp_path, {**content, third: torch.ones(1)}))


def test_conventions_follow_from_the_file(tmp_path: Path) -> None:
    state = like(network("cmx_tiny").state_dict())
    voting = named({"voting.weight": (9, 18, 3, 3), "voting.bias": (9,)})
    cmx, temporal = (
        planned(tmp_path, "cmx_tiny", content) for content in (state, {**state, **voting})
    )
    assert (cmx.unused, temporal.unused) == ([], ["voting.bias", "voting.weight"])
    assert cmx.convention == ("model/inputs=cmx_released", "model.decoder_norm_eps_eval=1e-5")
    assert temporal.convention == ("model/inputs=temporal",)
    hyper = {"cfg": argparse.Namespace(MODEL={"FUSION": {"AGGREGATION": "ADD"}})}
    crm = like(network("mask2former_tiny").state_dict(), "network.")
    plan = planned(tmp_path, "mask2former_tiny", {"state_dict": crm, "hyper_parameters": hyper})
    assert plan.convention == ("model/inputs=crm", "model.fusion=add")


# Vision transformers: small files in the published names, and what other programs make of them.


def dino(generation: int, **changes: Any) -> nn.Module:
    """A network of the size of the small files, with drawn weights."""
    more = {"position_grid": 3} if generation == 2 else {}
    net = network(f"dinov{generation}_tiny", **{**DINO, **more, **changes})
    rope = getattr(net.backbone.encoder, "rope_embed", None)
    periods = None if rope is None else rope.periods.clone()
    randomise(net)
    if rope is not None:
        rope.periods.copy_(periods)
    return net.eval()


def dinov2_file(**changes: Any) -> Tensors:
    """In the names of the authors, which are those of the encoder here."""
    state = dino(2, **changes).backbone.encoder.state_dict()
    return OrderedDict((n, normal(*v.shape, seed=k)) for k, (n, v) in enumerate(state.items()))


def dinov3_file(mlp: str = "gelu") -> Tensors:
    """The bias of the keys is 0."""
    state = dino(3, mlp=mlp).backbone.encoder.state_dict()
    made = OrderedDict((n, normal(*v.shape, seed=k)) for k, (n, v) in enumerate(state.items()))
    made["storage_tokens"] = made.pop("register_tokens")
    made["rope_embed.periods"] = state["rope_embed.periods"]
    for name in [name for name in made if name.endswith("qkv.bias")]:
        made[f"{name}_mask"] = torch.tensor([1.0, 0.0, 1.0]).repeat_interleave(16)
        made[name][16:32] = 0
    return made


@pytest.mark.parametrize(
    ("generation", "changes", "file"),
    [
        (2, {"num_registers": 0}, lambda: dinov2_file(num_registers=0)),
        (2, {"num_registers": 4}, lambda: dinov2_file(num_registers=4)),
        (3, {}, dinov3_file),
        (3, {"mlp": "swiglu"}, lambda: dinov3_file("swiglu")),
    ],
)
@torch.no_grad()
def test_every_tensor_of_a_transformer_is_read(
    tmp_path: Path, generation: int, changes: Any, file: Callable[[], Tensors]
) -> None:
    tensors, net = file(), dino(generation, **changes)
    plan = load_weights(net, saved(tmp_path, tensors))
    assert plan.kind.title == f"DINOv{generation} vision transformer"
    assert plan.num_set == sum(not name.endswith("bias_mask") for name in tensors)
    own = net.state_dict()
    for name, value in tensors.items():
        key = ENCODER + name.replace("storage_tokens", "register_tokens")
        assert name.endswith("bias_mask") or torch.equal(own[key], value), name
    before = net(*images(1)).logits
    own[f"{ENCODER}cls_token"].add_(1.0)  # the class token does count
    assert not torch.equal(net(*images(1)).logits, before)


def test_published_periods_of_dinov3_are_taken_as_they_are(tmp_path: Path) -> None:
    """They are rounded to bfloat16."""
    net, tensors = dino(3), dinov3_file()
    tensors["rope_embed.periods"] = torch.tensor([1.0, 9.0])
    load_weights(net, saved(tmp_path, tensors))
    assert net.backbone.encoder.rope_embed.periods.tolist() == [1.0, 9.0]
