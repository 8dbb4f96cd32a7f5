"""The plugin that reads rgbt's files changes no other program of Hydra."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import hydra
import pytest
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType

from hydra_plugins.rgbt_conf import RgbtConfigSource
from rgbt.config.compose import available, compose, conf_dir, own_hydra, searching

OTHERS = """\
import json, sys
import hydra
from hydra.core.global_hydra import GlobalHydra
with hydra.initialize_config_dir(sys.argv[1], version_base=None):
    config = hydra.compose("config", ["+thing=one"])
    path = GlobalHydra.instance().config_loader().get_search_path().get_path()
print(json.dumps([config["a"], [element.path for element in path],
    [module for module in sys.modules if module.split(".")[0] in ("rgbt", "torch", "optuna")]]))
"""


@pytest.fixture
def others(tmp_path: Path) -> Path:
    """The folder of another program's files."""
    folder = tmp_path / "conf"
    (folder / "thing").mkdir(parents=True)
    (folder / "config.yaml").write_text("a: 0\n")
    (folder / "thing" / "one.yaml").write_text("# @package _global_\na: 1\n_variants_: {b: {}}\n")
    return folder


def search_path() -> list[tuple[str, str]]:
    path = GlobalHydra.instance().config_loader().get_search_path().get_path()
    return [(str(element.provider), str(element.path)) for element in path]


def test_another_program_imports_and_sees_nothing_of_rgbt(others: Path) -> None:
    paths = os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", OTHERS, str(others)],
        env={**os.environ, "PYTHONPATH": paths, "RGBT_CONF": "/my/conf"},
        capture_output=True,
        text=True,
        check=True,
    )
    expected = [1, ["pkg://hydra.conf", str(others), "structured://"], []]
    assert json.loads(done.stdout) == expected


def test_another_folder_of_a_program_that_uses_rgbt_is_read_as_files(
    others: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RGBT_CONF", "/my/conf")
    with hydra.initialize_config_dir(str(others), version_base="1.3"):
        assert search_path()[1:] == [("main", str(others)), ("schema", "structured://")]
        assert "_variants_" in hydra.compose("config", ["+thing=one"])
    registered = SourcesRegistry.instance().types
    assert registered["file"].__name__ == FileConfigSource.__name__
    assert registered["file"].load_config.__qualname__ == "FileConfigSource.load_config"


def test_own_folders_follow_rgbt_s(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RGBT_CONF", " /a b,file:///c,'/d', pkg://my_lab.conf,")
    folders = ["rgbt:///a b", "rgbt:///c", "rgbt:///d", "pkg://my_lab.conf"]
    with own_hydra():
        assert search_path() == [
            ("hydra", "pkg://hydra.conf"),
            ("main", f"rgbt://{conf_dir()}"),
            *(("RGBT_CONF", folder) for folder in folders),
            ("schema", "structured://"),
        ]


def test_folder_of_one_command_may_hold_variants(
    others: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (others / "config.yaml").unlink()
    (others / "loss").mkdir()
    text = (conf_dir() / "loss" / "set_criterion.yaml").read_text().partition("_variants_")[0]
    (others / "loss" / "mine.yaml").write_text(f"{text}_variants_: {{two: {{}}}}\n")
    words = [f"hydra.searchpath=[file://{others}]", "loss=mine_two"]
    with searching(words):
        assert {"mine", "mine_two"} <= set(available("loss"))
        assert compose(words).loss == compose([words[0], "loss=mine"]).loss


def test_source_lists_groups_and_choices(others: Path) -> None:
    (others / "thing" / "notes.txt").touch()
    (others / "thing" / "deep").mkdir()
    (others / "thing" / "__pycache__").mkdir()
    source = RgbtConfigSource("main", f"rgbt://{others}")
    assert (source.available(), source.is_group("thing"), source.is_group("one")) == (1, 1, 0)
    assert [source.is_config(f"thing/{name}") for name in ("one", "one_b", "b")] == [1, 1, 0]
    found = [source.list("thing", kind) for kind in (None, ObjectType.CONFIG, ObjectType.GROUP)]
    assert found == [["deep", "one", "one_b"], ["one", "one_b"], ["deep"]]
    assert source.list("", ObjectType.GROUP) == ["thing"]
    assert not RgbtConfigSource("main", f"rgbt://{others / 'no'}").available()
