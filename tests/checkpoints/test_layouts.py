"""Every layout: what a file is taken for, and where each of its tensors goes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.checkpoints.layout import Facts, shapes_of
from rgbt.checkpoints.load import load_weights, plan_for
from rgbt.checkpoints.networks import share_start
from rgbt.checkpoints.plan import Plan
from rgbt.checkpoints.read import read
from rgbt.checkpoints.recognise import recognise
from rgbt.checkpoints.report import count_parameters
from rgbt.checks import InputError
from tests.checkpoints.files import holds, like, named, network, released, saved
from tests.checkpoints.imagenet import mit_file, resnet_file, swin_file
from tests.models import golden
from tests.models.golden import requires_golden

CMX = ("model/inputs=cmx_released", "model.decoder_norm_eps_eval=1e-5")
RELEASES = {
    # name of the record: yaml, what it is, overrides beside the yaml's, classes, parameters, names
    # that are left over: an index per block of both branches and the loss's class weights of CRM
    "crm_swin_t": (
        *("mask2former_swin_t", "checkpoint of CRM or SpatialSeg (Swin-T, 9 classes)"),
        *((), 9, 74_917_000, 25),
    ),
    "crm_swin_s": (
        *("mask2former_swin_s", "checkpoint of CRM or SpatialSeg (Swin-S, 9 classes)"),
        *((), 9, None, 49),
    ),
    "cmx_mit_b0": ("cmx_b0", "CMX checkpoint (MiT-B0, 9 classes)", CMX, 9, 12_114_641, 0),
    "cmx_mit_b2": ("cmx_b2", "CMX checkpoint (MiT-B2, 9 classes)", CMX, 9, 66_565_521, 0),
    "cmnext/cmnext_b0": (
        *("cmnext_b0", "CMNeXt checkpoint (MiT-B0, 9 classes)", (), 9, 10_287_337, 0),
    ),
    "cmnext/cmnext_b2": (
        *("cmnext_b2", "CMNeXt checkpoint (MiT-B2, 9 classes)", (), 9, 58_686_017, 0),
    ),
    "temporal_cmx_b2": (
        *("cmx_b2", "CMX checkpoint of the temporal release (MiT-B2, 9 classes)"),
        *(("model/inputs=temporal",), 9, 66_566_988, 2),
    ),
    "rtfnet_50": ("rtfnet_50", "RTFNet checkpoint (ResNet-50, 9 classes)", (), 9, 185_238_501, 0),
    "mfnet": ("mfnet", "MFNet checkpoint (9 classes)", (), 9, 736_275, 0),
    "heatnet": (
        *("heatnet", "HeatNet checkpoint (ResNet-50, 13 classes)"),
        *((), 13, 54_361_040 + 2_774_977, 10),  # and its discriminator
    ),
}
"""The parameters are published or counted ones; of Swin-T four digits are known."""

FAST = ("cmx_mit_b0", "cmnext/cmnext_b0", "mfnet", "heatnet")

WRAPPED = {
    "crm_swin_t": lambda state: {"epoch": 1, "state_dict": state, "hyper_parameters": {}},
    "cmx_mit_b2": lambda state: {"model": state, "optimizer": {}, "epoch": 1, "iteration": 2},
    "cmnext/cmnext_b0": lambda state: {
        **{"epoch": 301, "model_state_dict": state, "optimizer_state_dict": {"state": {}}},
        **{"loss": 0.1, "scheduler_state_dict": {}, "best_miou": 59.9},
    },
    "cmnext/cmnext_b2": lambda state: OrderedDict((f"module.{key}", state[key]) for key in state),
    "heatnet": lambda state: OrderedDict((f"module.{key}", state[key]) for key in state),
}


SLOW = pytest.mark.slow


def planned(model: nn.Module, path: Path, fresh: tuple[str, ...] = ()) -> tuple[Facts, Plan]:
    facts, plan, _ = plan_for(model, read(path), fresh)
    return facts, plan


def on_paper(yaml: str, num_classes: int = 9, **changed: Any) -> nn.Module:
    """A network without memory for its weights."""
    with torch.device("meta"):
        return golden.network(yaml, num_classes, **changed)


def slow_but(fast: Iterable[Any], names: Iterable[Any]) -> list[Any]:
    """Parameters of a test, but for some for the slow suite: big networks take seconds to build."""
    return [name if name in fast else pytest.param(name, marks=SLOW) for name in names]


@requires_golden
@pytest.mark.parametrize("name", slow_but(FAST, RELEASES))
def test_released_networks_are_recognised_and_used_up(tmp_path: Path, name: str) -> None:
    yaml, title, fits, classes, parameters, leftover = RELEASES[name]
    state = released(name)
    if parameters:
        on_meta = {key: torch.empty_like(value, device="meta") for key, value in state.items()}
        tolerance = 1e-4 if "swin" in name else 0
        assert count_parameters(on_meta) == pytest.approx(parameters, rel=tolerance)
    path = saved(tmp_path, WRAPPED.get(name, OrderedDict)(state))
    model = on_paper(yaml, classes)
    facts, plan = planned(model, path)
    assert facts.title == title
    assert facts.fits[0] == (f"model={yaml}", *fits)
    assert plan.fits
    assert (plan.fresh, plan.zeros) == ({}, [])
    assert plan.values.keys() == model.state_dict().keys()
    assert len(plan.leftover) == leftover
    assert len(plan.values) + len(plan.leftover) == len(state)


@requires_golden
def test_released_weights_of_mfnet_begin_their_counters_at_0() -> None:
    from tests.models.golden import SHARED

    path = SHARED / "realdata/mfnet_weights/final.pth"
    model = network("mfnet")
    report = load_weights(model, path)
    assert (report.num_set, report.num_zeros, report.num_entries) == (228, 38, 266)
    expected = torch.load(path, map_location="cpu", weights_only=True)
    state = model.state_dict()
    assert all(torch.equal(state[key], expected[key]) for key in expected)
    assert all(value == 0 for key, value in state.items() if key.endswith("num_batches_tracked"))
    assert count_parameters(read(path).tensors) == 736_275


SWINS = {
    "Swin-T": (96, (2, 2, 6, 2), (3, 6, 12, 24), "mask2former_swin_t"),
    "Swin-S": (96, (2, 2, 18, 2), (3, 6, 12, 24), "mask2former_swin_s"),
    "Swin-B": (128, (2, 2, 18, 2), (4, 8, 16, 32), "mask2former_swin_b"),
}


@pytest.mark.parametrize(
    "size", ["Swin-T", *(pytest.param(f"Swin-{size}", marks=SLOW) for size in "SB")]
)
def test_imagenet_swin_fills_both_branches(tmp_path: Path, size: str) -> None:
    width, depths, heads, yaml = SWINS[size]
    tensors = swin_file(width, depths, heads, 7)
    path = saved(tmp_path, {"model": tensors})
    model = on_paper(yaml)
    facts, plan = planned(model, path)
    assert facts.title == f"ImageNet Swin Transformer ({size})"
    assert facts.fits == ((f"model={yaml}",),)
    assert facts.window == 7
    assert plan.fits

    blocks = sum(depths)
    # Every block of a branch has 13 parameters, and each branch 4 of the embedding, 9 of merging.
    assert len(plan.values) == 2 * (13 * blocks + 4 + 9)
    assert set(plan.fresh) == {
        key
        for key in model.state_dict()
        if key.startswith(("sem_seg_head.", "backbone.norm_layers."))
        or key.split(".")[2] in ("mask_token", "norm0", "norm1", "norm2", "norm3")
    }
    masks = [name for name in plan.leftover if name.endswith("attn_mask")]
    assert len(masks) == sum(depth // 2 for depth in depths[:3])
    assert {n for n in plan.leftover if n.split(".")[0] in ("norm", "head")} == {
        *("norm.weight", "norm.bias", "head.weight", "head.bias")
    }
    assert len(plan.leftover) == len(masks) + 4 + blocks
    for branch in ("RGB", "THR"):
        entry = f"backbone.{branch}_branch.layers.2.blocks.1.attn.qkv.weight"
        assert plan.values[entry] == "layers.2.blocks.1.attn.qkv.weight"


SWIN_SIZES = {"embed_dim": 32, "depths": [1, 1, 2, 1], "num_heads": [1, 2, 4, 8], "window_size": 5}


def tiny_swin() -> OrderedDict[str, Tensor]:
    return swin_file(32, (1, 1, 2, 1), (1, 2, 4, 8), 5, labels=10)


def test_imagenet_swin_is_loaded_into_both_branches(tmp_path: Path) -> None:
    model, tensors = network("mask2former_tiny", **SWIN_SIZES), tiny_swin()
    stem = torch.arange(32 * 3 * 16.0).reshape(32, 3, 4, 4)
    tensors["patch_embed.proj.weight"] = stem
    before = {key: value.clone() for key, value in model.state_dict().items()}
    load_weights(model, saved(tmp_path, {"model": tensors}))
    after = model.state_dict()
    rgb, thermal = "backbone.RGB_branch.", "backbone.THR_branch."
    assert torch.equal(after[f"{rgb}patch_embed.proj.weight"], stem)
    found = after[f"{thermal}patch_embed.proj.weight"]
    assert found.shape == (32, 1, 4, 4)
    assert torch.allclose(found[:, 0], (stem[:, 0] + stem[:, 1] + stem[:, 2]) / 3)
    for name in tensors:
        if name.startswith("layers.") and f"{rgb}{name}" in after:
            assert holds(after[f"{rgb}{name}"], name)
            assert holds(after[f"{thermal}{name}"], name)
    for key in after:
        if key.startswith("sem_seg_head.") or ".norm3." in key or key.endswith("mask_token"):
            assert torch.equal(after[key], before[key]), key


MITS = {
    "b0": ((32, 64, 160, 256), (2, 2, 2, 2)),
    "b1": ((64, 128, 320, 512), (2, 2, 2, 2)),
    "b2": ((64, 128, 320, 512), (3, 4, 6, 3)),
    "b3": ((64, 128, 320, 512), (3, 4, 18, 3)),
    "b4": ((64, 128, 320, 512), (3, 8, 27, 3)),
    "b5": ((64, 128, 320, 512), (3, 6, 40, 3)),
}


@pytest.mark.parametrize("size", slow_but(("b0",), MITS))
def test_imagenet_mit_fills_both_streams(tmp_path: Path, size: str) -> None:
    tensors = mit_file(*MITS[size])
    model = on_paper(f"cmx_{size}")
    facts, plan = planned(model, saved(tmp_path, tensors))
    assert facts.title == f"ImageNet MiT (MiT-{size.upper()})"
    assert facts.fits == ((f"model=cmx_{size}",), (f"model=cmnext_{size}",))
    assert plan.fits
    assert set(plan.leftover) == {"head.weight", "head.bias"}
    assert len(plan.values) == 2 * (len(tensors) - 2)
    streams = [key for key in model.state_dict() if not key.startswith(("decode_head.",))]
    assert {*plan.values} == {k for k in streams if not k.startswith(("backbone.F",))}
    for entry, name in plan.values.items():
        # The release's rule: the first of the three words that a name contains is preceded.
        word = next(w for w in ("patch_embed", "block", "norm") if w in name)
        both = (f"backbone.{name}", f"backbone.{name.replace(word, f'extra_{word}', 1)}")
        assert entry in both


def test_imagenet_mit_is_loaded_into_both_streams(tmp_path: Path) -> None:
    tensors = mit_file((16, 32, 64, 96), (1, 1, 1, 1))
    sizes = {"embed_dims": [16, 32, 64, 96], "depths": [1, 1, 1, 1], "num_heads": [1, 2, 4, 6]}
    model = network("cmx_tiny", **sizes)
    load_weights(model, saved(tmp_path, {"model": tensors}))
    state = model.state_dict()
    for name in ("patch_embed1.proj.weight", "block3.0.attn.sr.weight", "norm4.bias"):
        assert holds(state[f"backbone.{name}"], name)
        assert holds(state[f"backbone.extra_{name}"], name)


@pytest.mark.parametrize("layers", slow_but((18,), (18, 34, 50, 101, 152)))
def test_resnets_fill_both_encoders_of_rtfnet(tmp_path: Path, layers: int) -> None:
    tensors = resnet_file(layers)
    model = on_paper(f"rtfnet_{layers}")
    facts, plan = planned(model, saved(tmp_path, tensors))
    assert facts.title == f"ImageNet ResNet (ResNet-{layers})"
    assert facts.fits[0] == (f"model=rtfnet_{layers}",)
    assert plan.fits
    assert set(plan.leftover) == {"fc.weight", "fc.bias"}
    assert len(plan.values) == 2 * (len(tensors) - 2)
    assert all(key.startswith("deconv") for key in plan.fresh)
    assert len(plan.fresh) + len(plan.values) == len(model.state_dict())


def rtfnet(thermal_stem: str) -> nn.Module:
    return network("rtfnet_18", base_width=4, thermal_stem=thermal_stem)


def test_the_thermal_stem_of_rtfnet_is_the_mean_or_drawn_anew(tmp_path: Path) -> None:
    tensors = resnet_file(18, counters=False, width=4)
    stem = torch.arange(4 * 3 * 49.0).reshape(4, 3, 7, 7)
    tensors["conv1.weight"] = stem
    path = saved(tmp_path, tensors)
    released_stem, drawn = rtfnet("rgb_mean"), rtfnet("xavier")
    before = drawn.state_dict()["encoder_thermal_conv1.weight"].clone()
    report = load_weights(released_stem, path)
    load_weights(drawn, path)
    assert torch.equal(
        released_stem.state_dict()["encoder_thermal_conv1.weight"], stem.mean(1, keepdim=True)
    )
    assert torch.equal(released_stem.state_dict()["encoder_rgb_conv1.weight"], stem)
    assert torch.equal(drawn.state_dict()["encoder_thermal_conv1.weight"], before)
    assert torch.equal(drawn.state_dict()["encoder_rgb_conv1.weight"], stem)
    counters = [key for key in released_stem.state_dict() if key.endswith("num_batches_tracked")]
    assert report.num_zeros == sum(key.startswith("encoder_") for key in counters)


@pytest.mark.parametrize("modalities", ["late_fusion", "early_fusion", "rgb", "thermal"])
def test_a_resnet_fills_the_encoder_of_pspnet(tmp_path: Path, modalities: str) -> None:
    tensors = resnet_file(50, width=8)
    stem = torch.arange(8 * 3 * 49.0).reshape(8, 3, 7, 7)
    tensors["conv1.weight"] = stem
    model = network("heatnet", 13, modalities=modalities, base_width=8)
    path = saved(tmp_path, tensors)
    _, plan = planned(model, path)
    assert plan.fits
    load_weights(model, path)
    state = model.state_dict()
    mean = stem.mean(1, keepdim=True)
    expected = {
        "late_fusion": (stem, mean),
        "early_fusion": (torch.cat([stem, mean], 1),),
        "rgb": (stem,),
        "thermal": (mean,),
    }[modalities]
    for end, value in zip(("", "_2"), expected, strict=False):
        assert torch.equal(state[f"feats.conv1{end}.weight"], value)
        name = "layer2.3.conv2.weight"
        assert holds(state[f"feats.layer2{end}.3.conv2.weight"], name)
    assert holds(state["feats.layer4.2.bn3.running_var"], "layer4.2.bn3.running_var")
    two = modalities == "late_fusion"
    projection = {name for name in plan.leftover if name.startswith("layer3.0.")}
    assert len(projection) == (7 if two else 0)  # conv1, and 6 of the projection
    assert ("feats.layer3.0.conv1.weight" in plan.fresh) == two


def test_the_deep_stem_of_semseg_is_filled_by_its_own_file_alone(tmp_path: Path) -> None:
    """resnet50_v2.pth: conv1 to conv3 and bn1 to bn3 before the stages."""
    tensors = resnet_file(50, width=8)
    norm = ("weight", "bias", "running_mean", "running_var")
    sizes = {"conv1": (8, 3), "conv2": (8, 8), "conv3": (16, 8)}
    deep = {f"{name}.weight": (*size, 3, 3) for name, size in sizes.items()}
    deep |= {f"bn{n}.{end}": (8 * (1 + n // 3),) for n in (1, 2, 3) for end in norm}
    deep |= {f"layer1.0.{name}.weight": size for name, size in (
        ("conv1", (8, 16, 1, 1)), ("downsample.0", (32, 16, 1, 1)),
    )}  # fmt: skip
    model = network("semseg_tiny", 14, depths="[3,4,6,3]")
    facts, plan = planned(model, saved(tmp_path, {**tensors, **named(deep)}))
    assert facts.fits == (("model=semseg",),)
    assert plan.fits
    places = {"0": "conv1", "1": "bn1", "3": "conv2", "4": "bn2", "6": "conv3", "7": "bn3"}
    for number, name in places.items():
        assert plan.values[f"layer0.{number}.weight"] == f"{name}.weight"
    assert plan.values["layer3.5.conv2.weight"] == "layer3.5.conv2.weight"
    assert {name.split(".")[0] for name in plan.fresh} == {"ppm", "cls", "aux"}
    assert set(plan.leftover) == {"fc.weight", "fc.bias"}
    for yaml, other in (("semseg_tiny", tensors), ("heatnet_tiny", {**tensors, **named(deep)})):
        with pytest.raises(InputError):
            load_weights(network(yaml, 14), saved(tmp_path, other))


def test_resnets_fill_the_backbone_of_deeplab(tmp_path: Path) -> None:
    model = on_paper("deeplabv2", 14)
    facts, plan = planned(model, saved(tmp_path, resnet_file(101)))
    assert ("model=deeplabv2",) in facts.fits
    assert plan.fits
    assert len(plan.values) == len([k for k in model.state_dict() if k.startswith("backbone.")])

    tensors = resnet_file(101, counters=False, prefix="Scale.")
    classifier = {f"Scale.layer5.conv2d_list.{n}.weight": (21, 2048, 3, 3) for n in range(4)}
    facts, plan = planned(model, saved(tmp_path, {**tensors, **named(classifier)}))
    assert facts.title == "DeepLab v2 start of AdaptSegNet and ADVENT (ResNet-101)"
    assert facts.fits == (("model=deeplabv2", "model/inputs=caffe"),)
    assert plan.fits
    assert set(plan.leftover) == set(classifier)
    assert plan.values["backbone.layer3.22.conv3.weight"] == "Scale.layer3.22.conv3.weight"
    assert all(key.startswith("heads.") for key in plan.fresh)


WHOLE = [
    ("mask2former_tiny", "network.", "checkpoint of CRM or SpatialSeg"),
    ("cmx_tiny", "", "CMX checkpoint"),
    ("rtfnet_tiny", "", "RTFNet checkpoint"),
    ("mfnet_tiny", "", "MFNet checkpoint"),
    ("heatnet_tiny", "module.trgb_segnet.", "HeatNet checkpoint"),
    ("semseg_tiny", "module.", "PSPNet checkpoint of semseg"),
]


@pytest.mark.parametrize(("yaml", "prefix", "what"), WHOLE)
def test_whole_networks_of_any_size_are_loaded_equal(
    tmp_path: Path, yaml: str, prefix: str, what: str
) -> None:
    model = network(yaml)
    path = saved(tmp_path, {"state_dict": like(model.state_dict(), prefix)})
    report = load_weights(model, path)
    assert report.facts.what == what
    assert report.facts.classes == 9
    assert report.num_set == report.num_entries
    for key, value in model.state_dict().items():
        assert holds(value, prefix + key), key


def test_what_a_configuration_in_the_file_says_is_suggested(tmp_path: Path) -> None:
    import argparse

    shapes = shapes_of(swin_file(96, (2, 2, 6, 2), (3, 6, 12, 24), 7))
    branches = ("network.backbone.RGB_branch.", "network.backbone.THR_branch.")
    tensors = {
        **named({f"{b}{name}": shape for b in branches for name, shape in shapes.items()}),
        "network.sem_seg_head.predictor.class_embed.weight": torch.ones(13, 2),
        **dict.fromkeys((f"{each}mask_token" for each in branches), torch.ones(1, 96, 1, 1)),
    }
    hyper = {"cfg": argparse.Namespace(MODEL={"FUSION": {"AGGREGATION": "ADD"}})}
    path = saved(tmp_path, {"state_dict": tensors, "hyper_parameters": hyper})
    facts = recognise(read(path))
    assert facts.classes == 12
    wanted = ("model=mask2former_swin_t", "model.fusion=add", "model.mask_token=shared")
    assert facts.fits == (wanted,)


def test_shared_stages_are_seen_in_the_file(tmp_path: Path) -> None:
    model = network("mask2former_tiny", share_start=2)
    path = saved(
        tmp_path, {"state_dict": {f"network.{k}": v for k, v in model.state_dict().items()}}
    )
    assert share_start(read(path)) == 2
