"""``rgbt weights``: inspect and export, as they are called, and the table of published files."""

from __future__ import annotations

import hashlib
import json
import re
from fnmatch import fnmatchcase
from pathlib import Path

import pytest
import torch
import yaml

from rgbt.checkpoints.files import read
from rgbt.checkpoints.load import plan_for
from rgbt.config.compose import available
from rgbt.runs.starts import RECIPES, STARTS
from rgbt.weights import entry
from tests.checkpoints.files import network, saved
from tests.checkpoints.imagenet import mit_file, resnet_file, swin_file
from tests.commands import Call, edit_config
from tests.models import golden


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a run of MFNet, as far as it matters here."""
    folder = tmp_path / "runs" / "0123456789ab"
    folder.mkdir(parents=True)
    model = golden.alone("model/mfnet_tiny", "model.num_classes=9").model
    from omegaconf import OmegaConf

    plain = {"model": OmegaConf.to_container(model, resolve=True)}
    (folder / "config.yaml").write_text(yaml.safe_dump(plain))
    torch.save({"model": network("mfnet_tiny").state_dict(), "step": 240}, folder / "best.pt")
    return folder


def test_inspect_for_networks_that_fit_and_that_do_not(tmp_path: Path, call: Call) -> None:
    path = saved(tmp_path, resnet_file(18))
    code, out, _ = call(entry, "inspect", str(path))
    assert code == 0
    assert "ImageNet ResNet" in out
    code, out, _ = call(entry, "inspect", str(path), "model=rtfnet_18")
    assert code == 0
    assert "initial values (deconv1.0.conv1.weight" in out
    assert "unused in the file (fc.bias, fc.weight)" in out
    code, out, _ = call(entry, "inspect", str(path), "model=rtfnet_tiny")
    assert code == 1
    assert "does not fit this network" in out
    code, _, err = call(entry, "inspect", str(path), "model=mfnet_tiny")
    assert code == 2
    assert "(ImageNet ResNet) is no file of weights for MFNet" in err
    path = saved(tmp_path, {"layer.weight": torch.zeros(2, 3), "[bold]\x1b[2J": torch.zeros(1)})
    code, out, _ = call(entry, "inspect", str(path))
    assert (code, "unknown" in out, "layer.weight, [bold]?[2J" in out) == (0, True, True)


def test_inspect_the_checkpoint_of_a_run(run: Path, call: Call) -> None:
    code, out, _ = call(entry, "inspect", str(run / "best.pt"))
    assert code == 0
    assert re.search(r"what +file of rgbt", out)
    assert re.search(r"weights of .*best.pt .*: (\d+) of \1 entries set", out)


def test_a_configuration_beside_a_file_runs_nothing(run: Path, call: Call) -> None:
    marker = run / "marker"
    evil = {"_target_": "os.system", "command": f"touch {marker}"}
    part = {"_target_": "rgbt.models.mfnet.MFNet"}
    for model in (evil, {**part, "inputs": evil}, 3):
        (run / "config.yaml").write_text(json.dumps({"model": model}))
        code, _, err = call(entry, "inspect", str(run / "best.pt"))
        assert (code, "'model" in err, marker.exists()) == (2, True, False)
    for text in ("[1, 2]", "model: [", "model: {a: '${b}'}"):
        (run / "config.yaml").write_text(text)
        code, _, err = call(entry, "inspect", str(run / "best.pt"))
        assert (code, f"rgbt: {run / 'config.yaml'}" in err) == (2, True)


def test_export_and_inspect(run: Path, tmp_path: Path, call: Call) -> None:
    for layout, name in (("safetensors", "a.safetensors"), ("released", "final.pth")):
        words = (f"run={run.name}", f"runs_dir={run.parent}", f"format={layout}")
        words = (*words, f"out={tmp_path / name}")
        code, out, err = call(entry, "export", *words)
        assert (code, out, "authors' code" in err) == (0, f"{tmp_path / name}\n", False)
        assert "already exists" in call(entry, "export", *words)[2]
        assert call(entry, "inspect", str(tmp_path / name), "model=mfnet_tiny")[0] == 0
    out = call(entry, "inspect", str(tmp_path / "a.safetensors"))[1]
    assert re.search(r"note step +240\n", out)
    assert re.search(rf"note run +{run.name}\n", out)
    assert '"rgb_order": "rgb"' in out
    # The authors' code feeds or evaluates the network otherwise.
    edit_config(run, "final_activation: true", "final_activation: false")
    words = (f"run={run}", "format=released", f"out={tmp_path / 'b.pth'}")
    assert "which uses model.final_activation=true" in call(entry, "export", *words)[2]


def test_published_files_fit_the_networks_of_the_table(tmp_path: Path) -> None:
    """Digests are those in the names; files made without our networks fit all named ones."""
    for start in STARTS:
        in_name = re.search(r"-([0-9a-f]{8})\.pth$", start.file)
        assert in_name is None or in_name[1] == start.digest[:8]
        # All of the digest stands for a packaged file in the key of a run.
        length = 64 if start.package else 8
        assert re.fullmatch(rf"([0-9a-f]{{{length}}})?", start.digest)
    starts = {start.file: start for start in STARTS}
    assert len(starts) == len(STARTS)
    for file, tensors in {
        "swin_tiny_patch4_window7_224.pth": swin_file(96, (2, 2, 6, 2), (3, 6, 12, 24), 7),
        "mit_b2.pth": mit_file((64, 128, 320, 512), (3, 4, 6, 3)),
        "resnet18-f37072fd.pth": resnet_file(18),
        "DeepLab_resnet_pretrained_init-f81d91e8.pth": resnet_file(
            101, prefix="Scale.", more=["Scale.layer5.conv2d_list.0.weight"]
        ),
    }.items():
        contents = read(saved(tmp_path, tensors))
        for model in starts[file].models:
            with torch.device("meta"):
                assert plan_for(golden.network(model), contents).problems == []


def test_every_experiment_has_one_recipe() -> None:
    for name in available("experiment"):
        found = [r for r in RECIPES if any(fnmatchcase(name, pattern) for pattern in r.experiments)]
        assert len(found) == (not name.startswith("start_")), name  # those are of scale=bench


def test_inspect_names_recipes_and_compares_the_digest(tmp_path: Path, call: Call) -> None:
    path = tmp_path / "swin_tiny_patch4_window7_224.pth"
    torch.save({"w": torch.zeros(1)}, path)
    code, out, _ = call(entry, "inspect", str(path))
    assert code == 0
    lines = dict(line.split(None, 1) for line in out.splitlines())
    assert lines["recipes"].startswith("baseline, crm, crm_kp, ")
    assert lines["fits"] == "model=mask2former_swin_t"
    assert lines["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    # Same name, other content.
    assert lines["remark"].startswith("not the published swin_tiny_patch4_window7_224.pth, whose")
