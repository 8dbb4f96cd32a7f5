"""Where configuration files are found, and what they choose by the scale."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from rgbt.checks import InputError
from rgbt.config.command import composing
from rgbt.config.compose import available, chosen_scale, compose, groups, searching
from rgbt.spec.specify import parse_reference, upstream_config

OWN = """# @package _global_
defaults:
  - sh_source
  - override /model: ${by_scale:{demo:mfnet_tiny,paper:mfnet}}
  - _self_
name: own_stage
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of configurations with one experiment and one scale."""
    monkeypatch.delenv("RGBT_CONF", raising=False)
    for name in ("experiment", "scale"):
        (tmp_path / name).mkdir()
    (tmp_path / "experiment" / "own_stage.yaml").write_text(OWN)
    (tmp_path / "scale" / "middle.yaml").write_text("defaults: [demo]\n")
    return tmp_path


def word(folder: Path) -> str:
    return f"hydra.searchpath=[file://{folder}]"


@pytest.mark.parametrize(
    ("words", "width"), [([], 16), (["scale=paper"], 32), (["scale=paper", "model=mfnet_tiny"], 16)]
)
def test_by_scale_chooses_the_file_of_the_scale(words: list[str], width: int) -> None:
    assert compose(["+experiment=mfnet", *words]).model.decoder_width == width


def test_by_scale_bench_has_the_files_of_the_demo_unless_it_is_named() -> None:
    bench, demo = (compose(["+experiment=rtfnet", f"scale={name}"]) for name in ("bench", "demo"))
    assert bench.model.base_width == demo.model.base_width == 16
    assert bench.optimizer == demo.optimizer
    assert chosen_scale("bench", {"demo": 1, "paper": 2}) == "demo"
    assert chosen_scale("bench", {"demo": 1, "bench": 2}) == "bench"
    assert chosen_scale("paper", {"demo": 1}) == "paper"


def test_by_scale_unknown_scale_says_to_choose(own: Path) -> None:
    words = ["+experiment=mfnet", "scale=middle", word(own)]
    with pytest.raises(InputError) as caught, composing(words):
        compose(words)
    assert "supports only these scales: {demo:mfnet_tiny,paper:mfnet}" in str(caught.value)


def test_available_lists_the_search_path_of_the_command(own: Path) -> None:
    assert "own_stage" not in available("experiment")
    with searching([word(own), "+experiment=own_stage"]):
        assert {"own_stage", "grbm"} <= set(available("experiment"))
        assert "model" in groups()
        assert compose(["+experiment=own_stage"]).name == "own_stage"
    assert "own_stage" not in available("experiment")


def test_compose_reads_folders_of_the_environment(
    own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RGBT_CONF", f"{own},{own / 'scale'}")
    assert "own_stage" in available("experiment")
    assert compose(["+experiment=own_stage"]).name == "own_stage"


def test_upstream_experiment_on_the_search_path_is_used(own: Path) -> None:
    with searching([word(own)]):
        config = compose(["+experiment=sh_adversarial"])
        value = "experiment:own_stage/last.pt"
        reference = parse_reference("model.weights", value)
        assert reference == ("own_stage", "last.pt", False)
        upstream = upstream_config(config, "domains.target.labels", reference)
    assert (upstream.name, upstream.model.decoder_width) == ("own_stage", 16)
    with pytest.raises(InputError, match=r"no experiment 'own_stage'.*hydra\.searchpath="):
        parse_reference("model.weights", value)
