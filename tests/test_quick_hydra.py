from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hydra._internal import defaults_list
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.base import Metadata

from rgbt.config import compose as composing
from tests import quick_hydra

LOAD = quick_hydra._load
MERGE = quick_hydra._merge_one_by_one
EMBED = quick_hydra._embed_copy
WORDS = (
    ["+experiment=grbm", "scale=paper", "dataset=mfnet"],
    ["+experiment=temporal_con", "scale=bench"],
    ["+search=grbm", "dataset=synth"],
    # One file in two packages, of which one is changed; and a package that is deleted.
    ["+scheme@first=crm", "+scheme@second=crm", "second.modality_weight=2"],
    ["~masker", "+masker@first=grbm_paper", "+masker@first.inner=grbm_paper"],
)


@pytest.fixture
def hydra_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hydra as it is installed."""
    monkeypatch.setattr(defaults_list, "_create_interpolation_map", quick_hydra._every_choice)
    loader = ConfigLoaderImpl
    monkeypatch.setattr(loader, "_compose_config_from_defaults_list", MERGE)
    monkeypatch.setattr(loader, "_embed_result_config", staticmethod(EMBED))
    monkeypatch.setattr(loader, "_load_configuration_impl", LOAD)
    monkeypatch.delattr(Metadata, "__deepcopy__")


def described(words: list[str], *, command: bool = False) -> tuple[str, list[Any]]:
    """Values, the order of keys, and the flags of every node; or the error."""
    try:
        config = composed_command(words) if command else composing._composed_by_hydra(words)
    except HydraException as error:
        return repr(error), []
    nodes, flags = [config], []
    for node in nodes:
        flags.append(node._metadata.flags)
        if OmegaConf.is_dict(node) and not node._is_none() and not node._is_interpolation():
            children = [node._get_node(key) for key in node]
            nodes += [child for child in children if OmegaConf.is_config(child)]
            assert all(child._get_parent() is node for child in children)
    return OmegaConf.to_yaml(config), flags


def composed_command(words: list[str]) -> DictConfig:
    """With what Hydra notes about a command that is called with these words."""
    with composing.own_hydra():
        hydra: Any = GlobalHydra.instance().hydra
        words = ["hydra/sweeper=basic", *words, "hydra.mode=RUN"]
        config: DictConfig = hydra.compose_config("config", words, RunMode.RUN)
        return config


@pytest.mark.parametrize("words", WORDS, ids=" ".join)
def test_quick_composition_is_that_of_hydra(
    words: list[str], request: pytest.FixtureRequest
) -> None:
    quick = described(words)
    request.getfixturevalue("hydra_itself")
    assert described(words) == quick
    assert quick[1]


@pytest.mark.parametrize(
    "words",
    [
        *(["seed=2", "+experiment=grbm", "masker.sigma_div=2"], ["masker=square", "seed='a, b'"]),
        *(["masker.wrong=1", "seed=1"], ["seed=1", "experiment=none"], ["seed=[1"]),
        *(["seed=1,2"], ["~seed"], ["+recipe={a:1}"], ["hydra.verbose=true", "seed=1"]),
    ],
    ids=" ".join,
)
def test_command_composed_again_is_that_of_hydra(
    words: list[str],
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setattr(quick_hydra, "_commands", {})
    described([word for word in words if "." not in word], command=True)
    monkeypatch.chdir(tmp_path)
    quick = described(words, command=True)
    request.getfixturevalue("hydra_itself")
    assert described(words, command=True) == quick


def test_files_of_a_command_are_composed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    loads: list[list[str]] = []

    def counted(loader: Any, name: str, words: list[str], *given: Any) -> DictConfig:
        loads.append(words)
        return LOAD(loader, name, words, *given)

    monkeypatch.setattr(quick_hydra, "_commands", {})
    monkeypatch.setattr(quick_hydra, "_load", counted)
    for word in ("seed=1", "seed=2", "trainer.threads=1"):
        composed_command(["masker=square", word])
    assert loads == [["hydra/sweeper=basic", "hydra.mode=RUN", "masker=square"]]


def test_refused_file_is_named(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "wrong.yaml").write_text(
        "# @package _global_\nscale: [1]\n"  # a list in the place of a mapping
    )
    words = ["+experiment=wrong", f"hydra.searchpath=[file://{tmp_path}]"]
    quick = described(words)[0]
    assert "In 'experiment/wrong'" in quick
    request.getfixturevalue("hydra_itself")
    assert described(words)[0] == quick


def test_files_are_merged_and_moved_only_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the replacement is for: one merge for all files, and tables of choices for few."""
    merges, tables = [], []
    merge, table = type(OmegaConf.create()).merge_with, quick_hydra._every_choice

    def counted(self: Any, *others: Any) -> None:
        merges.append(len(others))
        merge(self, *others)

    monkeypatch.setattr(type(OmegaConf.create()), "merge_with", counted)
    monkeypatch.setattr(
        quick_hydra, "_every_choice", lambda *given: tables.append(1) or table(*given)
    )
    composing._composed_by_hydra(["+experiment=grbm"])
    assert sorted(merges)[-1] > 20
    assert len(merges) <= 3
    assert len(tables) < sorted(merges)[-1] / 4
