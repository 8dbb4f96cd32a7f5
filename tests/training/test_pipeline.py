"""Runs that stand on earlier runs: which ones, under which keys, in which order, and only once."""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError, RunError
from rgbt.config.compose import conf_dir
from rgbt.config.schema import check
from rgbt.files.atomic import holding
from rgbt.metrics.counts import Counts
from rgbt.spec import run_key as identity
from rgbt.spec.naming import TAGS
from rgbt.spec.run_key import run_key
from rgbt.tracking.folder import RunFolder
from rgbt.training import pipeline as earlier
from rgbt.training.pipeline import earlier_runs, finish_earlier, labels_folder, warn_of_other_code
from tests.commands import Call, Trained, short
from tests.composed import composed as configuration

STANDING = (
    *("sh_adversarial", "sh_adversarial_seg", "sh_max_squares"),
    *("multi_head_thermal", "multi_head_night", "multi_head_night_stage1"),
    *("multi_head_modified_night_init", "multi_head_modified_night_init_stage1"),
    *("heatnet", "heatnet_rgb_only"),
)
"""Experiments that need others, each in another way."""


@pytest.fixture(autouse=True)
def composed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Composing is most of the time of these tests, and they compose the same again and again."""
    monkeypatch.setattr(identity, "compose", configuration)


def composed(experiment: str, *overrides: str) -> DictConfig:
    config = configuration([f"+experiment={experiment}", *overrides])
    check(config)
    return config


def alone(name: str, *overrides: str) -> str:
    return run_key(composed(name, *overrides))


@dataclass
class Train:
    """Stands for a training: notes what it was asked, and leaves a result."""

    made: list[str] = field(default_factory=list)
    refused: list[BaseException] = field(default_factory=list)
    words: dict[str, list[str]] = field(default_factory=dict)

    def __call__(self, config: DictConfig, overrides: Sequence[str]) -> None:
        assert overrides[0] == f"+experiment={config.name}"
        assert TAGS not in os.environ
        self.words[config.name] = list(overrides[1:])
        if self.refused:
            raise self.refused.pop(0)
        self.made.append(config.name)
        finish(config)


def folder_of(config: DictConfig) -> Path:
    return Path(config.runs_dir) / run_key(config)


def finish(config: DictConfig) -> None:
    folder_of(config).mkdir(parents=True, exist_ok=True)
    (folder_of(config) / "result.json").write_text("{}")


@pytest.fixture
def labels(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """(teacher, domain) of the labels that would have been predicted."""
    asked: list[tuple[str, str]] = []

    def write(teacher: Any, config: DictConfig, name: str) -> None:
        assert labels_folder(config, name).is_relative_to(teacher.folder)
        asked.append((teacher.experiment, name))

    monkeypatch.setattr(earlier, "_write_labels", write)
    return asked


@pytest.fixture
def rehearsed() -> list[str]:
    return []


@pytest.fixture
def bring(labels: list, rehearsed: list[str], tmp_path: Path) -> Any:
    def run(name: str, train: Train, *overrides: str) -> list[str]:
        config = composed(name, *overrides)
        config.runs_dir = str(tmp_path)
        typed = [f"+experiment={name}", *overrides]
        finish_earlier(config, train, lambda each: rehearsed.append(each.name), typed)
        return train.made

    return run


# ---- keys -----------------------------------------------------------------------------------


TYPED = {
    "as it is": [],
    "seed": ["seed=3"],
    "sizes": ["scale.batch_size=2", "scale.lr=0.5", "scale.crop_hw=[64,64]", "scale.num_workers=1"],
    "durations": ["trainer.max_steps=3", "trainer.eval_every=2"],
    "data": ["dataset.num_test=4", "data.on_error=skip"],
    "regions": ["metric=ring9", "metric.absent=exclude"],
    "precision": ["trainer.precision=bf16-mixed", "trainer.threads=1"],
    "paper": ["scale=paper", "dataset.root=/data/freiburg"],
}


@pytest.mark.parametrize(
    "typed",
    [
        pytest.param(words, marks=() if name in ("seed", "data", "durations") else pytest.mark.slow)
        for name, words in TYPED.items()
    ],
    ids=TYPED,
)
def test_an_earlier_run_is_the_run_of_its_experiment_alone(typed: list[str]) -> None:
    for experiment in ("multi_head_modified_night_init_stage1", "heatnet_rgb_only"):
        for found in earlier_runs(composed(experiment, *typed)):
            assert found.config.name == found.experiment
            assert run_key(found.config) == alone(found.experiment, *typed), found.experiment


@pytest.mark.slow
@pytest.mark.parametrize("scale", ["demo", "paper"])
@pytest.mark.parametrize("experiment", STANDING)
def test_every_earlier_run_is_the_run_of_its_experiment_alone(experiment: str, scale: str) -> None:
    typed = [f"scale={scale}", *(["dataset.root=x"] if scale == "paper" else [])]
    found = list(earlier_runs(composed(experiment, *typed)))
    assert found
    for each in found:
        assert run_key(each.config) == alone(each.experiment, *typed)


def test_another_seed_stands_on_other_runs() -> None:
    def keys(*overrides: str) -> list[str]:
        config = composed("multi_head_night_stage1", *overrides)
        return [run_key(config), *(run_key(each.config) for each in earlier_runs(config))]

    first, second = keys("seed=0"), keys("seed=1")
    assert all(a != b for a, b in zip(first, second, strict=True))
    assert keys("seed=0") == first


def test_what_of_an_earlier_run_counts_in_the_key() -> None:
    base = alone("sh_adversarial")
    best = alone("sh_adversarial", "model.weights=experiment:sh_source/best.pt")
    other = alone("sh_adversarial", "model.weights=experiment:sh_both/last.pt")
    none = alone("sh_adversarial", "model.weights=null")
    assert len({base, best, other, none}) == 4
    night = alone("multi_head_night_stage1")
    changes = ("labels=experiment:thermal_teacher/last.pt", "threshold=0.5", "teacher_view=null")
    found = [alone("multi_head_night_stage1", f"domains.target.{each}") for each in changes]
    assert len({night, *found}) == 4


def test_where_runs_lie_and_how_they_are_tracked_does_not_count() -> None:
    base = alone("multi_head_night")
    for typed in (["runs_dir=/elsewhere"], ["tracking=none"], ["fresh=true"]):
        assert alone("multi_head_night", *typed) == base


def write_manifest(folder: Path, digest: str) -> Path:
    folder.mkdir(parents=True)
    (folder / "pseudo_labels.json").write_text(json.dumps({"digest": digest}))
    return folder


def test_a_folder_of_pseudo_labels_counts_by_its_content(tmp_path: Path) -> None:
    def key(folder: Path) -> str:
        return alone("sh_both", f"domains.target.labels={folder}")

    one = write_manifest(tmp_path / "one", "abc")
    moved = write_manifest(tmp_path / "elsewhere", "abc")
    other = write_manifest(tmp_path / "other", "abd")
    assert key(one) == key(moved)
    assert len({key(one), key(other), alone("sh_both")}) == 3
    config = composed("sh_both", f"domains.target.labels={one}")
    assert labels_folder(config, "target") == one
    assert labels_folder(config, "source") is None


BAD_MANIFESTS = {"damaged": "{", "a list": "[1]", "a number": "3", "of something else": "{}"}


@pytest.mark.parametrize("text", BAD_MANIFESTS.values(), ids=BAD_MANIFESTS)
def test_a_damaged_folder_of_pseudo_labels_is_refused(tmp_path: Path, text: str) -> None:
    folder = write_manifest(tmp_path / "x", "abc")
    (folder / "pseudo_labels.json").write_text(text)
    with pytest.raises(InputError, match=r"pseudo_labels.json .*predict"):
        alone("sh_both", f"domains.target.labels={folder}")


REFUSED = {
    "no folder": ("domains.target.labels=/no/such", "there is no /no/such/pseudo_labels.json"),
    "no checkpoint": ("model.weights=experiment:sh_source", "expected experiment:NAME/best.pt"),
    "other checkpoint": (
        "model.weights=experiment:sh_source/first.pt",
        "expected experiment:NAME/best.pt or experiment:NAME/last.pt",
    ),
    "unknown": (
        "model.weights=experiment:sh_sourc/last.pt",
        "there is no experiment 'sh_sourc'.*did you mean 'sh_source'",
    ),
    "unknown teacher": (
        "domains.target.labels=experiment:teacher/best.pt",
        "domains.target.labels=experiment:teacher/best.pt: there is no experiment",
    ),
    "no name": ("domains.source.labels=experiment:/best.pt", "there is no experiment ''"),
    "itself": ("model.weights=experiment:sh_both/last.pt", "sh_both names itself"),
    "its own teacher": ("domains.target.labels=experiment:sh_both/last.pt", "names itself"),
}


@pytest.mark.parametrize(("override", "sentence"), REFUSED.values(), ids=REFUSED)
def test_what_names_no_earlier_run_is_refused(
    bring: Any, tmp_path: Path, override: str, sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        alone("sh_both", override)
    if "/no/such" not in override:  # a folder is no earlier run: it is looked for by the run itself
        with pytest.raises(InputError, match=sentence):
            bring("sh_both", Train(), override)
    assert not list(tmp_path.iterdir())


def test_another_network_is_that_of_the_run_it_starts_from_too() -> None:
    config = composed("sh_adversarial", "model=rtfnet_demo")
    config.model.weights = "experiment:sh_source/last.pt"
    (found,) = earlier_runs(config)
    assert found.config.model._target_ == config.model._target_
    assert found.config.model.weights is None
    assert run_key(found.config) == alone("sh_source", "model=rtfnet_demo")


def test_a_teacher_has_a_network_of_its_own() -> None:
    config = composed("multi_head_night_stage1", "model.base_width=7")
    (found,) = earlier_runs(config)
    assert run_key(found.config) == alone("thermal_teacher")


def test_experiments_of_conf_form_no_ring() -> None:
    """Every experiment's chain ends."""
    needs = {}
    for path in (conf_dir() / "experiment").glob("*.yaml"):
        words = path.read_text().replace("/", " ").split()
        needs[path.stem] = {w.partition(":")[2] for w in words if w.startswith("experiment:")}

    def depth(name: str, above: tuple[str, ...] = ()) -> int:
        assert name not in above, above
        return 1 + max((depth(each, (*above, name)) for each in needs[name]), default=0)

    assert max(depth(name) for name in needs) >= 3


# ---- order, and only once -------------------------------------------------------------------


def test_a_chain_is_trained_from_its_beginning(
    bring: Any, labels: list, rehearsed: list[str]
) -> None:
    made = bring("multi_head_modified_night_init", Train())
    assert made == [
        "multi_head_modified_thermal_stage1",
        "thermal_teacher",
        "multi_head_modified_night_init_stage1",
    ]
    assert labels == [("thermal_teacher", "target")]
    # Before anything is trained, and each only where something is to be trained for it.
    assert rehearsed == ["multi_head_modified_night_init", "multi_head_modified_night_init_stage1"]


def test_a_teacher_of_a_teacher(bring: Any, labels: list) -> None:
    assert bring("heatnet_rgb_only", Train()) == ["thermal_teacher", "heatnet"]
    assert labels == [("thermal_teacher", "target"), ("heatnet", "target")]


def test_finished_runs_are_not_trained_again(bring: Any, labels: list, rehearsed: list) -> None:
    bring("multi_head_modified_night_init", Train())
    labels.clear()
    rehearsed.clear()
    assert bring("multi_head_modified_night_init", Train()) == []
    assert (labels, rehearsed) == ([], [])
    # Another run on the same ones: the teacher's labels are looked at, nothing is trained.
    assert bring("multi_head_modified_night_init_stage1", Train()) == []
    assert labels == [("thermal_teacher", "target")]


def test_what_a_finished_run_stood_on_is_not_needed_any_more(
    bring: Any, tmp_path: Path, labels: list
) -> None:
    bring("multi_head_modified_night_init", Train())
    kept = alone("multi_head_modified_night_init_stage1")
    for folder in tmp_path.iterdir():
        if folder.name != kept:
            shutil.rmtree(folder)
    assert bring("multi_head_modified_night_init", Train()) == []


def test_a_run_that_needs_none_trains_none(bring: Any, rehearsed: list) -> None:
    assert bring("sh_source", Train()) == []
    assert rehearsed == []


def test_a_rehearsal_that_fails_trains_nothing(labels: list, tmp_path: Path) -> None:
    def refuses(config: DictConfig) -> None:
        raise InputError(f"{config.name} does not fit.")

    train = Train()
    with pytest.raises(InputError, match="sh_adversarial does not fit"):
        finish_earlier(composed("sh_adversarial", f"runs_dir={tmp_path}"), train, refuses, [])
    assert train.made == []


def test_an_error_of_an_earlier_run_is_told_and_ends_it(bring: Any) -> None:
    for error in (RunError("step 3: loss is nan."), InputError("no such file."), KeyError("x")):
        with pytest.raises(type(error)):
            bring("sh_adversarial", Train(refused=[error]))


def test_a_mistake_names_the_run_that_it_is_of_and_who_needs_that(bring: Any) -> None:
    with pytest.raises(InputError) as raised:
        bring("sh_adversarial", Train(refused=[InputError("no such file.")]))
    assert str(raised.value) == (
        "sh_source, which sh_adversarial needs (model.weights): no such file."
    )
    with pytest.raises(InputError) as raised:  # the teacher of the stage before
        bring("multi_head_night", Train(refused=[InputError("no such file.")]))
    assert str(raised.value) == (
        "multi_head_night_stage1, which multi_head_night needs (model.weights): thermal_teacher, "
        "which multi_head_night_stage1 needs (domains.target.labels): no such file."
    )


def test_a_mistake_that_a_later_rehearsal_finds_names_its_run(tmp_path: Path, labels: list) -> None:
    def refuses(config: DictConfig) -> None:
        if config.name == "multi_head_night_stage1":
            raise InputError("does not fit.")

    config = composed("multi_head_night", f"runs_dir={tmp_path}")
    sentence = "^multi_head_night_stage1, which multi_head_night needs .*: does not fit.$"
    with pytest.raises(InputError, match=sentence):
        finish_earlier(config, Train(), refuses, [])


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


def test_an_earlier_run_is_named_after_what_was_typed_for_it_too(bring: Any) -> None:
    """And after nothing that does not change it: its name is that of a run of its own."""
    train, model = Train(), ["model.base_width=7", "model=multi_head_demo"]
    bring("multi_head_night", train, *COMMON, *OWN, *model)
    unsaid = ["tracking=none"]  # which no name says
    assert train.words == {
        "multi_head_night_stage1": [*COMMON, *unsaid, *model],
        "thermal_teacher": [*COMMON, *unsaid],
    }


def test_the_network_of_a_run_that_starts_from_another_is_named_by_it_alone(bring: Any) -> None:
    train = Train()
    weights = "model.weights=experiment:sh_source/best.pt"
    bring("sh_max_squares", train, weights, "model.fresh=[auxiliary]", "optimizer.momentum=0.5")
    assert train.words == {"sh_source": []}


def test_a_group_of_the_same_run_at_other_seeds(bring: Any, tmp_path: Path) -> None:
    from rgbt.spec.naming import describe

    for seed in (0, 1):
        train = Train()
        bring("sh_adversarial", train, f"seed={seed}", "trainer.max_steps=3")
        config = composed("sh_source", f"seed={seed}", "trainer.max_steps=3")
        found = describe(config, ["+experiment=sh_source", *train.words["sh_source"]])
        assert found.name == f"max_steps=3 seed={seed} · sh_source"
        assert found.tags["rgbt.group"] == "sh_source max_steps=3"


def finished(experiment: str, tmp_path: Path) -> DictConfig:
    """A configuration whose earlier runs have their results."""
    config = composed(experiment, f"runs_dir={tmp_path}")
    for each in earlier_runs(config):
        finish(each.config)
    return config


def test_fresh_names_the_upstream_runs_that_other_code_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    needed = list(earlier_runs(finished("sh_adversarial", tmp_path)))
    warn_of_other_code(needed)
    assert capsys.readouterr().err == ""
    RunFolder(needed[0].folder).add_provenance({"code": "0" * 64, "diff": ""})
    warn_of_other_code(needed)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"rgbt: warning: the upstream run {needed[0].folder} (model.weights)")
    assert line.endswith("run +experiment=sh_source with fresh=true.")


@pytest.mark.parametrize("state", ["missing", "begun", "whole"])
def test_labels_that_are_not_whole_are_rehearsed_for(
    tmp_path: Path, labels: list, state: str
) -> None:
    """Predicting takes long: what would go wrong after it is found before."""
    config, rehearsed = finished("multi_head_night_stage1", tmp_path), []
    folder = labels_folder(config, "target")
    if state != "missing":
        folder.mkdir(parents=True)
        name = {"begun": "pseudo_labels.begun.json", "whole": "pseudo_labels.json"}[state]
        (folder / name).write_text("{}")
    finish_earlier(config, Train(), rehearsed.append, [])
    assert len(rehearsed) == (0 if state == "whole" else 1)


def test_whole_labels_are_not_predicted_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rgbt.build import load_run as stored

    config = finished("multi_head_night_stage1", tmp_path)
    folder = labels_folder(config, "target")
    folder.mkdir(parents=True)

    def opened(*given: Any, trust: Any) -> None:
        raise KeyError(given[0])

    monkeypatch.setattr(stored, "open_run", opened)
    with pytest.raises(KeyError, match="thermal_teacher|" + folder.parent.parent.name):
        finish_earlier(config, Train(), lambda config: None, [])
    (folder / "pseudo_labels.json").write_text("{}")
    finish_earlier(config, Train(), lambda config: None, [])


def test_the_folder_of_an_earlier_run_is_worked_out_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its key reads whole files of weights, and it is asked for in every look at the run."""
    (found,) = earlier_runs(composed("sh_adversarial", f"runs_dir={tmp_path}"))
    asked: list[str] = []
    monkeypatch.setattr(earlier, "run_key", lambda config: asked.append(config.name) or "key")
    assert found.folder == found.folder == tmp_path / "key"
    assert not found.is_finished
    assert asked == ["sh_source"]


# ---- folders of labels ----------------------------------------------------------------------


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
def test_other_labels_lie_in_another_folder(typed: list[str], name: str) -> None:
    config = composed("multi_head_night_stage1", *typed)
    (found,) = earlier_runs(config)
    assert labels_folder(config, "target") == found.folder / "pseudo_labels" / name


# ---- the file that the first of the stages starts from ---------------------------------------


@pytest.mark.slow
def test_pretrained_weights_reach_the_first_stage(tmp_path: Path) -> None:
    """And count by what is in them in its key, and in the keys of all that stand on it."""

    def keys(file: Path | None) -> list[str]:
        typed = [] if file is None else [f"pretrained={file}"]
        config = composed("multi_head_night", *typed)
        (stage,) = earlier_runs(config)
        (teacher,) = earlier_runs(stage.config)
        assert stage.config.model.weights == (None if file is None else str(file))
        assert teacher.config.model.weights is None
        return [run_key(each) for each in (config, stage.config, teacher.config)]

    files = [tmp_path / name for name in ("one.pth", "same.pth", "other.pth")]
    for file, content in zip(files, (b"abc", b"abc", b"abd"), strict=True):
        file.write_bytes(content)
    none, one, same, other = (keys(file) for file in (None, *files))
    assert one == same
    assert len({none[0], one[0], other[0]}) == len({none[1], one[1], other[1]}) == 3
    assert none[2] == one[2] == other[2]


@pytest.mark.parametrize(
    ("experiment", "typed", "reads"),
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
def test_who_reads_pretrained_weights(experiment: str, typed: list[str], reads: bool) -> None:
    config = composed(experiment, "pretrained=/some/imagenet.pth", *typed)
    assert earlier.reads_pretrained(config) == reads


@pytest.mark.parametrize("experiment", ["sh_adversarial", "heatnet"])
def test_a_file_that_nothing_reads_is_told(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, experiment: str
) -> None:
    from rgbt import run
    from rgbt.training import train as training

    done: list[str] = []
    monkeypatch.setattr(training, "is_finished", lambda config: True)
    monkeypatch.setattr(training, "train", lambda config, words: done.append(config.name))
    file = tmp_path / "imagenet.pth"
    file.write_bytes(b"abc")
    for typed in ([f"pretrained={file}"], []):
        code, _, err = call(run.main, f"+experiment={experiment}", *typed)
        assert code == 0, err
        told = f"rgbt: pretrained={file} is not read: heatnet starts otherwise.\n"
        assert err == (told if experiment == "heatnet" and typed else "")
    assert done == [experiment] * 2


def test_tags_are_those_of_the_run_that_was_asked_for(
    bring: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(TAGS, '{"row": "1"}')
    assert bring("sh_adversarial", Train()) == ["sh_source"]
    assert os.environ[TAGS] == '{"row": "1"}'
    with pytest.raises(RunError):
        bring("sh_adversarial", Train(refused=[RunError("x")]), "seed=5")
    assert os.environ[TAGS] == '{"row": "1"}'


# ---- another process trains it --------------------------------------------------------------


@contextmanager
def another(folder: Path, *, ends: bool, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Somebody who holds the run's lock until we have been seen to wait, and then ends or dies."""
    monkeypatch.setattr(earlier, "LOOK_S", 0.01)
    said: list[str] = []
    waits, holds = threading.Event(), threading.Event()
    monkeypatch.setattr(earlier, "tell", lambda text: (said.append(text), waits.set()))

    def hold() -> None:
        folder.mkdir(parents=True)
        with holding(folder / "lock"):
            holds.set()
            while not any("waiting for it" in text for text in said):
                assert waits.wait(60)
                time.sleep(0.005)
            if ends:
                (folder / "result.json").write_text("{}")

    thread = threading.Thread(target=hold)
    thread.start()
    assert holds.wait(60)
    yield said
    thread.join(60)


@pytest.mark.parametrize("ends", [True, False])
def test_a_run_that_another_process_trains_is_waited_for(
    bring: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends: bool
) -> None:
    """And trained here where that process died."""
    train = Train()
    with another(tmp_path / alone("sh_source"), ends=ends, monkeypatch=monkeypatch) as said:
        bring("sh_adversarial", train)
    assert train.made == ([] if ends else ["sh_source"])
    assert sum("waiting for it" in text for text in said) == 1


def test_a_run_that_another_process_began_in_between(bring: Any, tmp_path: Path) -> None:
    """Our start is refused, and meanwhile the other one has ended."""
    config = composed("sh_source", f"runs_dir={tmp_path}")

    class Late(Train):
        def __call__(self, given: DictConfig, overrides: Sequence[str]) -> None:
            finish(config)
            raise InputError("is being trained by process 1; wait for it.")

    assert bring("sh_adversarial", Late()) == []


# ---- stored runs of before ------------------------------------------------------------------


@pytest.mark.slow
def test_a_stored_run_of_before_domains_opens(call: Call, trained: Trained, tmp_path: Path) -> None:
    from rgbt import evaluate
    from rgbt.config.command import plain_command

    done = trained("+experiment=crm", *short(1))
    folder = tmp_path / "runs" / done.name
    shutil.copytree(done, folder)
    stored = OmegaConf.load(folder / "config.yaml")
    del stored["domains"], stored["pretrained"], stored["trainer"]["tested"]
    OmegaConf.save(stored, folder / "config.yaml")
    code, _, err = call(plain_command(evaluate.OWN, evaluate.main), f"run={folder}")
    assert code == 0, err
    (path,) = (folder / "evaluations").glob("*.npz")
    again, first = Counts.load(path), Counts.load(folder / "counts_test.npz")
    assert np.array_equal(again.counts, first.counts)
    code, _, err = call(plain_command(evaluate.OWN, evaluate.main), f"run={folder}", "head=source")
    assert code == 2
    assert "head=source chooses between the heads of two domains" in err
