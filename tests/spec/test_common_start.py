"""Common starts: runs that all methods and data sets of one network and seed begin from."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from rgbt.build.training_setup import validate
from rgbt.checks import InputError
from rgbt.config.command import composing
from rgbt.config.compose import compose
from rgbt.run import main
from rgbt.spec.run_spec import WEIGHTS, RunSpec
from rgbt.spec.specify import specify
from rgbt.training.pipeline import topological_order
from tests.commands import Call

EXPERIMENTS = sorted(path.stem for path in Path("conf/experiment").glob("*.yaml"))
ARMS = [name for name in EXPERIMENTS if not name.startswith("start_")]


def spec_of(experiment: str, *overrides: str, scale: str = "bench") -> RunSpec:
    words = [f"+experiment={experiment}", f"scale={scale}", *overrides]
    return specify(compose(words), words)


def first_stage(run: RunSpec) -> RunSpec:
    """The run at the beginning of the chain of weights."""
    dependency = run.dependency(WEIGHTS)
    return run if dependency is None else first_stage(dependency.run)


def start_of(experiment: str, *overrides: str) -> RunSpec:
    start = first_stage(spec_of(experiment, *overrides))
    assert start.name.startswith("start_")
    return start


@pytest.mark.parametrize("experiment", ARMS)
def test_every_experiment_at_bench_has_a_start_without_weights(experiment: str) -> None:
    run = spec_of(experiment, "seed=3")
    start = first_stage(run)
    assert start.name.startswith("start_")
    assert (start.weights, start.seed) == (None, 1003)
    assert start.model.target == run.model.target
    assert start.dataset.plain["seed"] != run.dataset.plain["seed"]


NETWORKS = {
    "mask2former": ("baseline", "crm", "grbm", "spatialseg", "crm_released", "crm_kp"),
    "cmx": ("cmx", "temporal_con", "temporal_dice", "temporal_con_released"),
    "cmnext": ("cmnext",),
    "rtfnet": ("rtfnet", "rtfnet_temporal_con"),
    "deeplabv2": ("sh_source", "sh_both", "sh_adversarial", "self_training_night"),
    "deeplabv2_heads": ("multi_head_night", "multi_head_thermal"),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_methods_with_the_same_network_share_the_start(name: str) -> None:
    starts = {start_of(experiment).key for experiment in NETWORKS[name]}
    assert starts == {spec_of(f"start_{name}").key}


CHANGES = {
    "seed": ["seed=7", "seeds.start=common"],
    "seeds by source": ["seeds.weights=7", "seeds.order=8"],
    "data set": ["dataset.seed=5", "dataset.rgb_noise=0.1", "dataset.num_train=10"],
    "another data set": ["dataset=synth_pst900"],
    "files": ["dataset=mfnet", "dataset.root=/data/mfnet", "dataset.cache_dir=/data/cache"],
    "recipe of the run": ["trainer.max_steps=9", "optimizer.lr=0.5", "masker=irm", "metric=ring9"],
    "threads": ["trainer.threads=2", "data.batch_size=3"],
}


@pytest.mark.parametrize("typed", CHANGES.values(), ids=CHANGES)
def test_key_of_the_start_does_not_depend_on_the_arm(typed: list[str]) -> None:
    if "dataset=mfnet" in typed:
        typed = [word for word in typed if "cache_dir" not in word]
    changed, usual = (spec_of("baseline", *words) for words in (typed, []))
    assert changed.key != usual.key
    assert first_stage(changed).key == first_stage(usual).key


def test_start_of_another_network_is_another_run() -> None:
    assert start_of("baseline").key != start_of("baseline", "model.embed_dim=16").key
    # The number of classes is that of the start's own data.
    assert start_of("crm_kp").model.values["num_classes"] == 9
    assert start_of("baseline").key != start_of("baseline", "scale.max_steps=9").key


def test_start_shares_what_does_not_change_its_result() -> None:
    typed = ["runs_dir=/elsewhere", "trainer.accelerator=cpu", "data.num_workers=1"]
    start = start_of("baseline", *typed, "dataset.cache_dir=/cache", "tracking=none")
    assert start.runs_dir == "/elsewhere"
    assert start.trainer.accelerator == "cpu"
    assert start.data.num_workers == 1
    assert start.dataset.plain["cache_dir"] == "/cache"
    assert start.key == start_of("baseline").key


def test_stages_of_a_chain_begin_with_the_start() -> None:
    run = spec_of("multi_head_night", "seed=2", "runs_dir=/none")
    chain = [(each.name, each.seed) for each in topological_order(run)]
    assert chain == [
        ("start_deeplabv2_heads", 1002),
        ("start_pspnet", 1002),
        ("thermal_teacher", 2),
        ("multi_head_night_stage1", 2),
        ("multi_head_night", 2),
    ]


@pytest.mark.parametrize("experiment", ["crm", "multi_head_night"])
def test_run_with_another_seed_keeps_the_start_on_request(experiment: str) -> None:
    one = "seeds.start=common"
    made, direct = spec_of(experiment, one).with_seed(3), spec_of(experiment, one, "seed=3")
    assert made.key == direct.key
    assert first_stage(made).seed == 1000


@pytest.mark.parametrize("experiment", ["crm", "multi_head_night"])
def test_start_has_a_seed_for_each_run(experiment: str) -> None:
    runs = [spec_of(experiment, f"seed={seed}") for seed in (0, 1, 2)]
    starts = [first_stage(run) for run in runs]
    assert [start.seed for start in starts] == [1000, 1001, 1002]
    assert [start.key for start in starts] == [
        spec_of(starts[0].name, f"seed={seed}").key for seed in (1000, 1001, 1002)
    ]
    assert runs[0].key == spec_of(experiment, "seeds.start=common").key
    assert runs[1].key != spec_of(experiment, "seeds.start=common", "seed=1").key
    assert runs[0].with_seed(2).key == runs[2].key
    assert runs[2].with_seed(0).key == runs[0].key


def test_methods_with_the_same_seed_share_its_start() -> None:
    assert start_of("baseline", "seed=4").key == start_of("crm", "seed=4").key


@pytest.mark.parametrize("scale", ["demo", "paper"])
def test_other_scales_have_no_start(scale: str) -> None:
    root = ["dataset.root=/data"] if scale == "paper" else []
    for experiment in ("baseline", "heatnet", "thermal_teacher"):
        run = spec_of(experiment, *root, scale=scale)
        assert run.weights is None
        assert run.dependency(WEIGHTS) is None


def test_random_start_is_possible_at_bench() -> None:
    assert spec_of("crm", "pretrained=null").dependencies == ()


REFUSED = {
    "labels": (
        ["domains.source.labels=common:start_cmx/last.pt"],
        r"domains\.source\.labels=common:start_cmx/last\.pt: only model\.weights",
    ),
    "checkpoint": (["pretrained=common:start_cmx"], "expected common:NAME/best.pt or common:NAME"),
    "name": (["pretrained=common:start_cm/last.pt"], "did you mean 'start_cmx'"),
}


@pytest.mark.parametrize(("typed", "sentence"), REFUSED.values(), ids=REFUSED)
def test_common_reference_wrong_is_refused(typed: list[str], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        spec_of("baseline", *typed)


def test_network_without_a_start_is_refused() -> None:
    config = compose(["+experiment=mfnet", "scale=bench"])
    config.model._target_ = "own.Network"
    sentence = r"^pretrained has no .*common start for the network Network;.*pretrained=null"
    with pytest.raises(InputError, match=sentence), composing([]):
        OmegaConf.select(config, "pretrained", throw_on_missing=True)


@pytest.mark.parametrize("experiment", ["heatnet", "thermal_teacher"])
def test_bench_without_a_common_start_has_random_weights(experiment: str) -> None:
    config = compose([f"+experiment={experiment}", "scale=bench"])
    config.pretrained = None
    assert config.model.weights is None


SMOKE = ("+debug=smoke", "trainer.accelerator=cpu", "tracking=none")


@pytest.mark.parametrize("experiment", ["multi_head_night_stage1", "crm_pst900"])
def test_chain_at_bench_passes_validation(experiment: str, tmp_path: Path) -> None:
    run = spec_of(experiment, *SMOKE, f"runs_dir={tmp_path}")
    order = topological_order(run)
    assert order[0].name.startswith("start_")
    for each in order:
        validate(each)


def test_arms_train_after_their_start(call: Call, tmp_path: Path) -> None:
    words = ["+experiment=mfnet", "scale=bench", *SMOKE, f"runs_dir={tmp_path}"]
    assert call(main, *words)[0] == 0
    words.append("seeds.start=common")
    specs = [spec_of("mfnet", *words[2:], f"seed={seed}") for seed in (0, 1)]
    start = first_stage(specs[0])
    first = start.folder.stat().st_mtime_ns
    result = json.loads((start.folder / "result.json").read_text())
    assert specs[0].is_finished
    code, _, messages = call(main, *words, "seed=1")
    assert (code, specs[1].is_finished) == (0, True)
    assert str(start.folder / "last.pt") in messages
    assert start.folder.stat().st_mtime_ns == first
    assert json.loads((start.folder / "result.json").read_text()) == result
    # A data set with other classes: the class layer alone is random.
    code, _, messages = call(main, *words, "dataset=synth_pst900")
    assert code == 0
    assert "of another shape in the common start" in messages
