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
from safetensors.torch import save_file
from torch import Tensor, nn

from rgbt.checkpoints.kinds import CMNEXT
from rgbt.checkpoints.load import Plan, load_weights, plan_for, recognised
from rgbt.checkpoints.read import read
from rgbt.checks import InputError
from tests.checkpoints.files import holds, like, named, network, saved
from tests.checkpoints.imagenet import deep_resnet_file, mit_file, resnet_file, swin_file
from tests.models import golden
from tests.models.plain import images, normal, randomise
from tests.models.test_dino import published_dinov3
from tests.models.test_dino import published_shapes as published_dinov2

Tensors = OrderedDict[str, Tensor]
SWIN = {"embed_dim": 32, "depths": [1, 1, 2, 1], "num_heads": [1, 2, 4, 8], "window_size": 5}
MIT = {"embed_dims": [16, 32, 64, 96], "depths": [1, 1, 1, 1], "num_heads": [1, 2, 4, 6]}
DINO = {"embed_dim": 16, "num_heads": 2, "depth": 2, "layers": [2]}
SLOW = pytest.mark.slow
ENCODER = "backbone.encoder."


def planned(folder: Path, yaml: str, content: Any) -> Plan:
    """What a file sets in a network that takes no memory for its weights."""
    with torch.device("meta"):
        model = golden.network(yaml)
    return plan_for(model, read(saved(folder, content)))


CLASSIFIER = [f"Scale.layer5.conv2d_list.{n}.weight" for n in range(4)]
PUBLISHED: list[tuple[str, Callable[[], Any], str, int]] = [
    # network, file, what it is, entries that are set
    # Every block of a branch has 13 parameters, and each branch 4 of the embedding, 9 of merging.
    ("mask2former_swin_t", lambda: swin_file(96, (2, 2, 6, 2), (3, 6, 12, 24), 7), "Swin", 338),
    ("mask2former_swin_s", lambda: swin_file(96, (2, 2, 18, 2), (3, 6, 12, 24), 7), "Swin", 650),
    ("cmx_b0", lambda: mit_file((32, 64, 160, 256), (2, 2, 2, 2)), "MiT", 2 * 176),
    ("cmx_b2", lambda: mit_file((64, 128, 320, 512), (3, 4, 6, 3)), "MiT", 2 * 332),
    ("cmnext_b2", lambda: mit_file((64, 128, 320, 512), (3, 4, 6, 3)), "MiT", 332),
    ("rtfnet_18", lambda: resnet_file(18), "ResNet", 2 * 120),
    ("rtfnet_152", lambda: resnet_file(152), "ResNet", 2 * 930),
    ("deeplabv2", lambda: resnet_file(101), "ResNet", 624),
    (
        *("deeplabv2", lambda: resnet_file(101, prefix="Scale.", more=CLASSIFIER)),
        *("DeepLab v2 start of AdaptSegNet", 624),
    ),
    ("dinov2_vits14", lambda: named(published_dinov2(384, 0)), "DINOv2", 175),
    ("dinov2_vits14_reg", lambda: named(published_dinov2(384, 4)), "DINOv2", 176),
    ("dinov3_vits16", lambda: named(published_dinov3(384)), "DINOv3", 176),
    ("dinov3_vits16plus", lambda: named(published_dinov3(384, gated=True)), "DINOv3", 200),
]
FAST = (0, 2, 5, 8, 10, 12)


@pytest.mark.parametrize(
    ("yaml", "file", "what", "entries"),
    [pytest.param(*c, marks=() if n in FAST else SLOW) for n, c in enumerate(PUBLISHED)],
)
def test_published_backbones_fill_their_network(
    tmp_path: Path, yaml: str, file: Callable[[], Any], what: str, entries: int
) -> None:
    plan = planned(tmp_path, yaml, {"model": file()})
    assert plan.problems == []
    assert what in plan.kind.title
    assert plan.num_set == entries
    assert plan.num_set + len(plan.fresh) + len(plan.zeros) == plan.num_entries
    unused = r".*(position_index|attn_mask|bias_mask)$|(norm|head|fc)\.|Scale\.layer5\."
    assert all(re.match(unused, name) for name in plan.unused)


def test_imagenet_swin_is_loaded_into_both_branches(tmp_path: Path) -> None:
    model, tensors = (
        network("mask2former_tiny", **SWIN),
        swin_file(32, (1, 1, 2, 1), (1, 2, 4, 8), 5),
    )
    stem = torch.arange(32 * 3 * 16.0).reshape(32, 3, 4, 4)
    tensors["patch_embed.proj.weight"] = stem
    before = {key: value.clone() for key, value in model.state_dict().items()}
    load_weights(model, saved(tmp_path, {"model": tensors}))
    after = model.state_dict()
    rgb, thermal = "backbone.RGB_branch.", "backbone.THR_branch."
    assert torch.equal(after[f"{rgb}patch_embed.proj.weight"], stem)
    found = after[f"{thermal}patch_embed.proj.weight"]
    assert torch.allclose(found[:, 0], (stem[:, 0] + stem[:, 1] + stem[:, 2]) / 3)
    for name in tensors:
        if name.startswith("layers.") and f"{rgb}{name}" in after:
            assert holds(after[f"{rgb}{name}"], name)
            assert holds(after[f"{thermal}{name}"], name)
    for key in after:
        if key.startswith("sem_seg_head.") or ".norm3." in key or key.endswith("mask_token"):
            assert torch.equal(after[key], before[key]), key


def timm_swin(change: str) -> Tensors:
    """timm has the merging between two stages in the second of them, and head.fc."""
    tensors: Tensors = OrderedDict()
    for name, value in swin_file(32, (1, 1, 2, 1), (1, 2, 4, 8), 5).items():
        merging = re.match(r"layers\.(\d)\.downsample", name)
        later = f"layers.{int(merging[1]) + 1}" if merging else ""
        if not name.endswith(("index", "mask")) or change == "with buffers":
            tensors[re.sub(r"^layers\.\d(?=\.down)", later, name).replace("head.", "head.fc.")] = (
                value
            )
    merging = "layers.{}.downsample.reduction.weight"
    if change == "missing":
        del tensors[merging.format(2)]
    elif change == "both":
        tensors[merging.format(0)] = tensors[merging.format(1)]
    elif change == "swapped":
        first, second = merging.format(1), merging.format(2)
        tensors[first], tensors[second] = tensors[second], tensors[first]
    return tensors


@pytest.mark.parametrize("change", ["", "with buffers", "missing", "both", "swapped"])
def test_timm_swin_has_the_merging_in_the_next_stage(tmp_path: Path, change: str) -> None:
    model, path = network("mask2former_tiny", **SWIN), saved(tmp_path, timm_swin(change))
    if change in ("missing", "both", "swapped"):
        with pytest.raises(InputError, match="does not fit this network"):
            load_weights(model, path)
        return
    assert load_weights(model, path).kind.title == "ImageNet Swin Transformer of timm"
    state = model.state_dict()
    for branch in ("RGB", "THR"):
        for name in ("downsample.reduction.weight", "blocks.0.norm1.bias"):
            found = state[f"backbone.{branch}_branch.layers.1.{name}"]
            # The file was made of the original names, so that each value tells its place there.
            assert holds(found, f"layers.1.{name}")


@pytest.mark.parametrize("yaml", ["cmx_tiny", "cmnext_tiny"])
def test_imagenet_mit_fills_both_streams_of_cmx_and_one_of_cmnext(
    tmp_path: Path, yaml: str
) -> None:
    model = network(yaml, **MIT)
    before = {key: value.clone() for key, value in model.state_dict().items()}
    load_weights(model, saved(tmp_path, mit_file((16, 32, 64, 96), (1, 1, 1, 1))))
    rgb = ("backbone.patch_embed", "backbone.block", "backbone.norm")
    both = (*rgb, *(name.replace("backbone.", "backbone.extra_") for name in rgb))
    for key, value in model.state_dict().items():
        if key.startswith(both if yaml == "cmx_tiny" else rgb):
            assert holds(value, re.sub(r"backbone\.(extra_)?", "", key)), key
        else:
            assert torch.equal(value, before[key]), key


def test_the_thermal_stem_of_rtfnet_is_the_mean_or_drawn_anew(tmp_path: Path) -> None:
    tensors = resnet_file(18, counters=False, width=4)
    stem = torch.arange(4 * 3 * 49.0).reshape(4, 3, 7, 7)
    tensors["conv1.weight"] = stem
    path, key = saved(tmp_path, tensors), "encoder_thermal_conv1.weight"
    released, drawn = (
        network("rtfnet_18", base_width=4, thermal_stem=each) for each in ("rgb_mean", "xavier")
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


def test_the_deep_stem_of_semseg_is_filled_by_its_own_file_alone(tmp_path: Path) -> None:
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


WHOLE = [
    ("mask2former_tiny", "network.", "checkpoint of CRM or SpatialSeg"),
    ("mask2former_tiny", "", "checkpoint of CRM or SpatialSeg"),
    ("cmx_tiny", "", "CMX checkpoint"),
    ("cmnext_tiny", "module.", "CMNeXt checkpoint"),
    ("rtfnet_tiny", "", "RTFNet checkpoint"),
    ("mfnet_tiny", "", "MFNet checkpoint"),
    ("heatnet_tiny", "module.trgb_segnet.", "HeatNet checkpoint"),
    ("semseg_tiny", "module.", "PSPNet checkpoint of semseg"),
    ("dinov2_tiny", "", "state_dict() of such a network"),
]


@pytest.mark.parametrize(("yaml", "prefix", "what"), WHOLE)
def test_whole_networks_are_loaded_equal(tmp_path: Path, yaml: str, prefix: str, what: str) -> None:
    model = network(yaml)
    plan = load_weights(model, saved(tmp_path, {"weights": like(model.state_dict(), prefix)}))
    assert plan.kind.title == what
    assert plan.num_set == plan.num_entries
    for key, value in model.state_dict().items():
        assert holds(value, prefix + key), key


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
    cmx, temporal = (planned(tmp_path, "cmx_tiny", each) for each in (state, {**state, **voting}))
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


def small_file(shapes: dict[str, Any], sizes: dict[int, int]) -> Tensors:
    """A published file of two blocks and another width."""
    kept = {n: s for n, s in shapes.items() if not re.match(r"blocks\.([2-9]|1\d)\.", n)}
    return OrderedDict(
        (name, normal(*(sizes.get(n, n) for n in shape), seed=number) / 4)
        for number, (name, shape) in enumerate(kept.items())
    )


def dinov2_file(registers: int) -> Tensors:
    sizes = {384: 16, 3 * 384: 48, 4 * 384: 64, 1370: 10, 14: 8}
    return small_file(published_dinov2(384, registers), sizes)


def dinov3_file(mlp: str = "gelu") -> Tensors:
    """The bias of the keys is 0."""
    sizes = {384: 16, 3 * 384: 48, 4 * 384: 64, 1536: 64, 16: 8}
    made = small_file(published_dinov3(384, gated=mlp == "swiglu"), sizes)
    made["rope_embed.periods"] = 100.0 ** torch.tensor([0.0, 0.5])
    for name in [name for name in made if name.endswith("bias_mask")]:
        made[name] = torch.tensor([1.0, 0.0, 1.0]).repeat_interleave(16)
        made[name.removesuffix("_mask")][16:32] = 0
    return made


def dinov2_as_timm(tensors: Tensors) -> Tensors:
    """With registers timm adds the position of the class to its token."""
    made = OrderedDict(tensors)
    del made["mask_token"]
    if "register_tokens" in made:
        made["reg_token"] = made.pop("register_tokens")
        made["cls_token"] = made["cls_token"] + made["pos_embed"][:, :1]
        made["pos_embed"] = made["pos_embed"][:, 1:]
    return made


def as_hugging_face(tensors: Tensors) -> Tensors:
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
            start, layer, kind = re.split(r"\.mlp\.|\.(?=weight|bias)", block)
            made[f"{start}.mlp.{layers[layer]}.{kind}"] = value
        elif name.startswith("blocks."):
            made[re.sub(r"\.ls(\d)\.gamma$", r".layer_scale\1.lambda1", block)] = value
        else:
            stem = name.replace("patch_embed.proj", "patch_embeddings").replace(
                "storage", "register"
            )
            made[name if name.startswith("norm.") else f"embeddings.{stem}"] = value
    made["embeddings.mask_token"] = made["embeddings.mask_token"][None]
    return made


def dinov3_as_timm(tensors: Tensors, *, bias: bool = True) -> Tensors:
    words = {"storage_tokens": "reg_token", "ls1.gamma": "gamma_1", "ls2.gamma": "gamma_2"}
    words |= {"mlp.w1": "mlp.fc1_g", "mlp.w2": "mlp.fc1_x", "mlp.w3": "mlp.fc2"}
    made: Tensors = OrderedDict()
    for name, value in tensors.items():
        if name.endswith("qkv.bias") and bias:
            made[name.replace("qkv.bias", "q_bias")] = value.chunk(3)[0].clone()
            made[name.replace("qkv.bias", "v_bias")] = value.chunk(3)[2].clone()
        elif not name.endswith((".periods", "bias_mask", "mask_token", "qkv.bias")):
            made[re.sub("|".join(words), lambda found: words[found[0]], name)] = value
    return made


def written(folder: Path, tensors: Tensors) -> Path:
    """A file of safetensors, as other programs publish."""
    save_file({name: value.contiguous() for name, value in tensors.items()}, folder / "file.st")
    return folder / "file.st"


FORMS: list[
    tuple[int, dict[str, Any], Callable[[], Tensors], Callable[[Tensors], Tensors], str]
] = [
    *(
        (2, {"num_registers": n}, lambda n=n: dinov2_file(n), dinov2_as_timm, " of timm")
        for n in (0, 4)
    ),
    *(
        (3, {"mlp": mlp}, lambda mlp=mlp: dinov3_file(mlp), form, what)
        for mlp in ("gelu", "swiglu")
        for form, what in ((as_hugging_face, " of Hugging Face"), (dinov3_as_timm, " of timm"))
    ),
]


@pytest.mark.parametrize(("generation", "changes", "file", "form", "what"), FORMS)
@torch.no_grad()
def test_every_form_of_a_transformer_gives_equal_outputs(
    tmp_path: Path, generation: int, changes: Any, file: Any, form: Any, what: str
) -> None:
    tensors, first, second = file(), dino(generation, **changes), dino(generation, **changes)
    before = {name: value.clone() for name, value in second.state_dict().items()}
    plan = load_weights(first, saved(tmp_path, tensors))
    other = load_weights(second, written(tmp_path, form(tensors)))
    title = f"DINOv{generation} vision transformer"
    assert (plan.kind.title, other.kind.title) == (title, title + what)
    assert plan.num_set == sum(not name.endswith("bias_mask") for name in tensors)
    own, theirs = first.state_dict(), second.state_dict()
    for name, value in tensors.items():
        key = ENCODER + name.replace("storage_tokens", "register_tokens")
        assert name.endswith("bias_mask") or torch.equal(own[key], value), name
        assert not key.endswith("qkv.bias") or torch.equal(theirs[key], value), name
    for name, value in theirs.items():
        if not name.startswith(ENCODER) or name in other.fresh:
            assert torch.equal(value, before[name]), name
    pair = images(1)
    for view in ("rgbt", "rgb", "thermal"):
        assert torch.equal(*(net(*pair, views=(view,)).logits for net in (first, second)))
    own[f"{ENCODER}cls_token"].add_(1.0)  # the class token does count
    assert not torch.equal(first(*pair).logits, second(*pair).logits)


def test_what_files_of_dinov3_may_hold(tmp_path: Path) -> None:
    net, tensors = dino(3), dinov3_file()
    load_weights(net, written(tmp_path, dinov3_as_timm(tensors, bias=False)))
    assert not any(block.attn.qkv.bias.any() for block in net.backbone.encoder.blocks)
    # The published files hold periods rounded to bfloat16.
    tensors["rope_embed.periods"] = torch.tensor([1.0, 9.0])
    load_weights(net, saved(tmp_path, tensors))
    assert net.backbone.encoder.rope_embed.periods.tolist() == [1.0, 9.0]


K_BIAS = "layer.0.attention.k_proj.bias"
STRICT: list[tuple[int, Any, str]] = [
    *((3, as_hugging_face, f"layer.1.{each}") for each in (
        "attention.k_proj.weight", "attention.v_proj.bias", "layer_scale2.lambda1",
    )),
    (3, as_hugging_face, K_BIAS),  # the network has none, so that its values would be lost
    (3, dinov3_as_timm, "blocks.1.attn.q_bias"),
    *((generation, OrderedDict, each) for generation in (2, 3)
      for each in ("blocks.1.ls2.gamma", "blocks.2.ls2.gamma")),
]  # fmt: skip


@pytest.mark.parametrize(("generation", "form", "name"), STRICT)
def test_files_of_transformers_are_read_strictly(
    tmp_path: Path, generation: int, form: Any, name: str
) -> None:
    net, tensors = dino(generation), form(dinov3_file() if generation == 3 else dinov2_file(4))
    tensors.pop(name) if name in tensors else tensors.update({name: torch.ones(16)})
    before = {key: value.clone() for key, value in net.state_dict().items()}
    with pytest.raises(InputError, match="does not fit this network"):
        load_weights(net, written(tmp_path, tensors))
    assert all(torch.equal(value, before[key]) for key, value in net.state_dict().items())


def test_files_of_another_generation_or_registers_are_refused(tmp_path: Path) -> None:
    second, third = dinov2_file(4), dinov3_file()
    others: list[tuple[nn.Module, list[Tensors]]] = [
        (dino(2), [third, as_hugging_face(third), dinov3_as_timm(third), dinov2_file(0)]),
        (dino(2, num_registers=0), [second, dinov2_as_timm(second)]),
        (dino(3), [second, dinov2_as_timm(second)]),
        (network("mask2former_tiny"), [second, third]),
    ]
    for net, files in others:
        for tensors in files:
            assert recognised(read(path := written(tmp_path, tensors))).startswith("DINOv")
            with pytest.raises(InputError):
                load_weights(net, path)
