"""Finished runs in Python: what `rgbt.load_run` and `rgbt.results` return and refuse."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import rgbt
from rgbt import predict
from rgbt.checkpoints.files import NOTE, read_torch_file, save
from rgbt.checks import InputError
from rgbt.config.stored_config import read_settings
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from rgbt.runs.folder import Description, RunFolder, counts_name
from rgbt.runs.run_spec import settings_digest
from tests.commands import Call, Trained, edit_config, short
from tests.measured import measurement

ONE = ("+experiment=crm", *short(1))
"""A run that several test files read."""

RGB = np.zeros((48, 64, 3), np.uint8)
THERMAL = np.zeros((48, 64), np.uint8)


@pytest.fixture(scope="module")
def run(trained: Trained) -> rgbt.Run:
    return rgbt.load_run(trained(*ONE))


def some_counts(seed: int, split: str = "test") -> Counts:
    matrix = np.random.default_rng(seed).integers(0, 9, (2, 3, 2, 2))
    of = measurement(dataset="f00d", split=split, partition="ring3")
    data: Any = {"measurement": of, "names": ("a", "b"), "night": (False, True)}
    return Counts(counts=matrix, classes=("road", "car"), **data)


def write_run(path: Path, group: str, seed: int, *, finished: bool = True) -> RunFolder:
    """What a run leaves, but for the network."""
    run = RunFolder(path)
    run.write_config("dataset:\n  _target_: rgbt.data.mfnet.MFNet\n")
    tags = {"rgbt.experiment": group, "rgbt.group": group, "rgbt.seed": str(seed)}
    run.describe(Description(f"seed={seed} · {group}", tags, {}))
    some_counts(seed).save(run.path / counts_name("test"))
    if finished:
        run.finish({"key": path.name, "dataset": "f00d", "best_step": 120})
    return run


def test_import_rgbt_loads_no_other_module() -> None:
    code = (
        "import sys, rgbt; loaded = {'rgbt.api', 'torch', 'numpy', 'pandas'} & set(sys.modules);"
        "assert not loaded, loaded; assert 'load_run' in dir(rgbt)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="no attribute 'load_runs'"):
        _ = rgbt.load_runs  # type: ignore[attr-defined]


def test_predict_arrays_and_files_equals_the_command(
    run: rgbt.Run, call: Call, tmp_path: Path
) -> None:
    words = (f"run={run.folder}", "input=test", f"out={tmp_path}")
    assert call(predict.entry, *words)[0] == 0
    name = run.dataset.names("test")[0]
    expected = cv2.imread(str(tmp_path / f"{name}.png"), cv2.IMREAD_UNCHANGED)
    sample = run.dataset.read(name)
    of_arrays = run.predict(sample.rgb, sample.thermal)
    assert of_arrays.dtype == np.uint8
    np.testing.assert_array_equal(of_arrays, expected)
    packed = run.dataset.files(name)[0]
    np.testing.assert_array_equal(run.predict(packed, str(packed)), expected)


def test_load_run_gives_probabilities_and_scores(run: rgbt.Run) -> None:
    sample = run.dataset.read(run.dataset.names("test")[0])
    shares = run.probabilities(sample.rgb, sample.thermal)
    assert (shares.shape, shares.dtype) == ((9, 48, 64), np.float32)
    np.testing.assert_allclose(shares.sum(0), 1, atol=1e-5)
    np.testing.assert_array_equal(shares.argmax(0), run.predict(sample.rgb, sample.thermal))
    thermals = (sample.thermal, 255 - sample.thermal)
    by_rgb = [run.probabilities(sample.rgb, thermal, modality="rgb") for thermal in thermals]
    np.testing.assert_array_equal(*by_rgb)
    assert rgbt.load_run(run.key, runs_dir=run.folder.parent) == run
    assert (run.experiment, run.seed) == ("crm", 0)
    recorded = {name: s for name, s in run.recorded_scores().items() if name.startswith("test/")}
    assert {f"test/{name}": s for name, s in run.scores().items()} == pytest.approx(recorded)


def test_own_classes_are_refused_until_their_module_is_trusted(
    run: rgbt.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "abc"
    shutil.copytree(run.folder, folder)
    config = folder / "config.yaml"
    loss = "rgbt.losses.set_criterion.SetCriterion"
    edit_config(folder, loss, "api_lab.MyLoss")
    best = read_torch_file(folder / "best.pt")
    best[NOTE] = {"key": folder.name, "settings": settings_digest(read_settings(config))}
    save(folder / "best.pt", best)
    with pytest.raises(InputError, match=r"names api_lab\.MyLoss.* add trust=api_lab\."):
        rgbt.load_run(folder)
    (tmp_path / "api_lab.py").write_text(
        "from rgbt.losses.set_criterion import SetCriterion\n\n\nclass MyLoss(SetCriterion): ...\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    trusted = rgbt.load_run(folder, trust="api_lab")
    np.testing.assert_array_equal(trusted.predict(RGB, THERMAL), run.predict(RGB, THERMAL))


def test_results_are_those_of_finished_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "runs"
    write_run(runs / "aaa", "crm", 0)
    write_run(runs / "bbb", "grbm", 1)
    write_run(runs / "ccc", "grbm", 2, finished=False)
    write_run(runs / "replaced" / "aaa-1", "crm", 0)
    frame = rgbt.results(runs, tmp_path)
    assert capsys.readouterr().err == ""  # a run that still trains is no remark
    assert list(frame["run"].unique()) == ["aaa", "bbb"]
    means = frame[(frame["metric"] == "mIoU") & (frame["region"] == 0)]
    found = means.set_index(["experiment", "subset"])["value"]
    assert found["grbm", "night"] == value("night/mIoU", some_counts(1), "released")
