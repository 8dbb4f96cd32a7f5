"""Compositions are those of Hydra, also from the cache; files of the user are found."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hydra
import pytest
from hydra.errors import MissingConfigException
from omegaconf import OmegaConf

from rgbt.checks import InputError
from rgbt.config import compose as composing_module
from rgbt.config.compose import available, compose, composed, conf_dir, own_hydra, searching
from rgbt.config.overrides import composing

OWN = "# @package _global_\ndefaults:\n  - sh_source\n  - _self_\nname: own_stage\n"


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of configurations with one experiment."""
    monkeypatch.delenv("RGBT_CONF", raising=False)
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "own_stage.yaml").write_text(OWN)
    return tmp_path


@pytest.mark.parametrize(
    ("words", "width"), [([], 16), (["scale=paper"], 32), (["scale=paper", "model=mfnet_tiny"], 16)]
)
def test_by_scale_chooses_the_file_of_the_scale(words: list[str], width: int) -> None:
    assert compose(["+experiment=mfnet", *words]).model.decoder_width == width


def test_available_lists_the_search_path_of_the_command(
    own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "own_stage" not in available("experiment")
    with searching([f"hydra.searchpath=[file://{own}]", "+experiment=own_stage"]):
        assert {"own_stage", "grbm"} <= set(available("experiment"))
        assert compose(["+experiment=own_stage"]).name == "own_stage"
    assert "own_stage" not in available("experiment")
    monkeypatch.setenv("RGBT_CONF", f"{own},{own / 'scale'}")
    assert "own_stage" in available("experiment")
    assert compose(["+experiment=own_stage"]).name == "own_stage"


def test_a_file_that_would_never_be_read_is_refused(
    own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (own / "loss").mkdir()
    (own / "loss" / "focal.yaml").write_text("_target_: my_lab.loss.Focal\n")
    monkeypatch.setenv("RGBT_CONF", str(own))
    with pytest.raises(InputError, match="rgbt has conf/loss/focal.yaml, and uses that"):
        compose(["loss=focal"])
    monkeypatch.setenv("RGBT_CONF", str(conf_dir()))
    assert compose(["seed=8"]).seed == 8


VARIED = """\
defaults: [{inputs: cmx}, _self_]
_target_: rgbt.models.mfnet.MFNet
num_classes: ${dataset.num_classes}
widths: [1, 2, 3]
part: {a: 1, b: 2}
_variants_:
  18: {widths: [4]}
  big_one: {part: {b: "${seed}"}, defaults: [{inputs: half_three}, _self_]}
"""


def test_a_file_holds_several_choices(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (own / "model").mkdir()
    (own / "model" / "my_net.yaml").write_text(VARIED)
    (own / "model" / "other.yaml").write_text(f"{VARIED}  mid: null\n")
    monkeypatch.setenv("RGBT_CONF", str(own))
    names = {"my_net", "my_net_18", "my_net_big_one", "other_18", "other_big_one", "other_mid"}
    listed = {name for name in available("model") if name.startswith(("my_net", "other"))}
    assert listed == names  # a variant without values is the name of the file's own
    found = {name: compose([f"model={name}", "seed=7"]).model for name in sorted(names)}
    assert found["my_net"] == found["other_mid"]
    assert "_variants_" not in found["my_net"]
    assert found["my_net"].num_classes == 9
    assert (found["my_net"].widths, found["my_net_18"].widths) == ([1, 2, 3], [4])
    assert (found["my_net"].part, found["other_big_one"].part) == (
        {"a": 1, "b": 2},
        {"a": 1, "b": 7},
    )
    assert found["my_net_18"].inputs.thermal_mean == found["my_net"].inputs.thermal_mean
    assert found["my_net_big_one"].inputs.thermal_mean == [127.5] * 3
    for name in ("other", "my_net_19", "net_18"):
        with pytest.raises(InputError, match=f"there is no model '{name}'"), composing([]):
            compose([f"model={name}"])


CHOICES = (
    *("masker=square", "masker=none", "+experiment=crm", "+experiment=grbm", "scale=paper"),
    *("model=mfnet", "optimizer=adamw", "+debug=smoke", "hydra.mode=RUN", "+nothing=1"),
)
VALUES = (
    *("optimizer.lr=0.003", "seed=7", "model.fresh=[a,b]", "model.weights=null"),
    *("name='a, b'", 'name="it\'s"', "scale.crop_hw=[48,64]", "scale.pixel_factor=0.25"),
    *("+model.extra={a:1,b:[x,null]}", "trainer.max_steps=${scale.eval_every}", "out=null"),
    *("~trainer.threads", "++trainer.threads=2", "trainer.threads=1", "model={weights:x}"),
    *("masker.blokc=1", "masker=squre", "seed=1,2", "seed=[1", "+seed=1", "sead=1"),
)


@pytest.mark.parametrize("seed", range(8))
def test_random_words_are_composed_or_refused_as_hydra_does(seed: int) -> None:
    draw = random.Random(seed)
    words = [*draw.sample(CHOICES, 2), *draw.sample(VALUES, 4)]
    draw.shuffle(words)

    def result(make: Any, *arguments: object) -> str:
        try:
            return OmegaConf.to_yaml(make(*arguments))
        except Exception as error:
            return f"{type(error).__name__}: {error}"

    for _ in range(2):  # composed, and from the cache
        found = result(compose, words)
        with own_hydra():
            assert found == result(hydra.compose, "config", words), words


def test_values_are_set_on_copy_of_composed_configuration() -> None:
    composing_module._by_hydra.cache_clear()
    first = compose(("masker=square", "seed=1"))
    first.masker.patch_size = 99
    second = compose(("masker=square", "seed=2", "trainer.threads=1"))
    assert composing_module._by_hydra.cache_info().misses == 1
    assert (first.seed, second.seed, second.masker.patch_size == 99) == (1, 2, False)
    assert OmegaConf.is_struct(second)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        *(("experiment=grbm", "+experiment="), ("+experiment=grbm +experiment=crm", "experiment")),
        *(("nothing", "'nothing'"), ("seed=0,1", "'seed=0,1'"), ("masker=grm", "'grm'")),
        *(("optimiser=adamw", "'optimizer'"), ("lr=1", "optimizer.lr")),
        *(("dataset.num_trian=1", "'num_train'"), ("+experiment=mfnet scale=middle", "'middle'")),
    ],
)
def test_word_that_hydra_refuses_is_one_line(words: str, said: str) -> None:
    with pytest.raises(InputError) as caught, composing(words.split()):
        compose(words.split())
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


OWN_SWEEP = """# @package _global_
defaults:
  - sh_source
  - override /hydra/sweeper: study
  - _self_
hydra: {mode: MULTIRUN, sweeper: {workers: 2}}
"""


def test_files_and_words_may_choose_for_hydra(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hydra's own files are left out of a composition where no word names them."""
    (own / "experiment" / "own_sweep.yaml").write_text(OWN_SWEEP)
    monkeypatch.setenv("RGBT_CONF", str(own))
    assert not composed(["+experiment=own_stage"])[1]
    for words in ([], ["hydra.sweeper.workers=3"], ["hydra/launcher=basic"]):
        config, is_search = composed(["+experiment=own_sweep", *words])
        assert is_search
        assert config == compose(["+experiment=own_stage", "name=sh_source"])
    with pytest.raises(MissingConfigException, match="hydra/launcher/nothing"):
        composed(["hydra/launcher=nothing"])


@pytest.mark.parametrize("scale", ["demo", "paper"])
def test_debug_steps_changes_the_length_of_a_run_alone(scale: str) -> None:
    words = ["+experiment=crm_kp", f"scale={scale}", "dataset=kp", "dataset.root=/data/KP"]
    whole, steps = (
        OmegaConf.to_container(compose([*words, *more]), resolve=True)
        for more in ((), ("+debug=steps",))
    )
    assert isinstance(whole, dict)
    assert isinstance(steps, dict)
    changed = {}
    for group in whole:
        values = whole[group] if isinstance(whole[group], dict) else {}
        for key in {*values, *steps[group]} if values else ():
            if values.get(key) != steps[group].get(key):
                changed[f"{group}.{key}"] = steps[group].get(key)
    keys = ("scale.max_steps", "scale.eval_every", "trainer.max_steps", "trainer.eval_every")
    length = dict.fromkeys(keys, 2)
    tracking = {key: value for key, value in changed.items() if key.startswith("tracking.")}
    assert tracking["tracking._target_"] == "rgbt.tracking.tracker.Tracking", "no MLflow"
    assert changed == {
        **length,
        **tracking,
        "trainer.log_every": 1,
        "scale.few_scenes": True,
    }
