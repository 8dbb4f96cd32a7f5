"""The commands as a user calls them: end to end, resumed, killed, on replaced files."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt import evaluate, predict
from rgbt.checks import InputError
from rgbt.engine.checkpoint import load_checkpoint
from rgbt.metrics.counts import Counts
from rgbt.run import main
from rgbt.tracking.run_folder import find_run
from tests.checkpoints.test_stored import same
from tests.commands import (
    SPLITS,
    Call,
    Trained,
    assert_one_sentence,
    logged,
    losses,
    only_run,
    short,
    train,
    words_of,
)

ROOT = Path(__file__).resolve().parents[1]

ADAPTATION = (
    *("sh_", "self_training", "multi_head", "heatnet", "rgb_teacher", "thermal_teacher"),
    *("start_deeplabv2", "start_pspnet", "start_semseg"),
)
"""Beginnings of experiments on days and nights: `tests/test_adaptation_run.py`."""

METHODS = ("crm", "grbm", "spatialseg")
ELSEWHERE = [f"{method}_{dataset}" for method in METHODS for dataset in ("kp", "pst900")]
"""Experiments that are others' on another data set: `tests/test_recipes.py`."""

EXPERIMENTS = sorted(path.stem for path in (ROOT / "conf" / "experiment").glob("*.yaml"))


LIKE_ANOTHER = (
    *("crm", "grbm_released", "spatialseg", "cmx_released", "temporal_con"),
    *("rtfnet_152", "rtfnet_152_temporal_con"),
)
"""Experiments with the network, scheme and loss of one that is trained here or in tests below, and
other values. Common starts are their network's experiment on other scenes. Both are slow."""


def trained_here(name: str) -> Any:
    is_slow = name in LIKE_ANOTHER or name.startswith("start_")
    return pytest.param(name, marks=pytest.mark.slow if is_slow else ())


@pytest.mark.parametrize(
    "experiment",
    [
        trained_here(name)
        for name in EXPERIMENTS
        if not name.startswith(ADAPTATION) and name not in ELSEWHERE
    ],
)
def test_every_experiment_trains_evaluates_and_writes_its_folder(
    call: Call, data: Path, tmp_path: Path, experiment: str
) -> None:
    unmasked = not experiment.startswith(METHODS)
    patch = ["masker.patch_size=null"] if unmasked else []
    code, out, err = train(call, data, tmp_path, f"+experiment={experiment}", *patch, *short(2))
    assert code == 0, err
    assert all(word in out for word in ("IoU1", "mIoU", "unlabeled"))
    folder = only_run(tmp_path)
    counts = Counts.load(folder / "counts_test.npz")
    assert counts.names == tuple(SPLITS["test"])
    assert counts.counts.sum() == 3 * 48 * 64
    written = {path.name for path in folder.iterdir()}
    assert {"config.yaml", "metrics.jsonl", "provenance.json", "tables.json", "best.pt"} <= written
    lines = logged(folder)
    assert [(line["kind"], line["step"]) for line in lines] == [
        *(("train", 1), ("train", 2), ("val", 2), ("test", 2))
    ]
    assert {"loss", "grad_norm", "images_per_s", "wait_share"} <= set(lines[0]["values"])


@pytest.mark.usefixtures("pictures")
def test_finished_run_shows_its_tables_again(call: Call, data: Path, tmp_path: Path) -> None:
    words = (data, tmp_path, "+experiment=grbm", *short(1))
    first = train(call, *words)
    for picture in ("panel.png", "regions.png"):
        assert (only_run(tmp_path) / "figures" / picture).stat().st_size > 1000
    again = train(call, *words)
    assert again[:2] == (0, first[1])
    assert "is already finished" in again[2]
    # The default, typed: the same run, shown under the name that says more.
    for more in (["masker.sigma_div=4"], []):
        assert "is already finished" in train(call, *words, *more)[2]
        assert "sigma_div=4" in json.loads((only_run(tmp_path) / "run.json").read_text())["name"]


def test_seed_decides_losses_and_key(
    call: Call, data: Path, trained: Trained, tmp_path: Path
) -> None:
    first = trained("+experiment=crm", *short(1))
    for seed in (0, 1):
        train(call, data, tmp_path / str(seed), "+experiment=crm", f"seed={seed}", *short(1))
    same, other = only_run(tmp_path / "0"), only_run(tmp_path / "1")
    assert (same.name, losses(same)) == (first.name, losses(first))
    assert other.name != first.name
    assert losses(other) != losses(first)


def test_seeds_of_every_source_together_are_the_seed(
    call: Call, data: Path, trained: Trained, tmp_path: Path
) -> None:
    first = losses(trained("+experiment=crm", *short(1)))
    all_three = ("seeds.weights=0", "seeds.order=0", "seeds.masks=0")
    for name, seeds in (("same", all_three), ("masks", all_three[:2])):
        train(call, data, tmp_path / name, "+experiment=crm", "seed=1", *seeds, *short(1))
    assert losses(only_run(tmp_path / "same")) == first
    assert losses(only_run(tmp_path / "masks")) != first


@pytest.mark.parametrize("averaging", [pytest.param("none", marks=pytest.mark.slow), "ema"])
def test_killed_run_resumed_equals_uninterrupted(
    call: Call, data: Path, tmp_path: Path, averaging: str
) -> None:
    overrides = ("+experiment=grbm", f"trainer.averaging={averaging}", *short(6))

    def run() -> None:
        sys.argv = ["rgbt", *words_of(data, tmp_path / "killed", *overrides)]
        main()

    process = multiprocessing.get_context("fork").Process(target=run)
    process.start()
    deadline = time.monotonic() + 120
    while not any('"step": 3' in p.read_text() for p in tmp_path.glob("killed/*/metrics.jsonl")):
        assert time.monotonic() < deadline, "step 3 was not reached"
        time.sleep(0.02)
    process.kill()
    process.join()
    (folder,) = (path.parent for path in (tmp_path / "killed").glob("*/metrics.jsonl"))
    assert not (folder / "result.json").exists()

    code, _, err = train(call, data, tmp_path / "killed", *overrides)
    assert code == 0, err
    assert "resumes at step" in err
    train(call, data, tmp_path / "straight", *overrides)
    resumed, straight = only_run(tmp_path / "killed"), only_run(tmp_path / "straight")
    assert resumed.name == straight.name
    for split in ("val", "test"):
        a, b = (Counts.load(f / f"counts_{split}.npz").counts for f in (resumed, straight))
        assert np.array_equal(a, b)
    ends = [load_checkpoint(each / "last.pt") for each in (resumed, straight)]
    assert same(ends[0]["model"], ends[1]["model"])
    assert same(ends[0].get("unaveraged"), ends[1].get("unaveraged"))
    assert [line["step"] for line in logged(resumed, "train")] == list(range(1, 7))


def test_unreadable_files_are_skipped_on_request(call: Call, data: Path, tmp_path: Path) -> None:
    """A training image, and the first test image, which is looked at before the run."""
    spoiled = ["00003N", SPLITS["test"][0]]
    for name in spoiled:
        path = data / "images" / f"{name}.png"
        path.write_bytes(path.read_bytes()[:100])
    words = ("+experiment=temporal_con", "masker.patch_size=null", "data.on_error=skip", *short(4))
    code, _, err = train(call, data, tmp_path / "runs", *words)
    assert code == 0, err
    folder = only_run(tmp_path / "runs")
    assert sorted(json.loads((folder / "result.json").read_text())["skipped"]) == sorted(spoiled)
    counts = Counts.load(folder / "evaluations" / "consistency_aligned_test.npz")
    assert counts.names == tuple(SPLITS["test"][1:])


@pytest.fixture
def runs(trained: Trained, tmp_path: Path) -> Path:
    """A `runs_dir` with one finished run: crm, one step, on files equal to those of `data`."""
    done = trained("+experiment=crm", *short(1))
    shutil.copytree(done, tmp_path / "runs" / done.name)
    return tmp_path / "runs"


def test_unfinished_run_on_other_images_is_refused(call: Call, data: Path, runs: Path) -> None:
    (only_run(runs) / "result.json").unlink()
    # A replaced file is mentioned ...
    path = data / "images" / "00003N.png"
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    image[:24] = 0
    assert cv2.imwrite(str(path), image)
    code, _, err = train(call, data, runs, "+experiment=crm", *short(1))
    assert code == 0, err
    assert "have changed since this run was started" in err
    # ... and a changed list is another data set.
    (only_run(runs) / "result.json").unlink()
    (data / "train.txt").write_text("\n".join(SPLITS["train"][:-1]) + "\n")
    code, _, err = train(call, data, runs, "+experiment=crm", *short(1))
    assert code == 2
    assert_one_sentence(err, "was started on other images")


def test_evaluate_and_predict_a_finished_run(
    call: Call, data: Path, runs: Path, tmp_path: Path
) -> None:
    folder = only_run(runs)
    requests = {
        "rgbt_ring5": (f"run={folder}",),
        "rgb_ring9": (f"run={folder.name}", f"runs_dir={runs}", "modality=rgb", "regions=ring9"),
        "rgbt_ring5_last": (f"run={folder}", "checkpoint=last"),
    }
    for name, words in requests.items():
        code, out, err = call(evaluate.entry, *words)
        assert code == 0, err
        assert ("IoU9" in out) == name.endswith("ring9")
        assert (folder / "evaluations" / f"mfnet_test_{name}.npz").exists()
    for name in ("rgbt_ring5", "rgbt_ring5_last"):  # one step: the last one is the best one
        stored = Counts.load(folder / "evaluations" / f"mfnet_test_{name}.npz")
        assert np.array_equal(stored.counts, Counts.load(folder / "counts_test.npz").counts)

    other = tmp_path / "images"
    other.mkdir()
    (other / "a.png").write_bytes((data / "images" / "00201D.png").read_bytes())
    words = (f"run={folder}", f"input={other}")
    code, _, err = call(predict.entry, *words, f"out={tmp_path / 'out'}")
    assert code == 0, err
    classes = cv2.imread(str(tmp_path / "out" / "a.png"), cv2.IMREAD_UNCHANGED)
    assert classes.shape == (48, 64)
    assert classes.max() < 9
    assert cv2.imread(str(tmp_path / "out" / "a_overlay.png")).shape == (48, 64, 3)

    before = (other / "a.png").read_bytes()
    code, _, err = call(predict.entry, *words, f"out={other}")
    assert code == 2
    assert_one_sentence(err, "would be overwritten")
    assert (other / "a.png").read_bytes() == before


@pytest.mark.slow
def test_multirun_finishes_the_other_points_when_one_is_wrong(
    call: Call, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sweeps.worker import executors

    monkeypatch.setattr(executors, "PRELOADED", ("torch", "hydra"))  # MLflow is not used here
    code, _, err = train(
        call, data, tmp_path, "-m", "+experiment=grbm", "masker.patch_size=40,32,64", *short(1)
    )
    assert code == 1
    assert "1 of 3 points failed, first patch_size=40: " in err
    assert len(list(tmp_path.glob("*/result.json"))) == 2


def test_run_is_not_matched_by_part_of_a_name(tmp_path: Path) -> None:
    folder = tmp_path / "abc"
    folder.mkdir()
    (folder / "config.yaml").write_text("")
    (folder / "mlflow.json").write_text('{"run_id": "f00", "experiment": "rgbt"}')
    assert find_run("f00", tmp_path) == find_run("abc", tmp_path) == folder
    with pytest.raises(InputError, match="run=rgbt is neither"):
        find_run("rgbt", tmp_path)


def test_help_needs_neither_torch_nor_mlflow() -> None:
    script = (
        "import sys, runpy\nsys.argv = ['rgbt', '--help']\n"
        "try:\n    runpy.run_module('rgbt.run', run_name='__main__')\n"
        "except SystemExit as left:\n    assert not left.code\n"
        "heavy = {'torch', 'mlflow', 'pandas', 'matplotlib'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert "+experiment=grbm" in done.stdout


SHARED = Path(os.environ.get("RGBT_SHARED", ROOT.parent / "shared"))


@pytest.mark.slow
@pytest.mark.skipif(not (SHARED / "realdata" / "mfnet200").exists(), reason="reference material")
def test_real_pairs_train_and_evaluate_like_the_embedded_data(call: Call, tmp_path: Path) -> None:
    real = SHARED / "realdata" / "mfnet200"
    code, out, err = call(
        *(main, "+experiment=grbm", "dataset=mfnet", f"dataset.root={real}", "tracking=none"),
        *("dataset.splits.test=val.txt", f"runs_dir={tmp_path}", "trainer.threads=2", *short(2)),
    )
    assert code == 0, err
    counts = Counts.load(only_run(tmp_path) / "counts_test.npz")
    assert counts.counts.shape == (100, 5, 9, 9)
    assert counts.counts.sum() == 100 * 480 * 640
    # Labelled pixels per class of these 100 images, counted independently of this project.
    labelled = [29157290, 176251, 290344, 553653, 108846, 134539, 0, 223949, 75128]
    assert counts.whole().sum(1).tolist() == labelled
