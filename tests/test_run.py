"""The commands as a user calls them: end to end, resumed, killed, and with bad input."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbt.metrics.counts import Counts
from tests.commands import (
    SMALL,
    SPLITS,
    Call,
    Trained,
    assert_one_sentence,
    only_run,
    short,
    train,
    words_of,
)

ROOT = Path(__file__).resolve().parents[1]


ADAPTATION = ("sh_", "multi_head", "heatnet", "rgb_teacher", "thermal_teacher")
"""Beginnings of experiments on days and nights: `tests/test_adaptation_run.py`."""

METHODS = ("crm", "grbm", "spatialseg")
ELSEWHERE = [f"{method}_{dataset}" for method in METHODS for dataset in ("kp", "pst900")]
"""Experiments that are others' on another data set: `tests/test_recipes.py`."""

EXPERIMENTS = sorted(path.stem for path in (ROOT / "conf" / "experiment").glob("*.yaml"))


@pytest.mark.parametrize(
    "experiment",
    [name for name in EXPERIMENTS if not name.startswith(ADAPTATION) and name not in ELSEWHERE],
)
def test_every_experiment_trains_evaluates_and_leaves_its_folder(
    call: Call, data: Path, tmp_path: Path, experiment: str
) -> None:
    unmasked = not experiment.startswith(METHODS)
    patch = ["masker.patch_size=null"] if unmasked else []
    code, out, err = train(call, data, tmp_path, f"+experiment={experiment}", *patch, *short(2))
    assert code == 0, err
    assert "IoU1" in out
    assert "mIoU" in out
    assert "unlabeled" in out
    folder = only_run(tmp_path)
    counts = Counts.load(folder / "counts_test.npz")
    assert counts.names == tuple(SPLITS["test"])
    assert counts.counts.sum() == 3 * 48 * 64
    written = {path.name for path in folder.iterdir()}
    assert {"config.yaml", "metrics.jsonl", "provenance.json", "tables.json", "best.pt"} <= written
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [(line["kind"], line["step"]) for line in lines] == [
        *(("train", 1), ("train", 2), ("val", 2), ("test", 2))
    ]
    assert {"loss", "grad_norm", "images_per_s", "wait_share"} <= set(lines[0]["values"])


@pytest.mark.usefixtures("pictures")
def test_a_finished_run_says_so_and_shows_its_tables(
    call: Call, data: Path, tmp_path: Path
) -> None:
    first = train(call, data, tmp_path, "+experiment=grbm", *short(1))
    for picture in ("panel.png", "regions.png"):
        assert (only_run(tmp_path) / "figures" / picture).stat().st_size > 1000
    again = train(call, data, tmp_path, "+experiment=grbm", *short(1))
    assert again[0] == 0
    assert "is finished" in again[2]
    assert again[1] == first[1]
    # The default, typed: the same run, shown under the name that says more.
    typed = train(call, data, tmp_path, "+experiment=grbm", "masker.sigma_div=4", *short(1))
    assert "is finished" in typed[2]
    assert "sigma_div=4" in json.loads((only_run(tmp_path) / "run.json").read_text())["name"]
    train(call, data, tmp_path, "+experiment=grbm", *short(1))
    assert "sigma_div=4" in json.loads((only_run(tmp_path) / "run.json").read_text())["name"]


def test_the_same_seed_gives_the_same_losses_and_another_seed_another_run(
    call: Call, data: Path, tmp_path: Path
) -> None:
    losses = {}
    for where, seed in (("a", 0), ("b", 0), ("c", 1)):
        train(call, data, tmp_path / where, "+experiment=crm", f"seed={seed}", *short(2))
        text = (only_run(tmp_path / where) / "metrics.jsonl").read_text().splitlines()
        losses[where] = [json.loads(line)["values"].get("loss") for line in text]
    assert losses["a"] == losses["b"]
    assert losses["a"] != losses["c"]
    assert only_run(tmp_path / "a").name == only_run(tmp_path / "b").name
    assert only_run(tmp_path / "a").name != only_run(tmp_path / "c").name


def command(data: Path, runs: Path, *overrides: str) -> list[str]:
    return [sys.executable, "-m", "rgbt.run", *words_of(data, runs, *overrides)]


def test_killed_and_continued_equals_uninterrupted(call: Call, data: Path, tmp_path: Path) -> None:
    overrides = ("+experiment=grbm", *short(8))
    process = subprocess.Popen(
        command(data, tmp_path / "killed", *overrides),
        cwd=ROOT,
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )
    wait_for_step(tmp_path / "killed", 3)
    process.send_signal(signal.SIGKILL)
    process.wait()
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
    steps = [json.loads(line) for line in (resumed / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in steps if line["kind"] == "train"] == list(range(1, 9))


def wait_for_step(runs: Path, step: int, seconds: float = 120.0) -> None:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        text = "".join(path.read_text() for path in runs.glob("*/metrics.jsonl"))
        if f'"step": {step}' in text:
            return
        time.sleep(0.02)
    pytest.fail(f"step {step} was not reached in {seconds} s")


BAD_OVERRIDES = {
    "unknown experiment": (["+experiment=gbrm"], "no experiment 'gbrm'; did you mean 'grbm'?"),
    "unknown option": (["masker=grm"], "there is no masker 'grm'"),
    "misspelt group": (["optimiser=adamw"], "optimiser"),
    "misspelt key": (["optimizer.lrr=1"], "'optimizer.lrr' is not a key"),
    "misspelt key after plus": (["+optimizer.lrr=1"], "'optimizer.lrr' is not a setting"),
    "misspelt deep key": (["+loss.spatial.alfa=1"], "'loss.spatial.alfa' is not a setting"),
    "misspelt top-level key": (["+sead=1"], "'sead' is not a key of the configuration"),
    "word for a number": (["optimizer.lr=fast"], "'optimizer.lr'"),
    "number for a choice": (["schedule.per=week"], "'schedule.per'"),
    "fraction for a count": (["trainer.accumulate=1.5"], "'trainer.accumulate'"),
    "collaborator as a setting": (["+scheme.model=1"], "'scheme.model'"),
    "negative rate": (["optimizer.lr=-1"], "'optimizer.lr' must be a number above 0 and"),
    "negative warm-up": (
        ["schedule.warmup_steps=-5"],
        "'schedule.warmup_steps' must be a whole number from 0",
    ),
    "no thread": (["trainer.threads=0"], "'trainer.threads' must be a whole number from 1"),
    "no such device": (["trainer.accelerator=mps"], "trainer.accelerator=mps"),
    "other number of classes": (["model.num_classes=5"], "model.num_classes is 5"),
    "no override": (["learning rate 3"], "expected key=value"),
    "unknown selection split": (["trainer.selection_split=vall"], "no split 'vall'"),
    "not a number": (["trainer.clip_norm=nan"], "'trainer.clip_norm' must be a number above 0"),
    "picture of a run": (["out=x.png"], "omit out=..."),
    "missing root": (["dataset=mfnet", "~dataset.root"], "'dataset.root'"),
    "root without value": (["dataset=mfnet", "dataset.root=???"], "'dataset.root' has no value"),
    "no such folder": (["dataset.root=/no/such"], "dataset.root: there is no folder '/no/such'"),
    "patch that does not divide": (["masker.patch_size=48"], "masker.patch_size"),
    "patch of no tokens": (["masker.patch_size=6"], "masker.patch_size"),
    "distillation without masks": (
        ["masker=none", "scheme=crm"],
        "requires hides_cells=true of the masker, Masker provides hides_cells=false; choose mask",
    ),
    "batch above the split": (["data.batch_size=9"], "data.batch_size is 9"),
}


@pytest.mark.parametrize(("overrides", "sentence"), BAD_OVERRIDES.values(), ids=BAD_OVERRIDES)
def test_a_wrong_configuration_is_one_sentence_and_exit_code_2(
    call: Call, data: Path, tmp_path: Path, overrides: list[str], sentence: str
) -> None:
    start = [] if overrides[0].startswith("+exp") else ["+experiment=grbm"]
    given = [item for item in SMALL if item.partition("=")[0] != overrides[0].partition("=")[0]]
    if "masker=none" in overrides:
        given.remove("masker.patch_size=32")
    if overrides[0] != "dataset=mfnet":
        start.append("dataset=mfnet")
    if not any("dataset.root" in item for item in overrides):
        start.append(f"dataset.root={data}")
    from rgbt.run import main

    code, out, err = call(
        main, *start, f"runs_dir={tmp_path}", "tracking=none", *given, *overrides, *short(1)
    )
    assert code == 2, err
    assert_one_sentence(err, sentence)
    assert not list(tmp_path.glob("*/config.yaml")), "nothing is left behind"


def test_a_misspelt_key_in_an_experiment_file_is_refused(
    call: Call, data: Path, tmp_path: Path
) -> None:
    mine = tmp_path / "conf" / "experiment"
    mine.mkdir(parents=True)
    (mine / "mine.yaml").write_text("# @package _global_\ntrainer: {max_step: 3}\n")
    code, _, err = train(
        call, data, tmp_path, "+experiment=mine", f"hydra.searchpath=[file://{tmp_path / 'conf'}]",
        "masker.patch_size=null",
    )  # fmt: skip
    assert code == 2
    assert_one_sentence(err, "'trainer.max_step' is not a setting of")
    assert "did you mean 'max_steps'?" in err


def label_of_nine(data: Path) -> str:
    path = data / "labels" / "00003N.png"
    assert cv2.imwrite(str(path), np.full((48, 64), 9, np.uint8))
    return "label value 9 is out of range"


def other_size(data: Path) -> str:
    assert cv2.imwrite(str(data / "labels" / "00003N.png"), np.zeros((24, 32), np.uint8))
    return "RGB is 48x64 pixels but its label is 24x32"


def three_channels(data: Path) -> str:
    assert cv2.imwrite(str(data / "images" / "00003N.png"), np.zeros((48, 64, 3), np.uint8))
    return "expected 4 channels"


def corrupted(data: Path) -> str:
    path = data / "images" / "00003N.png"
    path.write_bytes(path.read_bytes()[:100])
    return "00003N.png cannot be decoded"


def no_test_list(data: Path) -> str:
    (data / "test.txt").unlink()
    return "there is no list"


def empty_split(data: Path) -> str:
    (data / "val.txt").write_text("\n")
    return "val.txt' is empty"


@pytest.mark.parametrize(
    "spoil", [label_of_nine, other_size, three_channels, corrupted, no_test_list, empty_split]
)
def test_bad_files_are_named_in_one_sentence(
    call: Call, data: Path, tmp_path: Path, spoil: Callable[[Path], str]
) -> None:
    sentence = spoil(data)
    code, _, err = train(call, data, tmp_path / "runs", "+experiment=crm", *short(4))
    assert code == 2, err
    assert_one_sentence(err, sentence)
    assert not list((tmp_path / "runs").glob("*/result.json"))


def test_an_unreadable_file_can_be_skipped_and_is_reported(
    call: Call, data: Path, tmp_path: Path
) -> None:
    corrupted(data)
    code, _, err = train(
        call, data, tmp_path / "runs", "+experiment=crm", "data.on_error=skip", *short(4)
    )
    assert code == 0, err
    result = json.loads((only_run(tmp_path / "runs") / "result.json").read_text())
    assert result["skipped"] == ["00003N"]


@pytest.fixture
def runs(trained: Trained, tmp_path: Path) -> Path:
    """A `runs_dir` with one finished run: crm, one step, on files equal to those of `data`."""
    done = trained("+experiment=crm", *short(1))
    shutil.copytree(done, tmp_path / "runs" / done.name)
    return tmp_path / "runs"


def test_runs_on_other_files_do_not_share_a_folder(call: Call, data: Path, runs: Path) -> None:
    (only_run(runs) / "result.json").unlink()
    (data / "train.txt").write_text("\n".join(SPLITS["train"][:-1]) + "\n")
    code, _, err = train(call, data, runs, "+experiment=crm", *short(1))
    assert code == 2
    assert_one_sentence(err, "was started on other images")


def test_a_replaced_file_is_mentioned_and_the_run_goes_on(
    call: Call, data: Path, runs: Path
) -> None:
    (only_run(runs) / "result.json").unlink()
    corrupted_and_repaired = data / "images" / "00003N.png"
    image = cv2.imread(str(corrupted_and_repaired), cv2.IMREAD_UNCHANGED)
    image[:24] = 0
    assert cv2.imwrite(str(corrupted_and_repaired), image)
    code, _, err = train(call, data, runs, "+experiment=crm", *short(1))
    assert code == 0, err
    assert "have changed since this run was started" in err


def test_evaluate_and_predict_a_stored_run(
    call: Call, data: Path, runs: Path, tmp_path: Path
) -> None:
    from rgbt import evaluate, predict

    folder = only_run(runs)
    evaluate_entry = evaluate.entry

    code, out, err = call(evaluate_entry, f"run={folder}")
    assert code == 0, err
    stored = Counts.load(folder / "evaluations" / "mfnet_test_rgbt_ring5.npz")
    assert np.array_equal(stored.counts, Counts.load(folder / "counts_test.npz").counts)

    code, out, err = call(
        evaluate_entry, f"run={folder.name}", f"runs_dir={runs}", "modality=rgb", "regions=ring9"
    )
    assert code == 0, err
    assert "IoU9" in out
    assert (folder / "evaluations" / "mfnet_test_rgb_ring9.npz").exists()

    code, out, err = call(evaluate_entry, f"run={folder}", "checkpoint=last")
    assert code == 0, err
    last = Counts.load(folder / "evaluations" / "mfnet_test_rgbt_ring5_last.npz")
    assert np.array_equal(last.counts, stored.counts)  # one step: the last one is the best one

    other = tmp_path / "images"
    other.mkdir()
    (other / "a.png").write_bytes((data / "images" / "00201D.png").read_bytes())
    code, out, err = call(
        predict.entry,
        *(f"run={folder}", f"input={other}", f"out={tmp_path / 'out'}"),
    )
    assert code == 0, err
    classes = cv2.imread(str(tmp_path / "out" / "a.png"), cv2.IMREAD_UNCHANGED)
    assert classes.shape == (48, 64)
    assert classes.max() < 9
    assert cv2.imread(str(tmp_path / "out" / "a_overlay.png")).shape == (48, 64, 3)

    before = (other / "a.png").read_bytes()
    code, out, err = call(predict.entry, f"run={folder}", f"input={other}", f"out={other}")
    assert code == 2
    assert_one_sentence(err, "would be overwritten")
    assert (other / "a.png").read_bytes() == before


def test_evaluate_refuses_what_does_not_fit(call: Call, runs: Path) -> None:
    from rgbt import evaluate

    folder = only_run(runs)
    entry = evaluate.entry
    cases = {
        ("run=nowhere",): "run=nowhere: neither a run folder",
        (f"run={folder}", "modality=infrared"): "modality: 'infrared' is not a choice",
        (f"run={folder}", "split=tset"): "no split 'tset'",
        (f"run={folder}", "checkpoint=first"): "'checkpoint' must be 'best' or 'last'",
        (f"run={folder}", "model.num_queries=3"): "'model.num_queries' cannot be changed",
        (f"run={folder}", "data.batch_siz=1"): "did you mean 'data.batch_size'?",
        (f"run={folder}", "scale=paper"): "'scale' cannot be changed of a finished run",
        (f"run={folder}", "model=mask2former_swin_t"): "'model' cannot be changed",
        (f"run={folder}", "data.eval_batch_size=[1"): "data.eval_batch_size cannot be read as YAML",
        (): "'run' has no value",
    }
    for arguments, sentence in cases.items():
        code, _, err = call(entry, *arguments)
        assert code == 2, err
        assert_one_sentence(err, sentence)

    (folder / "best.pt").rename(folder / "kept.pt")
    code, _, err = call(entry, f"run={folder}")
    assert code == 2
    assert_one_sentence(err, "has no best.pt: the run has not reached its first evaluation")


def test_a_checkpoint_of_another_model_is_refused(
    call: Call, data: Path, trained: Trained, tmp_path: Path
) -> None:
    folder = trained("+experiment=crm", *short(1))
    code, _, err = train(
        *(call, data, tmp_path / "other", "+experiment=crm", "model.num_queries=7"),
        *(f"model.weights={folder}", *short(1)),
    )
    assert code == 2
    assert_one_sentence(err, "does not fit this network")


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


def test_a_run_is_not_found_by_a_piece_of_text(tmp_path: Path) -> None:
    from rgbt.checks import InputError
    from rgbt.tracking.run_folder import find_run

    folder = tmp_path / "abc"
    folder.mkdir()
    (folder / "config.yaml").write_text("")
    (folder / "mlflow.json").write_text('{"run_id": "f00", "experiment": "rgbt"}')
    assert find_run("f00", tmp_path) == find_run("abc", tmp_path) == folder
    with pytest.raises(InputError, match="run=rgbt: neither"):
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
    from rgbt.run import main

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


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("+experiment=baseline", "model=cmx_tiny"), "or loss=cross_entropy."),
        (("+experiment=mfnet", "model=mask2former_tiny"), "or loss=set_criterion, set_"),
        (("+experiment=crm", "model=rtfnet_tiny", "loss=cross_entropy"), "scheme=supervised"),
    ],
)
def test_a_loss_or_scheme_that_does_not_fit_leaves_no_folder(
    call: Call, data: Path, tmp_path: Path, words: tuple[str, ...], sentence: str
) -> None:
    patch = [] if "+experiment=crm" in words else ["masker.patch_size=null"]
    code, _, err = train(call, data, tmp_path / "runs", *words, *patch, *short(1))
    assert code == 2
    assert_one_sentence(err, sentence)
    assert not (tmp_path / "runs").exists()
