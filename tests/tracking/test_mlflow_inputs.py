"""Data set, logged model and system metrics in MLflow, from run folders."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rgbt.api import load_run
from rgbt.checks import InputError
from rgbt.logged_model import _load_pyfunc
from rgbt.tracking import mlflow_store, sync
from rgbt.tracking.mlflow_store import MlflowTracking, NoTracking
from rgbt.tracking.mlflow_upload import is_up_to_date, read_upload_state
from rgbt.tracking.run_files import Description, MarkerForm
from rgbt.tracking.run_folder import RunFolder
from tests.commands import Trained, code_of, short

ONE = ("+experiment=mfnet", "masker.patch_size=null", *short(1))
MARKER: MarkerForm = {
    "names": "aa",
    "files": "0123456789abcdef",
    "name": "mfnet",
    "root": "/data/MFNet; $(touch /tmp/executed)",
    "inputs": [
        {"split": "train", "context": "train", "images": 784},
        {"split": "test", "context": "test", "images": 393},
    ],
}


@pytest.fixture(scope="module")
def runs_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder of runs, so that the store is made once."""
    return tmp_path_factory.mktemp("runs")


def tracking(runs_dir: Path, **options: Any) -> MlflowTracking:
    return MlflowTracking(
        None, artifact_uri=None, experiment="rgbt", runs_dir=str(runs_dir), **options
    )


def run_of(runs_dir: Path, folder: RunFolder) -> Any:
    from mlflow import MlflowClient

    sent = read_upload_state(folder)
    assert sent is not None
    return MlflowClient(tracking_uri=f"sqlite:///{runs_dir / 'mlflow.db'}").get_run(sent.run_id)


def described(folder: RunFolder) -> RunFolder:
    NoTracking().start(folder, Description("grbm", {"rgbt.seed": "0"}, {"seed": "0"}))
    folder.append(5, "train", {"loss": 3.0})
    folder.finish({"steps": 5})
    return folder


def test_each_split_is_an_entry_of_the_datasets_column(runs_dir: Path) -> None:
    folder = described(RunFolder(runs_dir / "inputs"))
    folder.mark(MARKER)
    for _ in range(2):  # a second time sends nothing twice
        tracking(runs_dir).sync(folder, "FINISHED")
    found = [
        (each.dataset.name, each.dataset.digest, {tag.key: tag.value for tag in each.tags})
        for each in run_of(runs_dir, folder).inputs.dataset_inputs
    ]
    assert sorted(found) == [
        ("mfnet/test", "01234567", {"mlflow.data.context": "test"}),
        ("mfnet/train", "01234567", {"mlflow.data.context": "train"}),
    ]
    (train,) = [
        each.dataset
        for each in run_of(runs_dir, folder).inputs.dataset_inputs
        if each.dataset.name == "mfnet/train"
    ]
    assert train.source_type == "local"
    assert json.loads(train.source) == {"uri": MARKER["root"]}, "a path as text"
    assert json.loads(train.profile) == {"images": 784, "fingerprint": "0123456789abcdef"}


def test_a_folder_sent_before_its_data_was_named_is_completed(runs_dir: Path) -> None:
    folder = described(RunFolder(runs_dir / "older"))
    folder.mark({"names": "aa", "files": "0123456789abcdef"})
    tracking(runs_dir).sync(folder, "FINISHED")
    assert run_of(runs_dir, folder).inputs.dataset_inputs == []
    sent = read_upload_state(folder)
    assert sent is not None
    assert is_up_to_date(folder, sent, "FINISHED")

    folder.mark(MARKER)
    assert not is_up_to_date(folder, sent, "FINISHED")
    assert code_of(sync.entry, [f"run={folder.path}"]) == 0
    assert len(run_of(runs_dir, folder).inputs.dataset_inputs) == 2
    sent = read_upload_state(folder)
    assert sent is not None
    assert is_up_to_date(folder, sent, "FINISHED")


def test_a_run_writes_the_splits_that_it_uses(trained: Trained) -> None:
    marker = json.loads((trained(*ONE) / "dataset.json").read_text())
    assert (marker["name"], Path(marker["root"]).name) == ("mfnet", "mf")
    assert marker["inputs"] == [
        {"split": "train", "context": "train", "images": 8},
        {"split": "val", "context": "val", "images": 2},
        {"split": "test", "context": "test", "images": 3},
    ]


def images(count: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (count, 48, 64, 3), dtype=np.uint8)
    return {"rgb": rgb, "thermal": rng.integers(0, 256, (count, 48, 64), dtype=np.uint8)}


@pytest.fixture(scope="module")
def copied(trained: Trained, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The two files of a logged model; the data set that they name is not there."""
    place = tmp_path_factory.mktemp("model")
    for name in ("config.yaml", "best.pt"):
        shutil.copy(trained(*ONE) / name, place)
    config = place / "config.yaml"
    root = json.loads((trained(*ONE) / "dataset.json").read_text())["root"]
    config.write_text(config.read_text().replace(root, "/nowhere"))
    return place


def test_a_logged_model_predicts_what_the_run_predicts(copied: Path, trained: Trained) -> None:
    given = images(2)
    found = _load_pyfunc(str(copied)).predict(given, {"head": "own"})
    run = load_run(trained(*ONE))
    for index in range(2):
        pair = given["rgb"][index], given["thermal"][index]
        assert np.array_equal(found["labels"][index], run.predict(*pair))
    assert (found["labels"].shape, found["labels"].dtype) == ((2, 48, 64), np.uint8)
    assert (found["scores"].shape, found["scores"].dtype) == ((2, 9, 48, 64), np.float32)
    assert np.array_equal(found["scores"].argmax(1), found["labels"])


def test_a_logged_model_refuses_other_arrays_and_heads(copied: Path) -> None:
    network, given = _load_pyfunc(str(copied)), images(1)
    for wrong in (
        {"rgb": given["rgb"]},
        {**given, "rgb": given["rgb"].astype(np.float32)},
        {**given, "thermal": given["thermal"][:, :-1]},
        given["rgb"],
    ):
        with pytest.raises(InputError, match="expected a mapping with 'rgb'"):
            network.predict(wrong)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="one head for all images"):
        network.predict(given, {"head": "target"})
    with pytest.raises(InputError, match="head: 'other' is not a valid choice"):
        network.predict(given, {"head": "other"})


def test_a_logged_model_executes_nothing_of_its_configuration(copied: Path, tmp_path: Path) -> None:
    shutil.copytree(copied, tmp_path / "strange")
    config = tmp_path / "strange" / "config.yaml"
    config.write_text(config.read_text().replace("rgbt.models.mfnet.MFNet", "os.system"))
    with pytest.raises(InputError, match=r"names os\.system"):
        _load_pyfunc(str(tmp_path / "strange"))


FRESH = """
import sys
import mlflow, numpy as np
mlflow.set_tracking_uri(sys.argv[1])
given = dict(np.load(sys.argv[3]))
model = mlflow.pyfunc.load_model(f"runs:/{sys.argv[2]}/best")
np.savez(sys.argv[4], **model.predict(given))
"""


@pytest.mark.slow
def test_mlflow_loads_the_best_checkpoint_in_a_fresh_process(
    runs_dir: Path, trained: Trained, tmp_path: Path
) -> None:
    """Requested by the sync of a run that was trained without MLflow; sent once."""
    path = runs_dir / "logged"
    shutil.copytree(trained(*ONE), path)
    uri = f"sqlite:///{runs_dir / 'mlflow.db'}"
    words = [f"run={path}", f"uri={uri}", f"artifact_uri={(runs_dir / 'files').as_uri()}"]
    for request in (["log_model=true"], [], ["log_model=true"]):
        assert code_of(sync.entry, [*words, *request]) == 0
    outputs = run_of(runs_dir, RunFolder(path)).outputs.model_outputs
    assert [each.step for each in outputs] == [1]

    np.savez(tmp_path / "given.npz", **images(2))
    sent = read_upload_state(RunFolder(path))
    assert sent is not None
    files = [str(tmp_path / "given.npz"), str(tmp_path / "found.npz")]
    subprocess.run([sys.executable, "-c", FRESH, uri, sent.run_id, *files], check=True)
    expected = _load_pyfunc(str(path)).predict(images(2))
    found = np.load(tmp_path / "found.npz")
    # Processes with other numbers of threads round otherwise.
    np.testing.assert_allclose(found["scores"], expected["scores"], rtol=1e-5, atol=1e-6)
    assert np.array_equal(found["labels"], found["scores"].argmax(1))


def test_system_metrics_run_from_the_first_step_to_the_end(
    runs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    class Monitor:
        def finish(self) -> None:
            calls.append("finished")

    def started(uri: str, run_id: str) -> Monitor:
        calls.append(run_id)
        return Monitor()

    monkeypatch.setattr(mlflow_store, "started_monitor", started)
    folder = RunFolder(runs_dir / "measured")
    tracker = tracking(runs_dir, system_metrics=True)
    tracker.start(folder, Description("grbm", {}, {}))
    assert calls == []
    tracker.after_step()
    tracker.update()
    tracker.finish("FINISHED")
    sent = read_upload_state(folder)
    assert sent is not None
    assert calls == [sent.run_id, "finished"]


def test_a_monitor_that_fails_does_not_stop_a_training(
    runs_dir: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def started(uri: str, run_id: str) -> None:
        raise RuntimeError("no sensor")

    monkeypatch.setattr(mlflow_store, "started_monitor", started)
    tracker = tracking(runs_dir, system_metrics=True)
    tracker.start(RunFolder(runs_dir / "unmeasured"), Description("grbm", {}, {}))
    tracker.after_step()
    tracker.finish("FINISHED")
    assert "no sensor). The run continues." in capsys.readouterr().err


@pytest.mark.slow
def test_mlflow_measures_this_machine(runs_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import time

    monkeypatch.setenv("MLFLOW_SYSTEM_METRICS_SAMPLING_INTERVAL", "0.1")
    folder = RunFolder(runs_dir / "machine")
    tracker = tracking(runs_dir, system_metrics=True)
    tracker.start(folder, Description("grbm", {}, {}))
    tracker.after_step()
    end = time.monotonic() + 60
    while "system/cpu_utilization_percentage" not in run_of(runs_dir, folder).data.metrics:
        assert time.monotonic() < end, "no metric was sent"
        time.sleep(0.2)
    tracker.finish("FINISHED")
    assert run_of(runs_dir, folder).info.status == "FINISHED"


def test_system_metrics_without_their_package_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "psutil" else find(name, *a)
    )
    with pytest.raises(InputError, match=r"pip install 'rgbt\[system-metrics\]'"):
        tracking(tmp_path, system_metrics=True)
    tracking(tmp_path)
