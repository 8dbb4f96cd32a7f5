"""``rgbt weights``: inspect and export, as they are called."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
import yaml

from rgbt.weights import entry
from tests.checkpoints.files import like, network, saved
from tests.checkpoints.imagenet import resnet_file
from tests.commands import Call
from tests.models.golden import SHARED


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a run of MFNet, as far as it matters here."""
    import hydra
    from omegaconf import OmegaConf

    from rgbt.config.compose import conf_dir

    folder = tmp_path / "runs" / "0123456789ab"
    folder.mkdir(parents=True)
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        config = hydra.compose("config", ["model=mfnet_tiny", "model.num_classes=9"])
    resolved = OmegaConf.to_container(config.model, resolve=True)
    (folder / "config.yaml").write_text(yaml.safe_dump({"model": resolved}))
    state = network("mfnet_tiny").state_dict()
    torch.save({"model": state, "step": 240}, folder / "best.pt")
    return folder


def test_inspect_a_released_file(call: Call) -> None:
    path = SHARED / "realdata/mfnet_weights/final.pth"
    if not path.exists():
        pytest.skip("reference material is not here")
    code, out, err = call(entry, "inspect", str(path))
    assert (code, err) == (0, "")
    lines = {line.split("  ")[0]: line for line in out.splitlines() if line[:1].isalpha()}
    assert lines["what"].endswith("MFNet checkpoint (9 classes)")
    assert lines["container"].endswith("torch.save")
    assert lines["tensors"].endswith("228 (float32)")
    assert lines["parameters"].endswith("736,275 (0.74 M)")
    assert lines["fits"].endswith("model=mfnet")
    assert "into model=mfnet model.num_classes=9" in out
    rows = [line.split() for line in out.splitlines()]
    assert ["set", "228"] in rows
    assert any(row[:4] == ["begin", "at", "0", "38"] for row in rows)


def test_inspect_a_backbone(tmp_path: Path, call: Call) -> None:
    path = saved(tmp_path, resnet_file(18))
    code, out, _ = call(entry, "inspect", str(path))
    assert code == 0
    assert "ImageNet ResNet (ResNet-18)" in out
    assert "into model=rtfnet_18" in out
    assert "unused" in out
    assert "ImageNet's classifier" in out
    assert "keep initial values" in out


def test_inspect_for_a_network_that_does_not_fit(tmp_path: Path, call: Call) -> None:
    path = saved(tmp_path, resnet_file(18))
    code, out, _ = call(entry, "inspect", str(path), "model=rtfnet_tiny")
    assert code == 1
    assert "DIFFERENT" in out
    code, _, err = call(entry, "inspect", str(path), "model=mfnet_tiny")
    assert code == 2
    assert "cannot be loaded into MFNet" in err


def test_inspect_a_part_that_is_named_fresh(tmp_path: Path, call: Call) -> None:
    path = saved(tmp_path, like(network("mfnet_tiny", 9).state_dict()))
    words = ("model=mfnet_tiny", "model.num_classes=5")
    code, out, _ = call(entry, "inspect", str(path), *words)
    assert (code, "DIFFERENT" in out) == (1, True)
    fresh = "model.fresh=[decode1]"
    code, out, _ = call(entry, "inspect", str(path), *words, fresh)
    assert code == 0
    assert "named in model.fresh" in out


def test_inspect_an_unknown_file(tmp_path: Path, call: Call) -> None:
    path = saved(tmp_path, {"layer.weight": torch.zeros(2, 3), "[bold]\x1b[2J": torch.zeros(1)})
    code, out, _ = call(entry, "inspect", str(path))
    assert code == 0
    assert "in an unknown layout" in out
    assert "layer.weight, [bold]?[2J" in out


def test_inspect_the_checkpoint_of_a_run(run: Path, call: Call) -> None:
    code, out, _ = call(entry, "inspect", str(run / "best.pt"))
    assert code == 0
    assert "checkpoint of a run, MFNet (9 classes)" in out
    assert f"into {run / 'config.yaml'}" in out


def test_a_configuration_beside_a_file_runs_nothing(run: Path, call: Call) -> None:
    marker = run / "marker"
    evil = {"_target_": "os.system", "command": f"touch {marker}"}
    imported = {**evil, "_target_": "rgbt.models.inputs.torch.os.system"}
    part = {"_target_": "rgbt.models.mfnet.MFNet"}
    for model in (evil, imported, {**part, "inputs": evil}, {**part, "inputs": imported}, 3):
        (run / "config.yaml").write_text(json.dumps({"model": model}))
        code, out, err = call(entry, "inspect", str(run / "best.pt"))
        assert code == 2
        assert "checkpoint of a run, MFNet" in out
        assert "'model" in err
        assert not marker.exists()


def test_export_and_inspect(run: Path, tmp_path: Path, call: Call) -> None:
    for layout, name in (("safetensors", "a.safetensors"), ("released", "final.pth")):
        words = (f"run={run.name}", f"runs_dir={run.parent}", f"format={layout}")
        out_file = tmp_path / name
        code, out, _ = call(entry, "export", *words, f"out={out_file}")
        assert (code, out) == (0, f"{out_file}\n")
        code, _, err = call(entry, "export", *words, f"out={out_file}")
        assert code == 2
        assert "already exists" in err
        code, out, _ = call(entry, "inspect", str(out_file), "model=mfnet_tiny")
        assert code == 0
        assert "MFNet" in out
    out = call(entry, "inspect", str(tmp_path / "a.safetensors"))[1]
    lines = dict(line.rsplit("  ", 1) for line in out.splitlines() if line.startswith("note "))
    said = {name.strip(): value for name, value in lines.items()}
    assert said["note step"] == "240"
    assert said["note run"] == run.name
    assert '"rgb_order": "rgb"' in said["note inputs"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "known: export, inspect"),
        (("inspct",), "did you mean 'inspect'?"),
        (("inspect",), "'file' has no value"),
        (("inspect", "missing.pth"), "missing.pth: no such file"),
        (("export", "run=x"), "'format' has no value"),
        (("export", "run=x", "format=released", "out=y"), "run=x"),
        (("export", "run=x", "format=released", "out=y", "modl=z"), "'modl' has no effect here"),
        (("export", "run=x", "format=released", "out=y", "checkpoint=first"), "checkpoint"),
    ],
)
def test_usage_errors(words: tuple[str, ...], said: str, call: Call) -> None:
    code, out, err = call(entry, *words)
    assert (code, out) == (2, "")
    assert said in err
    assert err.count("\n") == 1


def test_a_broken_configuration_beside_a_file_is_named(run: Path, call: Call) -> None:
    for text in ("[1, 2]", "model: [", "model: {a: '${b}'}"):
        (run / "config.yaml").write_text(text)
        code, _, err = call(entry, "inspect", str(run / "best.pt"))
        assert code == 2
        assert f"rgbt: {run / 'config.yaml'}" in err


def test_an_export_that_the_authors_code_feeds_otherwise_is_said(
    run: Path, tmp_path: Path, call: Call
) -> None:
    words = (f"run={run}", "format=released")
    _, _, err = call(entry, "export", *words, f"out={tmp_path / 'a.pth'}")
    assert "authors' code" not in err
    stored = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(
        stored.replace("final_activation: true", "final_activation: false")
    )
    _, _, err = call(entry, "export", *words, f"out={tmp_path / 'b.pth'}")
    assert "authors' code, which uses model.final_activation=true" in err
