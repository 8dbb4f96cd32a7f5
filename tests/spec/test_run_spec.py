"""Run specifications: upstream runs, their configurations, and what the run key is made of."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.spec.naming import GROUP, describe
from rgbt.spec.run_spec import NOT_IN_KEY, RunSpec
from rgbt.spec.specify import specify

DEPENDENT = (
    *("sh_adversarial", "sh_adversarial_seg", "sh_max_squares"),
    *("multi_head_thermal", "multi_head_night", "multi_head_night_stage1"),
    *("multi_head_modified_night_init", "multi_head_modified_night_init_stage1"),
    *("heatnet", "heatnet_rgb_only"),
)
"""Experiments with upstream runs, each in another way."""


def spec_of(experiment: str, *overrides: str) -> RunSpec:
    words = [f"+experiment={experiment}", *overrides]
    return specify(compose(words), words)


def key_of(experiment: str, *overrides: str) -> str:
    return spec_of(experiment, *overrides).key


TYPED = {
    "as it is": [],
    "sizes": ["scale.batch_size=2", "scale.lr=0.5", "scale.crop_hw=[64,64]", "scale.num_workers=1"],
    "several": [
        *("trainer.max_steps=3", "trainer.eval_every=2", "dataset.num_test=4", "seed=3"),
        "data.on_error=skip",
    ],
    "regions": ["metric=ring9", "metric.absent=exclude"],
    "precision": ["trainer.precision=bf16-mixed", "trainer.threads=1"],
    "paper": ["scale=paper", "dataset.root=/data/freiburg"],
}


@pytest.mark.parametrize(
    "typed",
    [
        pytest.param(words, marks=() if name == "several" else pytest.mark.slow)
        for name, words in TYPED.items()
    ],
    ids=TYPED,
)
def test_upstream_run_has_the_key_of_its_experiment(typed: list[str]) -> None:
    for experiment in ("multi_head_modified_night_init_stage1", "heatnet_rgb_only"):
        for run in spec_of(experiment, *typed).upstream:
            assert run.key == key_of(run.name, *typed), run.name


@pytest.mark.slow
@pytest.mark.parametrize("scale", ["demo", "paper"])
@pytest.mark.parametrize("experiment", DEPENDENT)
def test_every_upstream_run_has_the_key_of_its_experiment(experiment: str, scale: str) -> None:
    typed = [f"scale={scale}", *(["dataset.root=x"] if scale == "paper" else [])]
    runs = spec_of(experiment, *typed).upstream
    assert runs
    for run in runs:
        assert run.key == key_of(run.name, *typed)


def test_resolution_of_the_consistency_loss_is_in_the_key_unless_full() -> None:
    recorded = json.loads(Path("tests/behaviour.json").read_text())["experiments"]
    for experiment in ("temporal_con", "temporal_con_released"):
        old = recorded[experiment]["compositions"]["demo"]["key"]
        assert key_of(experiment, "scheme.resolution=full") == old
        assert key_of(experiment, "scheme.resolution=half") != old


def test_upstream_runs_of_another_seed_are_other_runs() -> None:
    first, second = (spec_of("multi_head_night_stage1", f"seed={seed}") for seed in (0, 1))
    assert first.key != second.key
    assert all(a.key != b.key for a, b in zip(first.upstream, second.upstream, strict=True))


def test_key_counts_what_is_taken_from_upstream_runs() -> None:
    base = key_of("sh_adversarial")
    best = key_of("sh_adversarial", "model.weights=experiment:sh_source/best.pt")
    other = key_of("sh_adversarial", "model.weights=experiment:sh_both/last.pt")
    none = key_of("sh_adversarial", "model.weights=null")
    assert len({base, best, other, none}) == 4
    night = key_of("multi_head_night_stage1")
    changes = ("labels=experiment:thermal_teacher/last.pt", "threshold=0.5", "teacher_view=null")
    keys = [key_of("multi_head_night_stage1", f"domains.target.{each}") for each in changes]
    assert len({night, *keys}) == 4


def write_manifest(folder: Path, digest: str) -> Path:
    folder.mkdir(parents=True)
    (folder / "pseudo_labels.json").write_text(json.dumps({"digest": digest}))
    return folder


def test_key_counts_pseudo_labels_by_content(tmp_path: Path) -> None:
    def key(folder: Path) -> str:
        return key_of("sh_both", f"domains.target.labels={folder}")

    one = write_manifest(tmp_path / "one", "abc")
    moved = write_manifest(tmp_path / "elsewhere", "abc")
    other = write_manifest(tmp_path / "other", "abd")
    assert key(one) == key(moved)
    assert len({key(one), key(other), key_of("sh_both")}) == 3
    run = spec_of("sh_both", f"domains.target.labels={one}")
    assert run.labels_folder("target") == one
    assert run.labels_folder("source") is None


BAD_MANIFESTS = {"damaged": "{", "a list": "[1]", "a number": "3", "of something else": "{}"}


@pytest.mark.parametrize("text", BAD_MANIFESTS.values(), ids=BAD_MANIFESTS)
def test_key_damaged_pseudo_labels_are_refused(tmp_path: Path, text: str) -> None:
    folder = write_manifest(tmp_path / "x", "abc")
    (folder / "pseudo_labels.json").write_text(text)
    with pytest.raises(InputError, match=r"pseudo_labels.json .*predict"):
        key_of("sh_both", f"domains.target.labels={folder}")


REFUSED = {
    "no folder": ("domains.target.labels=/no/such", "/no/such/pseudo_labels.json does not exist"),
    "no checkpoint": ("model.weights=experiment:sh_source", "expected experiment:NAME/best.pt"),
    "other checkpoint": (
        "model.weights=experiment:sh_source/first.pt",
        "expected experiment:NAME/best.pt or experiment:NAME/last.pt",
    ),
    "unknown": (
        "model.weights=experiment:sh_sourc/last.pt",
        "there is no experiment 'sh_sourc'.*did you mean 'sh_source'",
    ),
    "no name": ("domains.source.labels=experiment:/best.pt", "there is no experiment ''"),
    "its own teacher": ("domains.target.labels=experiment:sh_both/last.pt", "sh_both -> sh_both"),
}


@pytest.mark.parametrize(("override", "sentence"), REFUSED.values(), ids=REFUSED)
def test_reference_wrong_is_refused(override: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        key_of("sh_both", override)


def test_circle_of_two_experiments_is_refused() -> None:
    words = ["+experiment=sh_adversarial", "model.weights=experiment:heatnet_rgb_only/last.pt"]
    words += ["domains.target.labels=experiment:sh_adversarial/best.pt"]
    with pytest.raises(
        InputError, match="cycle of upstream runs: sh_adversarial -> sh_adversarial"
    ):
        specify(compose(words), words)


def test_weights_upstream_run_gets_the_network() -> None:
    run = spec_of(
        "sh_adversarial", "model=rtfnet_tiny", "model.weights=experiment:sh_source/last.pt"
    )
    (source,) = run.upstream
    assert source.model.target == run.model.target
    assert source.weights is None
    assert source.key == key_of("sh_source", "model=rtfnet_tiny")


def test_teacher_keeps_its_own_network() -> None:
    (teacher,) = spec_of("multi_head_night_stage1", "model.base_width=7").upstream
    assert teacher.key == key_of("thermal_teacher")


COMMON = (
    *("scale=demo", "scale.lr=0.5", "dataset=synth_freiburg", "++dataset.num_test=4"),
    *("data.on_error=skip", "trainer.max_steps=3", "trainer.threads=1", "metric=ring9"),
    "metric.absent=exclude",
)
OWN = (
    *("optimizer.lr=0.1", "scheme.weight=0.5", "seed=3", "loss=cross_entropy"),
    *("trainer.clip_norm=1.0", "transform.test_short_edge=96", "masker=none"),
    *("model.fresh=[]", "tracking=none"),
)


def test_upstream_overrides_are_those_that_both_runs_share() -> None:
    model = ["model.base_width=7", "model=deeplabv2_two_heads_modified_tiny"]
    (stage,) = spec_of("multi_head_night", *COMMON, *OWN, *model).upstream
    (teacher,) = stage.upstream
    silent = ["tracking=none"]  # no name has it
    assert stage.overrides[1:] == (*COMMON, *silent, *model)
    assert teacher.overrides[1:] == (*COMMON, *silent)


def test_upstream_runs_of_another_size_or_seed_are_not_in_the_groups_of_the_real_ones() -> None:
    typed = ("+debug=smoke", "seeds.order=3")
    (stage,) = spec_of("multi_head_night", *typed).upstream
    (teacher,) = stage.upstream
    for each in (stage, teacher):
        alone = describe(spec_of(each.name, *typed))
        found = describe(each)
        assert (found.name, found.tags[GROUP]) == (alone.name, alone.tags[GROUP])
        assert found.tags[GROUP].startswith(f"{each.name} debug=smoke ")
        assert found.tags[GROUP].endswith("order=3")


@pytest.mark.parametrize(
    ("typed", "name"),
    [
        ([], "train_night_thermal_best"),
        (["domains.target.labels=experiment:thermal_teacher/last.pt"], "train_night_thermal_last"),
        (["domains.target.threshold=0.9"], "train_night_thermal_best_0.9"),
        (["domains.target.threshold=0.95"], "train_night_thermal_best_0.95"),
        (["domains.target.teacher_view=null"], "train_night_default_best"),
        (["domains.target.split=train_day"], "train_day_thermal_best"),
    ],
)
def test_labels_folder_names_what_is_predicted(typed: list[str], name: str) -> None:
    run = spec_of("multi_head_night_stage1", *typed)
    (teacher,) = run.upstream
    assert run.labels_folder("target") == teacher.folder / "pseudo_labels" / name


@pytest.mark.slow
def test_pretrained_weights_count_in_the_first_stage(tmp_path: Path) -> None:
    def keys(file: Path | None) -> list[str]:
        typed = [] if file is None else [f"pretrained={file}"]
        run = spec_of("multi_head_night", *typed)
        (stage,) = run.upstream
        (teacher,) = stage.upstream
        assert stage.weights == (None if file is None else str(file))
        assert teacher.weights is None
        return [each.key for each in (run, stage, teacher)]

    files = [tmp_path / name for name in ("one.pth", "same.pth", "other.pth")]
    for file, content in zip(files, (b"abc", b"abc", b"abd"), strict=True):
        file.write_bytes(content)
    none, one, same, other = (keys(file) for file in (None, *files))
    assert one == same
    assert len({none[0], one[0], other[0]}) == len({none[1], one[1], other[1]}) == 3
    assert none[2] == one[2] == other[2]


@pytest.mark.parametrize(
    ("experiment", "typed", "uses"),
    [
        ("sh_source", [], True),
        ("sh_adversarial", [], True),
        ("multi_head_modified_night_init", [], True),
        ("sh_source", ["model.weights=/some/file.pth"], False),
        ("sh_adversarial", ["model.weights=null"], False),
        ("heatnet", [], False),
        ("heatnet_rgb_only", [], False),
    ],
)
def test_uses_pretrained_looks_upstream(experiment: str, typed: list[str], uses: bool) -> None:
    run = spec_of(experiment, "pretrained=/some/imagenet.pth", *typed)
    assert run.uses_pretrained == uses


@pytest.mark.parametrize("experiment", ["grbm", "temporal_con", "multi_head_modified_night_init"])
def test_run_with_another_seed_is_the_run_composed_with_it(experiment: str) -> None:
    made = spec_of(experiment, "seed=0").with_seed(3)
    composed_so = spec_of(experiment, "seed=3")
    assert made.key == composed_so.key
    assert made.plain == composed_so.plain
    assert made.overrides == composed_so.overrides
    assert [each.key for each in made.upstream] == [each.key for each in composed_so.upstream]


def test_averaging_is_in_the_key_with_the_setting_that_it_uses() -> None:
    plain = key_of("grbm")
    unused = ("trainer.ema_decay=0.5", "trainer.averaged_share=0.5")
    assert key_of("grbm", "trainer.averaging=none", *unused) == plain
    ema, last = key_of("grbm", "trainer.averaging=ema"), key_of("grbm", "trainer.averaging=last")
    assert len({plain, ema, last}) == 3
    assert key_of("grbm", "trainer.averaging=ema", "trainer.averaged_share=0.5") == ema
    assert key_of("grbm", "trainer.averaging=ema", "trainer.ema_decay=0.5") != ema
    assert key_of("grbm", "trainer.averaging=last", "trainer.ema_decay=0.5") == last
    assert key_of("grbm", "trainer.averaging=last", "trainer.averaged_share=0.5") != last


RENAMED = {
    "multi_head_thermal_stage1_released": "7a9532ea828f",
    "multi_head_night_stage1_released": "dd8e07e74c11",
    "multi_head_night_init_stage1_released": "4886ab787b7a",
}
"""Keys of the runs of the modified decoder as version 0.1.0 computes them, when the decoder was
called modified_released."""


@pytest.mark.parametrize("experiment", RENAMED)
def test_renamed_decoder_keeps_the_key(experiment: str) -> None:
    words = ["model=deeplabv2_two_heads_modified_tiny"]
    if "night" in experiment:  # whose labels are those of another teacher now
        words.append("domains.target.labels=experiment:thermal_teacher/best.pt")
    run = spec_of(experiment, *words)
    assert run.model.plain["decoder"] == "modified_heatnet"
    assert run.key == RENAMED[experiment]
    assert spec_of(experiment, *words, "model.decoder=modified_thesis").key != run.key


def test_seeds_that_are_the_seed_of_the_run_are_not_in_the_key() -> None:
    assert key_of("grbm", "seed=3", "seeds.order=3") == key_of("grbm", "seed=3")
    others = [key_of("grbm", f"seeds.{source}=3") for source in ("weights", "order", "masks")]
    assert len({*others, key_of("grbm")}) == 4


def test_seeds_are_those_of_upstream_runs_too() -> None:
    (upstream,) = spec_of("sh_max_squares", "seeds.order=3").upstream
    assert (upstream.seeds.order, upstream.seeds.weights) == (3, None)


def test_drawn_with_another_seed_keeps_the_seeds_of_sources() -> None:
    drawn = spec_of("grbm", "seeds.order=7").with_seed(2).drawn
    assert (drawn.weights, drawn.order, drawn.masks) == (2, 7, 2)


def test_background_of_a_data_set_is_not_in_the_key() -> None:
    words = ("grbm", "scale=paper", "dataset=kp", "dataset.root=/data")
    assert spec_of(*words).dataset.values["background"] == ()
    assert key_of(*words, "dataset.background=[road]") == key_of(*words)
    assert "dataset.background" in NOT_IN_KEY


def test_measured_gradient_shares_keep_the_key() -> None:
    """Those of upstream runs too, which take the setting over."""
    measured = spec_of("sh_max_squares", "trainer.log_gradient_shares=true")
    assert measured.key == key_of("sh_max_squares")
    assert measured.upstream[0].trainer.log_gradient_shares


def test_factors_newer_than_the_first_runs_are_in_the_key_where_they_are_set() -> None:
    plain = key_of("grbm", "dataset=synth_calibrated")
    assert key_of("grbm", "dataset=synth_calibrated", "dataset.vignette=0.18") == plain
    changed = [
        key_of("grbm", "dataset=synth_calibrated", word)
        for word in ("dataset.vignette=0", "dataset.whole_shadows=true")
    ]
    assert len({plain, *changed}) == 3
