"""Files that recipes start from: the table, and Swin Transformers in the names of timm."""

from __future__ import annotations

import hashlib
import re
from collections import OrderedDict
from fnmatch import fnmatchcase
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from rgbt.checkpoints.layout import family_named
from rgbt.checkpoints.load import load_weights
from rgbt.checkpoints.read import read
from rgbt.checkpoints.recognise import recognise
from rgbt.checkpoints.starts import DIGITS, RECIPES, STARTS
from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.config.compose import available, compose
from rgbt.requirements import record_of
from rgbt.weights import entry
from tests.checkpoints.files import network, saved
from tests.checkpoints.imagenet import mit_file, resnet_file, swin_file
from tests.commands import Call

SIZES = {"embed_dim": 32, "depths": [1, 1, 2, 1], "num_heads": [1, 2, 4, 8], "window_size": 5}
RGB, THERMAL = "backbone.RGB_branch.", "backbone.THR_branch."


def as_timm(model: nn.Module) -> OrderedDict[str, Tensor]:
    """What timm would save for the RGB branch, written with timm's stages in mind.

    timm builds a stage as an optional merging and then its blocks: stage 0 has no merging, stage s
    has the one between s - 1 and s. It has one normalisation at the end and a classifier `head.fc`.
    """
    own = {k.removeprefix(RGB): v for k, v in model.state_dict().items() if k.startswith(RGB)}
    saved_so: OrderedDict[str, Tensor] = OrderedDict()
    for end in ("proj.weight", "proj.bias", "norm.weight", "norm.bias"):
        saved_so[f"patch_embed.{end}"] = own[f"patch_embed.{end}"].clone()
    for stage in range(4):
        if stage > 0:
            for end in ("norm.weight", "norm.bias", "reduction.weight"):
                merging = own[f"layers.{stage - 1}.downsample.{end}"]
                saved_so[f"layers.{stage}.downsample.{end}"] = merging.clone()
        for name, value in own.items():
            if name.startswith(f"layers.{stage}.blocks.") and "index" not in name:
                saved_so[name] = value.clone()
    last = saved_so["layers.3.blocks.0.norm1.weight"].shape[0]
    saved_so |= {"norm.weight": torch.ones(last), "norm.bias": torch.zeros(last)}
    return saved_so | {"head.fc.weight": torch.zeros(10, last), "head.fc.bias": torch.zeros(10)}


def filled(seed: int) -> nn.Module:
    """A network whose every parameter differs."""
    generator = torch.Generator().manual_seed(seed)
    model = network("mask2former_tiny", **SIZES)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator))
    return model


@pytest.mark.parametrize("buffers", [False, True])
def test_timm_swin_is_loaded_into_both_branches(tmp_path: Path, buffers: bool) -> None:
    """Files of early 2023 hold indices and masks as well; later ones do not."""
    source, model = filled(0), filled(1)
    tensors = as_timm(source)
    if buffers:
        tensors["layers.0.blocks.0.attn.relative_position_index"] = torch.zeros(25, 25).long()
        tensors["layers.2.blocks.1.attn_mask"] = torch.zeros(4, 25, 25)
    report = load_weights(model, saved(tmp_path, tensors))
    assert report.facts.what == "ImageNet Swin Transformer of timm"
    before, after = source.state_dict(), model.state_dict()
    for name in (key.removeprefix(RGB) for key in before if key.startswith(RGB)):
        if re.match(r"mask_token|norm\d\.", name):  # not in the file
            continue
        assert torch.equal(after[RGB + name], before[RGB + name]), name
        if name != "patch_embed.proj.weight":
            assert torch.equal(after[THERMAL + name], before[RGB + name]), name
    stem = before[f"{RGB}patch_embed.proj.weight"].mean(1, keepdim=True)
    assert torch.allclose(after[f"{THERMAL}patch_embed.proj.weight"], stem, atol=1e-6)


@pytest.mark.parametrize("change", ["missing", "both", "swapped"])
def test_timm_swin_is_loaded_strictly(tmp_path: Path, change: str) -> None:
    tensors = as_timm(filled(0))
    merging = "layers.{}.downsample.reduction.weight"
    if change == "missing":
        del tensors[merging.format(2)]
    elif change == "both":
        tensors[merging.format(0)] = tensors[merging.format(1)].clone()
    else:
        first, second = merging.format(1), merging.format(2)
        tensors[first], tensors[second] = tensors[second], tensors[first]
    model = filled(1)
    before = {key: value.clone() for key, value in model.state_dict().items()}
    with pytest.raises(InputError, match="does not fit this network"):
        load_weights(model, saved(tmp_path, tensors))
    assert all(torch.equal(value, before[key]) for key, value in model.state_dict().items())


def test_digests_are_those_in_the_names_of_the_files() -> None:
    for start in STARTS:
        in_name = re.search(rf"-([0-9a-f]{{{DIGITS}}})\.pth$", start.file)
        assert in_name is None or in_name[1] == start.digest
        assert start.digest == "" or re.fullmatch(rf"[0-9a-f]{{{DIGITS}}}", start.digest)
    assert len({start.file for start in STARTS}) == len(STARTS)


def test_files_fit_the_networks_that_the_table_names(tmp_path: Path) -> None:
    """Files of these sizes, made without our networks, are recognised as of these networks."""
    depths, heads = (2, 2, 6, 2), (3, 6, 12, 24)
    for file, tensors in {
        "swin_tiny_patch4_window7_224.pth": swin_file(96, depths, heads, 7),
        "mit_b2.pth": mit_file((64, 128, 320, 512), (3, 4, 6, 3)),
        "resnet18-f37072fd.pth": resnet_file(18),
    }.items():
        (start,) = (each for each in STARTS if each.file == file)
        facts = recognise(read(saved(tmp_path, tensors)))
        assert tuple(fits[0].removeprefix("model=") for fits in facts.fits) == start.models


@pytest.mark.slow
def test_every_experiment_has_one_recipe() -> None:
    """Its network at scale=paper is one that the files of the recipe fit, if it takes a file."""
    starts = {start.file: start for start in STARTS}
    for name in available("experiment"):
        if name.startswith("start_"):  # of scale=bench alone
            continue
        (recipe,) = (r for r in RECIPES if any(fnmatchcase(name, each) for each in r.experiments))
        config = compose([f"+experiment={name}", "scale=paper"])
        family = family_named(config.model._target_)
        with torch.device("meta"):
            takes = config.scale.pretrained and record_of(build(config.model)).pretrained_parts
        assert bool(recipe.files) == bool(takes), name
        models = {model for file in recipe.files for model in starts[file].models}
        found = [compose([f"model={model}", "scale=paper"]).model for model in sorted(models)]
        sizes = ("depths", "embed_dim", "layers", "dims")
        assert not found or any(
            family_named(each._target_) == family
            and all(each.get(key) == config.model.get(key) for key in sizes)
            for each in found
        ), name


def test_inspect_names_recipes_and_compares_the_digest(tmp_path: Path, call: Call) -> None:
    depths, heads = (2, 2, 6, 2), (3, 6, 12, 24)
    path = tmp_path / "swin_tiny_patch4_window7_224.pth"
    torch.save({"model": swin_file(96, depths, heads, 7)}, path)
    code, out, _ = call(entry, "inspect", str(path))
    assert code == 0
    lines = dict(line.split(None, 1) for line in out.splitlines()[:16] if line[:1].isalpha())
    assert lines["recipes"].startswith("baseline, crm, crm_kp, ")
    assert lines["recipes"].endswith("(with model=mask2former_swin_t pretrained=FILE)")
    assert "heatnet" not in lines["recipes"]
    assert lines["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    # Same name, other content.
    assert lines["remark"].startswith("not the published swin_tiny_patch4_window7_224.pth, whose")


def test_windows_of_another_size_fit_no_recipe(tmp_path: Path, call: Call) -> None:
    path = saved(tmp_path, swin_file(128, (2, 2, 18, 2), (4, 8, 16, 32), 12))
    _, out, _ = call(entry, "inspect", str(path))
    assert "recipes" not in out
