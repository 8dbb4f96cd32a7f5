"""Common starts: runs that all methods and data sets of one network and seed begin from."""

from __future__ import annotations

from pathlib import Path

import pytest

from rgbt.config.compose import compose
from rgbt.run import main
from rgbt.runs.run_spec import WEIGHTS, RunSpec
from rgbt.runs.specify import specify
from tests.commands import Call

EXPERIMENTS = sorted(path.stem for path in Path("conf/experiment").glob("*.yaml"))
SOME = ("baseline", "cmnext", "crm_kp", "dinov3", "mfnet", "sh_max_squares", "thermal_teacher")
ARMS = [
    pytest.param(name, marks=() if name in SOME else pytest.mark.slow)
    for name in EXPERIMENTS
    if not name.startswith("start_")
]


def spec_of(experiment: str, *overrides: str, scale: str = "bench") -> RunSpec:
    words = [f"+experiment={experiment}", f"scale={scale}", *overrides]
    return specify(compose(words), words)


def first_stage(run: RunSpec) -> RunSpec:
    """The run at the beginning of the chain of weights."""
    dependency = run.dependency(WEIGHTS)
    return run if dependency is None else first_stage(dependency.run)


def start_of(experiment: str, *overrides: str) -> RunSpec:
    return first_stage(spec_of(experiment, *overrides))


@pytest.mark.parametrize("experiment", ARMS)
def test_every_experiment_at_bench_has_a_start_without_weights(experiment: str) -> None:
    run = spec_of(experiment, "seed=3")
    start = first_stage(run)
    assert start.name.startswith("start_")
    assert (start.weights, start.seed) == (None, 1003)
    assert start.model.target == run.model.target
    assert start.dataset.plain["seed"] != run.dataset.plain["seed"]


@pytest.mark.parametrize(
    "typed",
    [
        *("seed=7 seeds.start=common", "seeds.weights=7 seeds.order=8", "dataset=synth_pst900"),
        *("dataset.seed=5 dataset.num_train=10", "dataset=mfnet dataset.root=/data/mfnet"),
        "trainer.max_steps=9 optimizer.lr=0.5 masker=irm metric=ring9",
        "trainer.threads=2 data.batch_size=3",
    ],
)
def test_key_of_the_start_ignores_the_arm(typed: str) -> None:
    changed, usual = (spec_of("baseline", *words) for words in (typed.split(), []))
    assert changed.key != usual.key
    assert first_stage(changed).key == first_stage(usual).key


def test_start_shares_what_does_not_change_its_result() -> None:
    typed = ["runs_dir=/elsewhere", "trainer.accelerator=cpu", "data.num_workers=1"]
    start = start_of("baseline", *typed, "dataset.cache_dir=/cache", "tracking=none")
    assert (start.plain["runs_dir"], start.trainer.accelerator) == ("/elsewhere", "cpu")
    assert (start.data.num_workers, start.dataset.plain["cache_dir"]) == (1, "/cache")
    assert start.key == start_of("baseline").key
    for changed in ("model.embed_dim=16", "scale.max_steps=9"):
        assert start.key != start_of("baseline", changed).key
    assert start_of("crm").key == start.key, "methods with the same network share it"
    # The number of classes is that of the start's own data.
    assert start_of("crm_kp").model.values["num_classes"] == 9


def test_stages_of_a_chain_begin_with_the_start() -> None:
    run = spec_of("multi_head_night", "seed=2", "runs_dir=/none")
    assert [(upstream.name, upstream.seed) for upstream in run.pending] == [
        ("start_deeplabv2_heads", 1002),
        ("start_pspnet", 1002),
        ("thermal_teacher", 2),
        ("multi_head_night_stage1", 2),
        ("multi_head_night", 2),
    ]


@pytest.mark.parametrize("experiment", ["crm", "multi_head_night"])
def test_start_has_a_seed_for_each_run(experiment: str) -> None:
    runs = [spec_of(experiment, f"seed={seed}") for seed in (0, 1, 2)]
    starts = [first_stage(run) for run in runs]
    assert [start.seed for start in starts] == [1000, 1001, 1002]
    assert [start.key for start in starts] == [
        spec_of(starts[0].name, f"seed={seed}").key for seed in (1000, 1001, 1002)
    ]
    assert runs[0].key == spec_of(experiment, "seeds.start=common").key
    kept = spec_of(experiment, "seeds.start=common", "seed=1")
    assert (runs[1].key != kept.key, first_stage(kept).seed) == (True, 1000)
    assert runs[0].with_seed(2).key == runs[2].key
    assert runs[2].with_seed(0).key == runs[0].key


def test_other_scales_have_no_start() -> None:
    for scale, root in (("demo", ()), ("paper", ("dataset.root=/data",))):
        run = spec_of("heatnet", *root, scale=scale)
        assert (run.weights, run.dependency(WEIGHTS)) == (None, None)
    assert spec_of("crm", "pretrained=null").dependencies == (), "a random start is possible"


@pytest.mark.slow
def test_arms_train_after_their_start(call: Call, tmp_path: Path) -> None:
    smoke = ("+debug=smoke", "trainer.accelerator=cpu", "tracking=none", f"runs_dir={tmp_path}")
    words = ["+experiment=mfnet", "scale=bench", *smoke]
    assert call(main, *words)[0] == 0
    words.append("seeds.start=common")
    specs = [spec_of("mfnet", *words[2:], f"seed={seed}") for seed in (0, 1)]
    start = first_stage(specs[0])
    first = start.folder.stat().st_mtime_ns
    assert specs[0].is_finished
    code, _, messages = call(main, *words, "seed=1")
    assert (code, specs[1].is_finished) == (0, True)
    assert str(start.folder / "last.pt") in messages
    assert start.folder.stat().st_mtime_ns == first
    # A data set with other classes: the class layer alone is random.
    code, _, messages = call(main, *words, "dataset=synth_pst900")
    assert code == 0
    assert " initial values (" in messages
