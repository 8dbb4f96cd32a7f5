"""What comes from a store or a folder is data: nothing of it is imported or called unasked."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from rgbt.checks import InputError
from rgbt.config.component import Component, build
from rgbt.config.compose import available, compose
from rgbt.config.stored_config import (
    check_targets,
    parse_trust,
    settings_of,
    shipped_targets,
    targets,
)
from rgbt.files.yaml_files import parse_yaml
from rgbt.runs.specify import requested_run
from tests.commands import Call, assert_one_sentence

LAB = "import os\nfrom pathlib import Path\nPath(__file__).with_suffix('.imported').touch()\n" + (
    "from lab_base import Base\nclass Plain:\n    def __init__(self, *, width: int = 1) -> None:\n"
    "        self.width = width\n"
)


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Modules of a user's; `my_lab` leaves a file behind when it is imported."""
    (tmp_path / "my_lab.py").write_text(LAB)
    (tmp_path / "lab_base.py").write_text("class Base:\n    pass\n")
    (tmp_path / "rgbt_evil.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("my_lab", "lab_base"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return tmp_path


def node(target: Any) -> dict[str, Any]:
    return {"_target_": target}


OTHERS = [
    *("os.system", "posix.system", "builtins.eval", "subprocess.Popen", "hydra.utils.get_object"),
    *("rgbt.files.atomic.os.system", "rgbt.config.component.instantiate", "rgbt"),
    *("rgbt.files.atomic.write_atomic", "rgbt.runs.folder.RunFolder", "rgbt_evil.X", "rgbt_evil"),
    *("rgbt..os", ".rgbt.maskers.masker.Masker", "rgbt.", "", "rgbt.maskers.masker.Masker."),
    *("rgbt.maskers.masker.Masker.__init__", "Rgbt.maskers.masker", "rgbt.maskers.masker"),
    *("rgbt.maskers.masker.Masker ", "rgbt.maskers.masker.Maske\u0433", "x" * 5000),
    *("hydra_plugins.rgbt_study.StudySweeper", "\x1b[2Jos.system", ["os.system"]),
    *(3, None, True, {"a": "os.system"}, 10**30),
]


@pytest.mark.parametrize("target", OTHERS, ids=[str(target)[:40] for target in OTHERS])
def test_others_targets_are_refused_before_they_are_imported(lab: Path, target: Any) -> None:
    assert (lab / "rgbt_evil.py").is_file()
    for settings in (
        {"masker": node(target)},
        {"a": [{"b": [node(target)]}]},
        {"model": {**node("rgbt.models.mfnet.MFNet"), "inputs": node(target)}},
        {"model": {"_args_": [node(target)], "_partial_": True}},
    ):
        with pytest.raises(InputError, match=r"^store: '.*_target_' names ") as refused:
            check_targets(settings, (), "store")
        assert (str(refused.value).isprintable(), len(str(refused.value)) < 450) == (True, True)


def test_what_shipped_configurations_name_is_allowed() -> None:
    config = OmegaConf.to_container(compose(["+experiment=grbm"]), resolve=True)
    check_targets(config, (), "store")
    assert len(list(targets(config))) > 15
    assert shipped_targets("masker") == {"rgbt.maskers.masker.Masker"}
    with pytest.raises(InputError, match="which no file of conf/masker names"):
        check_targets({"masker": node("rgbt.data.kp.KP")}, (), "store", "masker")


def test_only_trusted_own_code_is_run(lab: Path) -> None:
    marker = lab / "my_lab.imported"
    with pytest.raises(InputError, match=r"add trust=my_lab\.$"):
        check_targets({"model": node("my_lab.Plain")}, ("my_la", "other"), "store")
    assert not marker.exists()
    check_targets({"model": node("my_lab.Plain")}, ("other", "my_lab"), "store")
    assert marker.exists()
    check_targets({"model": node("my_lab.Plain")}, ("my_lab.Plain",), "store")
    for name, reason in (
        *(("os.system", "blocklisted"), ("os.getpid", "defined in posix")),
        ("Base", "defined in lab_base"),
    ):
        with pytest.raises(InputError, match=reason):
            check_targets({"model": node(f"my_lab.{name}")}, ("my_lab",), "store")
    check_targets({"model": node("my_lab.Base")}, ("my_lab", "lab_base"), "store")


def test_trust_is_a_list_of_dotted_names() -> None:
    assert parse_trust("[my_lab, other.models]") == ("my_lab", "other.models")
    folders = ("my_lab", "/code/GMNet", "~/x", "./y", "../z")
    assert parse_trust(",".join(folders)) == folders
    for text in ("my lab", "a/b.py", "a..b", "a;b", "*"):
        with pytest.raises(InputError, match="^trust: expected names"):
            parse_trust(text)


@pytest.mark.parametrize("dataset", sorted({*available("dataset")} - {"folder", "video"}))
def test_every_data_set_has_a_run_whose_settings_are_read_again(dataset: str) -> None:
    """Also one whose labels are numbers by class (`dataset.ids`)."""
    words = ("+experiment=mfnet", f"dataset={dataset}", "scale=paper")
    run = requested_run(compose(words), words)
    assert len(run.key) == 12
    text = OmegaConf.to_yaml(OmegaConf.create(dict(run.plain)))
    assert settings_of(parse_yaml(text, "store"), "store") == run.plain


@pytest.mark.parametrize(
    ("plain", "reason"),
    [
        ([1], "expected a mapping"),
        ({"a": "${oc.env:HOME}"}, "'a' is an interpolation"),
        ({"a": [{"b": "x ${px:64}"}]}, "'a.0.b'"),
        ({"a": {1.5: 2}}, "is not text"),
        ({"model": "os.system"}, "'model' must be a mapping"),
    ],
)
def test_a_stored_configuration_holds_resolved_values(plain: Any, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        settings_of(plain, "store")


@pytest.mark.parametrize("target", ["os.system", "posix.system", "builtins.eval", "yaml.load"])
def test_composed_configurations_follow_hydras_policy(target: str, tmp_path: Path) -> None:
    loud = OmegaConf.create({"x": {"_target_": target, "command": f"touch {tmp_path / 'marker'}"}})
    for use in (build, lambda each: Component.from_node(each, "x")):
        with pytest.raises(InputError, match=r"'x\._target_': Target .* is blocklisted"):
            use(loud.x)
    hidden = {"_target_": "hydra.utils.get_object", "path": target}
    with pytest.raises(InputError, match="is blocklisted"):
        build(OmegaConf.create({"x": hidden}).x)
    assert not (tmp_path / "marker").exists()


def test_a_hostile_run_folder_runs_nothing(call: Call, tmp_path: Path, lab: Path) -> None:
    from rgbt import consistency, evaluate, predict, robustness

    marker, run = tmp_path / "marker", tmp_path / "run"
    run.mkdir()
    settings: Any = OmegaConf.to_container(compose(["+experiment=crm"]), resolve=True)
    evil = {"_target_": "os.system", "command": f"touch {marker}"}
    commands: list[tuple[Any, tuple[str, ...]]] = [
        *(
            (evaluate.entry, ()),
            (consistency.entry, ()),
            (robustness.entry, ("corruptions=noise",)),
        ),
        (predict.entry, ("input=test", f"out={tmp_path / 'out'}")),
    ]
    for name in ("transform", "model", "scheme"):
        (run / "config.yaml").write_text(json.dumps({**settings, name: evil}))
        for entry, words in commands:
            code, _, err = call(entry, f"run={run}", *words)
            assert code == 2
            assert_one_sentence(err, f"'{name}._target_' names os.system")
    (run / "config.yaml").write_text(json.dumps({**settings, "loss": node("my_lab.Plain")}))
    err = call(evaluate.entry, f"run={run}")[2]
    assert_one_sentence(err, "add trust=my_lab.")
    assert not (lab / "my_lab.imported").exists()
    err = call(evaluate.entry, f"run={run}", "trust=my_lab")[2]
    assert_one_sentence(err, "best.pt")  # the next thing that this folder lacks
    assert (lab / "my_lab.imported").exists()
    assert not marker.exists()


def test_a_corruption_file_of_others_runs_nothing(tmp_path: Path, lab: Path) -> None:
    from rgbt.config.corruption_node import choose_corruption
    from rgbt.evaluation.corruption import corruption_of

    path = tmp_path / "fog.yaml"
    path.write_text(f"_target_: os.system\ncommand: touch {tmp_path / 'marker'}\n")
    with pytest.raises(InputError, match=r"fog.yaml: '_target_' names os.system"):
        choose_corruption(str(path))
    path.write_text("_target_: my_lab.Plain\nwidth: 2\n")
    with pytest.raises(InputError, match="add trust=my_lab"):
        choose_corruption(str(path))
    assert not (lab / "my_lab.imported").exists()
    corruption_of(choose_corruption(str(path), trust=("my_lab",)))
    assert (lab / "my_lab.imported").exists()
    assert not (tmp_path / "marker").exists()


EXTERNAL_NODE = {
    "_target_": "rgbt.models.external.network.ExternalNetwork",
    "checkout": "/code/authors/GMNet",
}


@pytest.mark.parametrize(
    "trust", [("/code/authors/GMNet",), ("/code/authors/../authors/",), ("my_lab", "/code")]
)
def test_code_of_a_checkout_needs_a_trusted_folder(trust: tuple[str, ...]) -> None:
    check_targets({"model": EXTERNAL_NODE}, trust, "store")
    for other in ((), ("my_lab",), ("/code/authors/GM",), ("/code/authors/GMNet/deeper",)):
        with pytest.raises(InputError, match=r"'model\.checkout' is /code/authors/GMNet, .*trust"):
            check_targets({"model": EXTERNAL_NODE}, other, "store")
    with pytest.raises(InputError, match=r"'scheme\.critics\.0\.checkout' is"):
        check_targets({"scheme": {"critics": [EXTERNAL_NODE]}}, ("my_lab",), "store")
