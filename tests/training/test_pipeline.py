"""Pipelines of runs: which runs are trained, in which order, and only once."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rgbt.checks import InputError, RunError
from rgbt.config.compose import compose
from rgbt.files.atomic import holding
from rgbt.run import main
from rgbt.runs.folder import RunFolder
from rgbt.runs.naming import TAGS, describe
from rgbt.runs.run_spec import RunSpec
from rgbt.runs.specify import specify
from rgbt.tracking.tracker import Tracking
from rgbt.training import pipeline, train
from rgbt.training.train import Training
from tests.commands import Call


@dataclass
class Notes:
    """In place of trainings: notes names of runs in order, and writes a result.

    `labels` are teacher and run of the pseudo-labels; `refused` is raised by the next trainings of
    upstream runs, one each; runs that are `invalid` do not pass validation.
    """

    trained: list[str] = field(default_factory=list)
    validated: list[str] = field(default_factory=list)
    labels: list[tuple[str, str]] = field(default_factory=list)
    refused: list[BaseException] = field(default_factory=list)
    invalid: tuple[str, ...] = ()
    finished_by_another: bool = False

    def validate(self, spec: RunSpec) -> None:
        assert not self.trained
        self.validated.append(spec.name)
        if spec.name in self.invalid:
            raise InputError("does not fit.")

    def predict_labels(self, spec: RunSpec) -> None:
        for teacher, _, _ in spec.missing_labels:
            assert teacher.run.is_finished
            self.labels.append((teacher.run.name, spec.name))

    def train_run(
        self, spec: RunSpec, extra_tags: Mapping[str, str] | None = None, upstream_of: str = ""
    ) -> None:
        if extra_tags is not None:  # the requested run
            assert (extra_tags, upstream_of) == ({"row": "1"}, "")
            return
        if self.refused:
            raise self.refused.pop(0)
        finish(spec)
        if self.finished_by_another:
            raise InputError("is being trained by process 1; wait for it.")
        self.trained.append(spec.name)


Pipeline = Callable[..., Notes]


def spec_of(experiment: str, *overrides: str) -> RunSpec:
    words = [f"+experiment={experiment}", *overrides]
    return specify(compose(words), words)


def finish(spec: RunSpec) -> None:
    spec.folder.mkdir(parents=True, exist_ok=True)
    (spec.folder / "result.json").write_text("{}")


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Pipeline:
    """Runs the pipeline of an experiment with notes in the place of trainings."""

    def run(experiment: str, *overrides: str, notes: Notes | None = None) -> Notes:
        notes = notes or Notes()
        for name in ("validate", "predict_labels", "train_run"):
            monkeypatch.setattr(pipeline, name, getattr(notes, name))
        spec = spec_of(experiment, f"runs_dir={tmp_path}", *overrides)
        pipeline.run_pipeline(spec, {"row": "1"})
        return notes

    return run


def test_pipeline_chain_is_trained_from_its_beginning(run: Pipeline) -> None:
    notes = run("multi_head_modified_night_init")
    stages = [
        "multi_head_modified_thermal_stage1",
        "thermal_teacher",
        "multi_head_modified_night_init_stage1",
    ]
    assert notes.trained == stages
    assert notes.labels == [("thermal_teacher", "multi_head_modified_night_init_stage1")]
    assert notes.validated == [*stages, "multi_head_modified_night_init"]


def test_pipeline_finished_upstream_runs_are_reused(run: Pipeline, tmp_path: Path) -> None:
    run("multi_head_modified_night_init")
    again = run("multi_head_modified_night_init")
    assert (again.trained, again.validated, again.labels) == ([], [], [])
    # Of an unfinished run only the direct upstream runs are needed.
    kept = spec_of("multi_head_modified_night_init_stage1").key
    copy = tmp_path.with_name("copy")
    shutil.copytree(tmp_path / kept, copy / kept)
    assert run("multi_head_modified_night_init", f"runs_dir={copy}").trained == []
    # Another run with the same upstream runs: its labels are predicted, nothing is trained.
    stage = run("multi_head_modified_night_init_stage1", "fresh=true")
    assert stage.trained == []
    assert stage.labels == [("thermal_teacher", "multi_head_modified_night_init_stage1")]


@pytest.mark.parametrize("name", ["thermal_teacher", "multi_head_night"])
def test_pipeline_invalid_run_trains_nothing(run: Pipeline, name: str) -> None:
    notes = Notes(invalid=(name,))
    with pytest.raises(InputError) as raised:
        run("multi_head_night", notes=notes)
    named = "" if name == "multi_head_night" else f"upstream run {name} of multi_head_night: "
    assert str(raised.value) == f"{named}does not fit."
    assert notes.trained == []


@pytest.mark.parametrize(
    "error", [RunError("step 3: loss is nan."), InputError("no file."), KeyError()]
)
def test_pipeline_failed_upstream_run_ends_it(run: Pipeline, error: BaseException) -> None:
    with pytest.raises(type(error)) as raised:
        run("sh_adversarial", notes=Notes(refused=[error]))
    if isinstance(error, InputError):
        assert str(raised.value) == "upstream run sh_source of sh_adversarial: no file."


def test_fresh_names_upstream_runs_of_other_code(
    run: Pipeline, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (source,) = spec_of("sh_adversarial", f"runs_dir={tmp_path}").upstream
    finish(source)
    run("sh_adversarial", "fresh=true")
    assert capsys.readouterr().err == ""
    RunFolder(source.folder).add_provenance({"code": "0" * 64, "diff": ""})
    run("sh_adversarial", "fresh=true")
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"rgbt: warning: the upstream run {source.folder} (model.weights)")
    assert line.endswith("run +experiment=sh_source with fresh=true.")


def test_pipeline_predicts_and_validates_for_unfinished_labels(
    run: Pipeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Predicting takes long: errors of the training after it are found before."""
    spec = spec_of("multi_head_night_stage1", f"runs_dir={tmp_path}")
    (teacher,) = spec.upstream
    finish(teacher)
    folder = spec.labels_folder("target")
    assert folder is not None
    (folder.parent / f".{folder.name}.abc" / folder.name).mkdir(parents=True)  # a killed process
    assert len(run("multi_head_night_stage1").validated) == 1

    def opened(run: RunSpec, folder: Path, checkpoint: str, trained_with: object) -> None:
        raise KeyError(run.key, folder, checkpoint)

    monkeypatch.setattr(train, "with_weights", opened)
    with pytest.raises(KeyError, match=teacher.key):
        train.predict_labels(spec)
    folder.mkdir()
    assert run("multi_head_night_stage1").validated == []


def test_run_reports_ignored_pretrained_and_takes_environment_tags(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs: list[tuple[str, Mapping[str, str]]] = []
    monkeypatch.setattr(pipeline, "run_pipeline", lambda spec, tags: runs.append((spec.name, tags)))
    monkeypatch.setenv(TAGS, '{"row": "1"}')
    file = tmp_path / "imagenet.pth"
    file.write_bytes(b"abc")
    for experiment in ("sh_adversarial", "heatnet"):
        code, _, err = call(main, f"+experiment={experiment}", f"pretrained={file}")
        assert code == 0, err
        assert err.startswith(f"rgbt: pretrained={file} is ignored") == (experiment == "heatnet")
    assert runs == [("sh_adversarial", {"row": "1"}), ("heatnet", {"row": "1"})]


@pytest.mark.parametrize("finishes", [True, False])
def test_pipeline_waits_for_another_process(
    run: Pipeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, finishes: bool
) -> None:
    """And trains the run where that process, which holds its lock until we wait, died."""
    folder = tmp_path / spec_of("sh_source").key
    messages: list[str] = []
    waits, holds = threading.Event(), threading.Event()
    monkeypatch.setattr(pipeline, "POLL_S", 0.01)
    monkeypatch.setattr(pipeline, "info", lambda text: (messages.append(text), waits.set()))

    def hold() -> None:
        folder.mkdir(parents=True)
        with holding(folder / "lock"):
            holds.set()
            while not any("waiting for it" in text for text in messages):
                assert waits.wait(60)
                time.sleep(0.005)
            if finishes:
                (folder / "result.json").write_text("{}")

    thread = threading.Thread(target=hold)
    thread.start()
    assert holds.wait(60)
    notes = run("sh_adversarial")
    thread.join(60)
    assert notes.trained == ([] if finishes else ["sh_source"])
    assert sum("waiting for it" in text for text in messages) == 1


def test_pipeline_run_finished_by_another_process_is_used(run: Pipeline) -> None:
    """Our start is refused, and the other process has finished in the meantime."""
    assert run("sh_adversarial", notes=Notes(finished_by_another=True)).trained == []


def test_run_stopped_while_its_tracking_begins_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Slow(Tracking):
        """A store that a signal comes before."""

        ended = ""

        def start(self, *_: object) -> None:
            raise KeyboardInterrupt

        def finish(self, status: str) -> None:
            self.ended = status

    spec, tracking = spec_of("mfnet", f"runs_dir={tmp_path}"), Slow()
    dataset = SimpleNamespace(fingerprint=lambda: "abc")
    setup: Any = SimpleNamespace(session=SimpleNamespace(spec=spec, dataset=dataset))
    monkeypatch.setattr(Training, "_claim", lambda *_: None)
    with pytest.raises(KeyboardInterrupt):
        Training(setup, describe(spec), RunFolder(tmp_path), tracking).run()
    assert tracking.ended == "KILLED"
