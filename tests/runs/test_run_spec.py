"""Run specifications: what the run key is made of, upstream runs, changes of a stored run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.files.plain_files import write_json
from rgbt.runs.run_spec import RunSpec
from rgbt.runs.specify import load_spec, requested_run, specify


def spec_of(experiment: str, *overrides: str) -> RunSpec:
    words = [f"+experiment={experiment}", *overrides]
    return specify(compose(words), words)


def key_of(experiment: str, *overrides: str) -> str:
    return spec_of(experiment, *overrides).key


# The key.

SAME = (
    *("masker.sigma_div=4", "masker.sigma_div=4.0", "name=other", "consistency=views"),
    "runs_dir=/elsewhere dataset.cache_dir=/cache tracking=none fresh=true",
    "trainer.accelerator=cpu trainer.devices=1 trainer.compile=none",
    "data.num_workers=1 data.on_error=skip data.eval_batch_size=3",
    *("trainer.log_every=3 trainer.checkpoint_minutes=7", "trainer.checkpoint_evaluations=true"),
    "seeds.order=0 seeds.weights=0",
)
OTHER = (
    *("seed=1", "seeds.weights=1", "seeds.order=1", "seeds.masks=1", "masker=irm"),
    *("masker.sigma_div=2", "dataset.num_train=7", "dataset.rgb_noise=0.1", "loss=cross_entropy"),
    *("optimizer.lr=0.5", "data.batch_size=3", "data.sampling=rare_classes", "trainer.threads=1"),
    *("trainer.precision=bf16-mixed", "trainer.averaging=ema", "trainer.selection_split=test"),
    *("metric=ring9", "metric.absent=exclude", "prediction.mirrored=true"),
    *("transform.test_short_edge=96", "model.fresh=[decode_head]"),
)


@pytest.mark.parametrize("typed", SAME)
def test_key_ignores_what_does_not_change_the_result(typed: str) -> None:
    assert key_of("grbm", *typed.split()) == key_of("grbm")


def test_key_differs_for_what_changes_the_result() -> None:
    keys = {word: key_of("grbm", word) for word in OTHER} | {"": key_of("grbm")}
    assert len(set(keys.values())) == len(keys), keys


def test_key_needs_neither_torch_nor_the_classes() -> None:
    script = (
        "import sys\nfrom rgbt.config.compose import compose\n"
        "from rgbt.runs.specify import requested_run\n"
        "words = ['+experiment=multi_head_night', 'masker._target_=no.such.Class']\n"
        "print(requested_run(compose(words), words).key)\n"
        "assert not {'torch', 'rgbt.maskers', 'rgbt.models'} & set(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, len(done.stdout.strip())) == (0, 12), done.stderr


def test_key_counts_weights_and_pseudo_labels_by_content(tmp_path: Path) -> None:
    files, folders = [tmp_path / name for name in "abc"], [tmp_path / f"f{n}" for n in range(3)]
    for path, folder, text in zip(files, folders, ("one", "one", "other"), strict=True):
        path.write_text(text)
        folder.mkdir()
        write_json(folder / "pseudo_labels.json", {"digest": text})
    for setting, named in (("model.weights", files), ("domains.target.labels", folders)):
        one, same, other = (key_of("sh_both", f"{setting}={value}") for value in named)
        assert one == same
        assert len({one, other, key_of("sh_both")}) == 3
    run = spec_of("sh_both", f"domains.target.labels={folders[0]}")
    assert (run.labels_folder("target"), run.labels_folder("source")) == (folders[0], None)
    (folders[0] / "pseudo_labels.json").write_text("{}")
    with pytest.raises(InputError, match=r"labels.*predict"):
        key_of("sh_both", f"domains.target.labels={folders[0]}")


def test_key_counts_what_is_taken_from_upstream_runs() -> None:
    words = {
        "sh_adversarial": (
            *("model.weights=experiment:sh_source/best.pt", "model.weights=null"),
            "model.weights=experiment:sh_both/last.pt",
        ),
        "multi_head_night_stage1": (
            *("domains.target.threshold=0.5", "domains.target.teacher_view=null"),
            "domains.target.labels=experiment:thermal_teacher/last.pt",
        ),
    }
    for experiment, changes in words.items():
        keys = {key_of(experiment, change) for change in changes} | {key_of(experiment)}
        assert len(keys) == 4
    first, second = (spec_of("multi_head_night_stage1", f"seed={seed}") for seed in (0, 1))
    assert all(a.key != b.key for a, b in zip(first.upstream, second.upstream, strict=True))


# Upstream runs.


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("domains.target.labels=/no/such", "domains.target.labels=/no/such"),
        ("model.weights=/no/such", "model.weights=/no/such"),
        ("model.weights=experiment:sh_source", "expected experiment:"),
        ("model.weights=experiment:sh_sourc/last.pt", "did you mean 'sh_source'"),
        ("domains.source.labels=common:start_cmx/last.pt", "expected experiment:"),
        ("domains.target.labels=experiment:sh_both/last.pt", "sh_both -> sh_both"),
    ],
)
def test_reference_wrong_is_refused(override: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        key_of("sh_both", override)


@pytest.mark.parametrize(
    "words",
    [
        *("", "scale.batch_size=2 scale.lr=0.5 trainer.max_steps=3 metric=ring9"),
        "scale=paper dataset.root=/data/freiburg trainer.precision=bf16-mixed",
    ],
)
def test_upstream_run_has_the_key_of_its_experiment(words: str) -> None:
    typed = words.split()
    for experiment in ("multi_head_modified_night_init_stage1", "heatnet_rgb_only"):
        runs = spec_of(experiment, *typed).upstream
        assert runs
        for run in runs:
            assert run.key == key_of(run.name, *typed), run.name


@pytest.mark.parametrize(
    ("typed", "name"),
    [
        ("labels=experiment:thermal_teacher/last.pt", "train_night_thermal_last"),
        ("threshold=0.95", "train_night_thermal_best_0.95"),
        ("teacher_view=null", "train_night_default_best"),
    ],
)
def test_labels_folder_names_what_is_predicted(typed: str, name: str) -> None:
    run = spec_of("multi_head_night_stage1", f"domains.target.{typed}")
    (teacher,) = run.upstream
    assert run.labels_folder("target") == teacher.folder / "pseudo_labels" / name


@pytest.mark.parametrize("experiment", ["grbm", "temporal_con", "multi_head_modified_night_init"])
def test_run_with_another_seed_equals_composing_that_seed(experiment: str) -> None:
    made, direct = spec_of(experiment, "seed=0").with_seed(3), spec_of(experiment, "seed=3")
    assert (made.key, made.plain, made.overrides) == (direct.key, direct.plain, direct.overrides)
    assert [run.key for run in made.upstream] == [run.key for run in direct.upstream]
    drawn = spec_of("grbm", "seeds.order=7").with_seed(2).seed_of
    assert (drawn("weights"), drawn("order"), drawn("masks")) == (2, 7, 2)


# A stored run.


def stored(*overrides: str) -> DictConfig:
    """A configuration as a run stores it."""
    config = OmegaConf.create(OmegaConf.to_container(compose(overrides), resolve=True))
    assert isinstance(config, DictConfig)
    return config


KP = "dataset=synth_kp"


@pytest.mark.parametrize(
    ("trained", "words", "expected"),
    [
        ((), (), "released"),
        # Another data set has its own convention; another partition changes none.
        ((), (KP, "dataset.absent=exclude"), "exclude"),
        (("dataset.absent=exclude",), (KP,), "released"),
        (("dataset.absent=exclude",), ("metric=ring9",), "exclude"),
        # Set by hand, in the run or in the command that evaluates it.
        (("metric.absent=exclude",), (KP,), "exclude"),
        ((), ("metric=ring9", "metric.absent=exclude"), "exclude"),
    ],
)
def test_absent_classes_follow_the_evaluated_data_set(
    trained: tuple[str, ...], words: tuple[str, ...], expected: str
) -> None:
    spec = load_spec(stored(*trained), words)
    assert spec.plain["metric"]["absent"] == expected


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["consistency=views"], 10),
        (["consistency=views", "consistency.scenes_per_count=3"], 3),
        (["consistency.scenes_per_count=3"], 3),
    ],
)
def test_measured_later_as_many_scenes_are_added(words: list[str], expected: int) -> None:
    spec = load_spec(stored("scale=bench"), words)
    assert spec.plain["consistency"]["scenes_per_count"] == expected
    old = stored()
    del old["consistency"]["scenes_per_count"]
    assert load_spec(old, ["consistency=views"]).plain["consistency"]["scenes_per_count"] == 1


def test_archived_run_without_its_checkout_is_found_by_settings(tmp_path: Path) -> None:
    """Its settings of the trainer had other names when it was archived."""
    words = ["+experiment=mfnet", "model=external/gmnet", f"model.checkout={tmp_path}"]
    spec = requested_run(compose(words), words)
    trainer = {**spec.plain["trainer"], "checkpoint_every": 100}
    for changes, expected in (({}, True), ({"precision": "bf16-mixed"}, False)):
        settings = {**spec.plain, "trainer": trainer | changes}
        run: Any = SimpleNamespace(key="of its files", settings=settings)
        assert spec.is_run(run) is expected
