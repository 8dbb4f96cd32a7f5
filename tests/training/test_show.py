"""The result of a finished run is shown without training modules, torch and MLflow."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.run import main
from rgbt.spec import request
from rgbt.tracking.mlflow_store import NoTracking
from rgbt.tracking.run_files import Description, read_description
from rgbt.tracking.run_folder import RunFolder
from rgbt.training import show
from rgbt.training.show import describe_again
from tests.commands import Call, Trained, assert_one_sentence, only_run, short, train, words_of

ROOT = Path(__file__).resolve().parents[2]

SCRIPT = """
import runpy, sys
try:
    runpy.run_module("rgbt.run", run_name="__main__", alter_sys=True)
except SystemExit as left:
    assert not left.code, left.code
heavy = {"torch", "mlflow", "sqlalchemy", "pandas", "scipy", "matplotlib", "lightning_fabric"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
"""


@pytest.fixture
def words(trained: Trained, data: Path, tmp_path: Path) -> list[str]:
    """Arguments that request a finished run in `tmp_path`."""
    overrides = ("+experiment=crm", *short(1))
    done = trained(*overrides)
    shutil.copytree(done, tmp_path / "runs" / done.name)
    return words_of(data, tmp_path / "runs", *overrides)


def test_a_finished_run_is_shown_without_torch_and_mlflow(
    call: Call, words: list[str], tmp_path: Path
) -> None:
    code, first, err = call(main, *words)
    assert code == 0, err
    # A store that nobody serves: without its record, the run would be sent and MLflow imported.
    tracked = [*words, "tracking=mlflow", "tracking.uri=http://127.0.0.1:9"]
    assert call(main, *tracked)[0] == 0
    record_as_sent(only_run(tmp_path / "runs"))
    for each in (words, tracked):
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT, *each], capture_output=True, text=True, cwd=ROOT
        )
        assert done.returncode == 0, done.stderr
        assert "is already finished" in done.stderr
        assert "cannot be used" not in done.stderr
        assert done.stdout.splitlines()[:4] == first.splitlines()[:4]


def record_as_sent(folder: Path) -> None:
    """Let ``mlflow.json`` say that the store on port 9 has everything of the run."""
    from rgbt.tracking.mlflow_inputs import inputs_digest
    from rgbt.tracking.mlflow_upload import UploadState, _changed_files, _shown, write_upload_state
    from rgbt.tracking.run_files import read_tables

    run = RunFolder(folder)
    known, tables = read_description(folder), read_tables(folder)
    assert known is not None
    sent = UploadState("http://127.0.0.1:9", "rgbt", None, "1", "f00", profile=True)
    sent.steps = {line.kind: line.step for line in run.lines()}
    sent.files = dict(_changed_files(run, sent, tables))
    sent.shown = _shown(run, known, tables, "FINISHED")
    sent.inputs = inputs_digest(folder)
    write_upload_state(run, sent)


def test_processes_that_were_started_together_do_not_show_a_run_each(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(show, "known_run", lambda *_: pytest.fail("looked for"))
    monkeypatch.setenv("RANK", "1")
    nothing: Any = None
    assert not show.show_known(nothing, [], {})


def test_a_request_is_noted_once_and_belongs_to_the_code(
    call: Call, words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    specified: list[str] = []
    from rgbt.spec import specify as module

    real = module.specify

    def specify(*given: Any, **more: Any) -> Any:
        specified.append("")
        return real(*given, **more)

    monkeypatch.setattr(module, "specify", specify)

    def shown(*more: str) -> bool:
        """Whether the run is shown without its specification."""
        specified.clear()
        code, out, err = call(main, *words, *more)
        assert code == 0, err
        assert "mIoU" in out
        assert "is already finished" in err
        return not specified

    assert [shown(), shown()] == [False, True]
    (noted,) = (tmp_path / "runs" / request.FOLDER).glob("*.json")
    assert json.loads(noted.read_text())["key"] == only_run(tmp_path / "runs").name
    # A value outside the key, and a default that is typed, are other requests of the same run.
    assert [shown("data.num_workers=1"), shown("data.num_workers=1")] == [False, True]
    monkeypatch.setattr(request, "code", lambda: {"code": "another version of rgbt"})
    assert [shown(), shown()] == [False, True]
    noted.write_text("{")
    code, _, err = call(main, *words)
    assert code == 2
    assert_one_sentence(err, f"{noted} is damaged")


def test_a_request_of_a_removed_run_trains_it(
    call: Call, words: list[str], data: Path, tmp_path: Path
) -> None:
    call(main, *words)
    shutil.rmtree(only_run(tmp_path / "runs"))
    code, _, err = train(call, data, tmp_path / "runs", "+experiment=crm", *short(1))
    assert code == 0, err
    assert "is already finished" not in err
    assert only_run(tmp_path / "runs")


def test_a_known_run_is_compared_with_the_present_files(
    call: Call, words: list[str], data: Path
) -> None:
    call(main, *words)
    shutil.copy(data / "labels" / "00101D.png", data / "labels" / "00201D.png")
    _, _, err = call(main, *words)
    assert "this run was trained on other files of the data set" in err
    shutil.rmtree(data)
    code, out, err = call(main, *words)
    assert (code, "mIoU" in out) == (0, True)
    assert "other files" not in err, "a result can be shown without its data"


def test_a_run_with_an_upstream_run_is_requested_by_the_content_of_its_weights(
    tmp_path: Path,
) -> None:
    weights = tmp_path / "weights.pt"
    weights.write_bytes(b"one")
    words = ["+experiment=mfnet", f"runs_dir={tmp_path}"]
    plain = request.request_digest(compose(words))
    assert plain == request.request_digest(compose(words))
    digests = {plain, request.request_digest(compose([*words, "seed=1"]))}
    digests.add(request.request_digest(compose([*words, f"model.weights={weights}"])))
    weights.write_bytes(b"other")
    digests.add(request.request_digest(compose([*words, f"model.weights={weights}"])))
    upstream = [*words, "model.weights=experiment:rtfnet/best.pt"]
    digests.add(request.request_digest(compose(upstream)))
    digests.add(request.request_digest(compose([*upstream, "scale=paper", "dataset.root=/data"])))
    assert len(digests) == 6
    circle = compose([*words, "model.weights=experiment:mfnet/best.pt"])
    with pytest.raises(InputError, match="cycle"):
        request.request_digest(circle)
    assert request.known_run(circle, ()) is None, "specify reports it"
    assert request.known_run(compose([*words, "fresh=true"]), ()) is None


def test_ignored_weights_are_reported(capsys: pytest.CaptureFixture[str]) -> None:
    show.report_pretrained(None, False, "mfnet")
    show.report_pretrained("swin.pth", True, "crm")
    assert capsys.readouterr().err == ""
    show.report_pretrained("swin.pth", False, "mfnet")
    said = capsys.readouterr().err
    assert "pretrained=swin.pth is ignored: the experiment mfnet does not use" in said


@pytest.mark.parametrize(
    ("group", "name"),
    [("grbm", "grbm sigma_div=2 seed=0"), ("grbm sigma_div=2", "grbm sigma_div=2 seed=0")],
)
def test_a_finished_run_keeps_its_name_unless_the_new_one_says_more(
    tmp_path: Path, group: str, name: str
) -> None:
    folder = RunFolder(tmp_path)
    folder.describe(Description(name, {"rgbt.group": "grbm sigma_div=2", "row": "a"}, {}))
    typed = Description("seed=0 · a longer name than before", {"rgbt.group": group}, {})
    describe_again(folder, NoTracking(), typed)
    kept = read_description(folder.path)
    assert kept is not None
    assert (kept.name, kept.tags["row"]) == (name, "a")

    more = Description("lr=1 · grbm", {"rgbt.group": "grbm sigma_div=2 lr=1"}, {})
    describe_again(folder, NoTracking(), more)
    kept = read_description(folder.path)
    assert kept is not None
    assert (kept.name, kept.tags["row"]) == ("lr=1 · grbm", "a")
