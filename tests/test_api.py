"""Finished runs in Python: what `rgbt.load_run` and `rgbt.results` return and refuse."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest

import rgbt
from rgbt import predict
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from rgbt.tracking.run_files import Description, counts_name
from rgbt.tracking.run_folder import RunFolder
from tests.commands import Call, Trained, short

ONE = ("+experiment=crm", *short(1))
"""A run that several test files read."""

RGB = np.zeros((48, 64, 3), np.uint8)
THERMAL = np.zeros((48, 64), np.uint8)


@pytest.fixture(scope="module")
def run(trained: Trained) -> rgbt.Run:
    return rgbt.load_run(trained(*ONE))


def some_counts(seed: int, split: str = "test", night: tuple[bool, ...] = (False, True)) -> Counts:
    return Counts(
        counts=np.random.default_rng(seed).integers(0, 9, (2, 3, 2, 2)),
        names=("a", "b"),
        night=night,
        classes=("road", "car"),
        partition="ring3",
        dataset="f00d",
        split=split,
    )


def write_run(path: Path, group: str, seed: int, *, finished: bool = True) -> RunFolder:
    """What a run leaves, but for the network."""
    run = RunFolder(path)
    run.write_config("dataset:\n  _target_: rgbt.data.mfnet.MFNet\n")
    tags = {"rgbt.experiment": group, "rgbt.group": group, "rgbt.seed": str(seed)}
    run.describe(Description(f"seed={seed} · {group}", tags, {}))
    some_counts(seed).save(run.path / counts_name("test"))
    if finished:
        run.finish({"dataset": "f00d", "best_step": 120})
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


def test_probabilities_sum_to_one_and_agree_with_predict(run: rgbt.Run) -> None:
    sample = run.dataset.read(run.dataset.names("test")[0])
    shares = run.probabilities(sample.rgb, sample.thermal)
    assert (shares.shape, shares.dtype) == ((9, 48, 64), np.float32)
    np.testing.assert_allclose(shares.sum(0), 1, atol=1e-5)
    np.testing.assert_array_equal(shares.argmax(0), run.predict(sample.rgb, sample.thermal))


def test_modality_is_what_is_predicted_from(run: rgbt.Run) -> None:
    sample = run.dataset.read(run.dataset.names("test")[0])
    by_rgb = [
        run.probabilities(sample.rgb, thermal, modality="rgb")
        for thermal in (sample.thermal, 255 - sample.thermal)
    ]
    np.testing.assert_array_equal(*by_rgb)


def test_load_run_finds_folder_key_and_scores(run: rgbt.Run) -> None:
    again = rgbt.load_run(run.key, runs_dir=run.folder.parent)
    assert again == run
    assert (run.experiment, run.seed) == ("crm", 0)
    assert run.group.startswith("crm ")
    assert run.scores() == pytest.approx(
        {name: score for name, score in _of_split(run.files.scores(), "test").items()}
    )


def _of_split(scores: dict[str, float], split: str) -> dict[str, float]:
    return {name.removeprefix(f"{split}/"): s for name, s in scores.items() if split in name}


@pytest.mark.parametrize(
    ("act", "sentence"),
    [
        (lambda run: run.predict(RGB[..., 0], THERMAL), r"rgb: expected uint8 of shape"),
        (lambda run: run.predict(RGB / 255, THERMAL), r"rgb: .*got float64 of shape"),
        (lambda run: run.predict(RGB[:0], THERMAL[:0]), r"got uint8 of shape \(0, 64, 3\)"),
        (lambda run: run.predict(RGB, THERMAL[:9]), r"thermal: expected shape \(48, 64\)"),
        (lambda run: run.predict(RGB, THERMAL.astype(np.uint16)), "expected 8 bits per pixel"),
        (lambda run: run.predict(RGB.tolist(), THERMAL), "expected a NumPy array, got list"),
        (lambda run: run.predict(RGB, "thermal.png"), "got str.* the paths of both files"),
        (lambda run: run.predict("no.png", "no.png"), r"no\.png is missing"),
        (lambda run: run.predict(RGB, THERMAL, modality="depth"), "modality: 'depth' is not a"),
        (lambda run: run.predict(RGB, THERMAL, head="day"), "head: 'day' is not a valid choice"),
        (lambda run: run.counts("tset"), "test, val, but not of 'tset'; .*rgbt evaluate run=/"),
        (
            lambda run: rgbt.load_run("none", runs_dir=run.folder),
            "run=none is neither a run folder",
        ),
        (lambda run: rgbt.load_run(run.folder, checkpoint="first"), "checkpoint: 'first' is not"),
        (lambda run: rgbt.load_run(run.folder, "data.cache=auto"), "expected a list of overrides"),
        (
            lambda run: rgbt.load_run(run.folder, ["model=mfnet"]),
            "'model' of a finished run cannot be changed",
        ),
        (lambda run: rgbt.results(run.folder / "none"), "none does not exist"),
    ],
)
def test_bad_input_is_one_sentence(
    run: rgbt.Run, act: Callable[[rgbt.Run], Any], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence) as raised:
        act(run)
    assert "\n" not in str(raised.value)


def test_own_classes_are_refused_until_their_module_is_trusted(
    run: rgbt.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "abc"
    shutil.copytree(run.folder, folder)
    text = (folder / "config.yaml").read_text()
    assert "rgbt.losses.set_criterion.SetCriterion" in text
    own = text.replace("rgbt.losses.set_criterion.SetCriterion", "api_lab.MyLoss")
    (folder / "config.yaml").write_text(own)
    with pytest.raises(InputError, match=r"names api_lab\.MyLoss.* add trust=api_lab\."):
        rgbt.load_run(folder)
    (tmp_path / "api_lab.py").write_text(
        "from rgbt.losses.set_criterion import SetCriterion\n\n\nclass MyLoss(SetCriterion): ...\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    trusted = rgbt.load_run(folder, trust="api_lab")
    np.testing.assert_array_equal(trusted.predict(RGB, THERMAL), run.predict(RGB, THERMAL))


def test_unfinished_run_says_what_is_missing(run: rgbt.Run, tmp_path: Path) -> None:
    shutil.copy(run.folder / "config.yaml", tmp_path)
    unfinished = rgbt.load_run(tmp_path)
    with pytest.raises(InputError, match=r"splits none, but not of 'test'; rerun the command"):
        unfinished.counts()
    with pytest.raises(InputError, match=r"has no best\.pt.* rerun its command"):
        unfinished.predict(RGB, THERMAL)


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    runs = tmp_path / "runs"
    write_run(runs / "aaa", "crm", 0)
    write_run(runs / "bbb", "grbm", 1)
    write_run(runs / "ccc", "grbm", 2, finished=False)
    write_run(runs / "replaced" / "aaa-1", "crm", 0)
    return runs


def test_results_is_one_row_per_finished_run(runs: Path) -> None:
    results = rgbt.results(runs)
    assert [run.key for run in results] == ["aaa", "bbb"]
    assert len(results) == 2
    table = results.to_pandas()
    row = table.iloc[1]
    identity = ("bbb", "seed=1 · grbm", "grbm", "grbm", 1, "mfnet", "test", 120)
    assert tuple(row.iloc[:8]) == identity
    counts = some_counts(1)
    for name in ("mIoU", "Var", "region/3", "class/car", "night/mIoU"):
        assert row[name] == pytest.approx(value(name, counts, "released"))


def test_long_results_have_a_row_per_region_and_class(runs: Path) -> None:
    table = rgbt.results(runs).to_pandas(long=True)
    assert len(table) == 2 * (1 + 3) * 2
    chosen = table.set_index(["key", "region", "class"]).loc[("bbb", 3, "car")]
    counts = some_counts(1)
    assert chosen["IoU"] == pytest.approx(value("class/car/region/3", counts, "released"))
    whole = table.query("key == 'bbb' and region == 0 and `class` == 'road'")
    assert whole["Acc"].item() == pytest.approx(value("class/road/acc", counts, "released"))


def test_results_leave_unreadable_runs_out_with_a_warning(
    runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    replace(some_counts(1), split="val").save(runs / "bbb" / counts_name("val"))
    assert list(rgbt.results(runs).to_pandas("val")["key"]) == ["bbb"]
    assert "warning: aaa is left out: " in capsys.readouterr().err
    (runs / "aaa" / counts_name("test")).write_bytes(b"PK")
    assert list(rgbt.results(runs).to_pandas()["key"]) == ["bbb"]
    assert "aaa is left out" in capsys.readouterr().err


def test_results_of_an_empty_folder_are_an_empty_table(tmp_path: Path) -> None:
    table = rgbt.results(tmp_path).to_pandas()
    assert isinstance(table, pd.DataFrame)
    assert table.empty
    assert list(table.columns[:2]) == ["key", "name"]
