"""The commands as a user calls them: end to end, resumed, killed, on replaced files."""

from __future__ import annotations

import json
import multiprocessing
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from rgbt import evaluate, predict
from rgbt.assembly.load_run import open_run
from rgbt.assembly.training_setup import set_up_training
from rgbt.checkpoints.files import save
from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.data.file_dataset import FileDataset
from rgbt.dataset import reader_of
from rgbt.engine.checkpoint import load_checkpoint
from rgbt.evaluation.export import with_range
from rgbt.files.plain_files import write_json
from rgbt.metrics.counts import Counts
from rgbt.run import main
from rgbt.runs.specify import specify
from tests.checkpoints.test_torch_files import same
from tests.commands import (
    DAYS_AND_NIGHTS,
    ON_CPU,
    SMALL,
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
from tests.composed import specified
from tests.conftest import write_png
from tests.data.layouts import (
    PATTERNS,
    folder,
    write_any,
    write_folder,
    write_freiburg,
    write_kp,
)

NO_PATCH = "masker.patch_size=null"
SMALL_SYNTH = (
    *("dataset.num_train=3", "dataset.num_val=3", "dataset.num_test=3"),
    *("dataset.height=48", "dataset.width=64", *SMALL),
)
ON_DATA = {
    **{name: (NO_PATCH,) for name in ("baseline", "mfnet")},
    **{name: (NO_PATCH,) for name in ("dinov2", "temporal_con_released")},
    "grbm": (),
    "spatialseg_released": (),
    "crm_pst900": ("dataset=synth_pst900", *SMALL_SYNTH),
    "spatialseg_kp": ("dataset=synth_kp", *SMALL_SYNTH),
}
"""One experiment for each scheme and kind of network; `tests/test_behaviour.py` has all."""


@pytest.mark.parametrize("experiment", ON_DATA)
def test_experiment_trains_and_counts_every_pixel(trained: Trained, experiment: str) -> None:
    folder = trained(f"+experiment={experiment}", *ON_DATA[experiment], *short(2))
    counts = Counts.load(folder / "counts_test.npz")
    assert len(counts.names) == 3
    # Void of KP does not count.
    assert (counts.counts.sum() == 3 * 48 * 64) != experiment.endswith("_kp")
    written = {path.name for path in folder.iterdir()}
    assert {"config.yaml", "metrics.jsonl", "provenance.json", "tables.json", "best.pt"} <= written
    lines = logged(folder)
    assert [(line["kind"], line["step"]) for line in lines] == [
        *(("train", 1), ("train", 2), ("val", 2), ("test", 2))
    ]
    assert {"loss", "grad_norm", "images_per_s", "wait_share"} <= set(lines[0]["values"])


OWN = (
    *(f"dataset.{key}='{text}'" for key, text in PATTERNS.items()),
    *("dataset.num_classes=3", "dataset.classes=[background,person,car]"),
    *("dataset.thermal_range=[20000,24000]", "metric.regions=2"),
)
FREIBURG = ("dataset.crop=null", "dataset.val_sequences=[seq_04_day]")
FILES: dict[str, tuple[Callable[[Path], Path], tuple[str, ...]]] = {
    "kp": (write_kp, ()),
    "freiburg": (write_freiburg, FREIBURG),
    "folder": (write_folder, OWN),
}


@pytest.mark.slow
@pytest.mark.parametrize("dataset", FILES)
def test_smoke_runs_on_files_of_every_layout(call: Call, tmp_path: Path, dataset: str) -> None:
    write, own = FILES[dataset]
    words = (f"dataset={dataset}", f"dataset.root={write(tmp_path / 'data')}", *own, *ON_CPU)
    smoke = (
        "+experiment=grbm",
        "+debug=smoke",
        "masker.patch_size=32",
        f"runs_dir={tmp_path / 'runs'}",
    )
    code, _, err = call(main, *smoke, *words)
    assert code == 0, err
    assert len(logged(only_run(tmp_path / "runs"), "train")) == 2


@pytest.mark.usefixtures("pictures")
def test_labels_of_one_class_have_no_score(call: Call, tmp_path: Path) -> None:
    """Said before the training and beside the tables; the last weights are tested."""
    root = write_folder(tmp_path / "data")
    for path in root.glob("*/mask/*.png"):
        write_png(path, np.where(np.eye(6, 8) > 0, 255, 0).astype(np.uint8))
    data = ("dataset=folder", f"dataset.root={root}", f"runs_dir={tmp_path / 'runs'}")
    words = ("+experiment=grbm", "+debug=smoke", "masker.patch_size=32", *data, *OWN, *ON_CPU)
    code, _, err = call(main, *words)
    assert code == 2
    assert_one_sentence(err, "write ids: {0: background, 255: person}")
    code, out, err = call(main, *words, "dataset.ignored=[255]")
    assert code == 0, err
    assert "train, val, test: the labels show 'background' alone" in err
    assert "labels of a single class in the test split: a mean over classes is undefined" in out
    result = json.loads((only_run(tmp_path / "runs") / "result.json").read_text())
    assert result["test"]["mIoU"] is None
    assert result["test"]["class/background"] is not None
    assert (result["best_step"], "best_score" in result) == (2, False)


@pytest.mark.usefixtures("pictures")
def test_finished_run_shows_its_tables_again(call: Call, data: Path, tmp_path: Path) -> None:
    words = (data, tmp_path, "+experiment=grbm", *short(1))
    code, out, err = train(call, *words)
    assert code == 0, err
    for picture in ("panel.png", "regions.png", "best.png", "worst.png"):
        assert (only_run(tmp_path) / "figures" / picture).stat().st_size > 1000
    # The default, typed: the same run.
    code, again, err = train(call, *words, "masker.sigma_div=4")
    assert code == 0, err
    assert "is already finished" in err
    assert next(line for line in out.splitlines() if "mIoU" in line) in again


@pytest.mark.slow
def test_seeds_decide_losses_and_key(trained: Trained) -> None:
    def run(*words: str) -> tuple[str, list[dict[str, float]]]:
        folder = trained("+experiment=crm", *words, *short(1))
        return folder.name, losses(folder)

    sources = ("weights", "order", "masks")
    zeros = [f"seeds.{each}=0" for each in sources]
    first = run()
    assert run("seed=0") == run("seed=1", *zeros) == first
    for others in ("seed=1", *(f"seeds.{each}=1" for each in sources)):
        key, steps = run(others)
        assert key != first[0]
        assert steps != first[1], others


KILLED = ("+experiment=sh_adversarial", "model.weights=null", *DAYS_AND_NIGHTS)


@pytest.mark.slow
@pytest.mark.parametrize("words", [("+experiment=grbm", "trainer.averaging=ema"), KILLED])
def test_killed_run_resumed_equals_uninterrupted(
    call: Call, data: Path, trained: Trained, tmp_path: Path, words: tuple[str, ...]
) -> None:
    """Which has loader workers, that draw the same."""
    overrides = (*words, *short(6))
    arguments = words_of(data, tmp_path, *overrides)
    resumed = specified(tuple(arguments)).folder

    def run() -> None:
        sys.argv = ["rgbt", *arguments]
        main()

    process = multiprocessing.get_context("fork").Process(target=run)
    process.start()
    lines, deadline = resumed / "metrics.jsonl", time.monotonic() + 240
    while not (lines.exists() and '"step": 3' in lines.read_text()):
        assert time.monotonic() < deadline, "step 3 was not reached"
        time.sleep(0.02)
    process.kill()
    process.join()
    assert not (resumed / "result.json").exists()
    code, _, err = train(call, data, tmp_path, *overrides)
    assert code == 0, err
    assert "resumes at step" in err
    straight = trained(*overrides, "data.num_workers=2")
    assert resumed.name == straight.name
    for split in ("val", "test"):
        a, b = (Counts.load(f / f"counts_{split}.npz").counts for f in (resumed, straight))
        assert np.array_equal(a, b)
    ends = [load_checkpoint(each / "last.pt") for each in (resumed, straight)]
    for part in ("model", "unaveraged", "others", "optimizers"):
        assert same(ends[0].get(part), ends[1].get(part)), part
    assert losses(resumed) == losses(straight)


def test_unreadable_files_are_skipped_on_request(call: Call, data: Path, tmp_path: Path) -> None:
    """A training image, and the first test image, which is looked at before the run."""
    spoiled = ["00003N", SPLITS["test"][0]]
    for name in spoiled:
        path = data / "images" / f"{name}.png"
        path.write_bytes(path.read_bytes()[:100])
    words = ("+experiment=temporal_con", NO_PATCH, "data.on_error=skip", *short(4))
    code, _, err = train(call, data, tmp_path / "runs", *words)
    assert code == 0, err
    folder = only_run(tmp_path / "runs")
    assert sorted(json.loads((folder / "result.json").read_text())["skipped"]) == sorted(spoiled)
    counts = Counts.load(folder / "evaluations" / "test_aligned3.npz")
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
    image: Any = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
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
    payload = load_checkpoint(folder / "last.pt")
    payload["model"] = {key: torch.zeros_like(each) for key, each in payload["model"].items()}
    save(folder / "last.pt", payload)
    requests = {
        f"out={tmp_path / 'again.npz'}": (f"run={folder}",),
        "rgb_ring9": (f"run={folder.name}", f"runs_dir={runs}", "modality=rgb", "regions=ring9"),
        "last-1": (f"run={folder}", "checkpoint=last"),
    }
    for name, words in requests.items():
        code, _, err = call(evaluate.entry, *words, *([name] if name.startswith("out=") else []))
        assert code == 0, err
    stored, again = (
        Counts.load(each / name)
        for each, name in ((folder, "counts_test.npz"), (tmp_path, "again.npz"))
    )
    assert np.array_equal(again.counts, stored.counts)
    assert again.measurement == stored.measurement
    of_rings, last = (
        Counts.load(folder / "evaluations" / f"test_{name}.npz") for name in ("rgb_ring9", "last-1")
    )
    assert (of_rings.partition, of_rings.measurement.view) == ("ring9", "rgb")
    # Without weights it predicts one class.
    assert np.count_nonzero(last.counts.sum((0, 1, 2))) == 1

    image = tmp_path / "images" / "a.png"
    image.parent.mkdir()
    shutil.copy(data / "images" / "00201D.png", image)
    before = image.read_bytes()
    words = (f"run={folder}", f"input={image.parent}")
    assert call(predict.entry, *words, f"out={image.parent}")[0] == 2
    assert image.read_bytes() == before
    code, _, err = call(predict.entry, *words, f"out={tmp_path / 'out'}")
    assert code == 0, err
    classes: Any = cv2.imread(str(tmp_path / "out" / "a.png"), cv2.IMREAD_UNCHANGED)
    assert (classes.shape, classes.max() < 9) == ((48, 64), True)
    assert (tmp_path / "out" / "a_overlay.png").exists()


def test_reported_where_test_images_select_the_best(call: Call, data: Path, tmp_path: Path) -> None:
    words = ("+experiment=crm", "dataset.splits.val=test.txt", *short(1))
    assert "trainer.selection_split=val" in train(call, data, tmp_path, *words)[2]


NIGHT = ("+experiment=multi_head_night", *DAYS_AND_NIGHTS, *short(2))


def evaluated(call: Call, folder: Path, *words: str) -> Counts:
    """Counts of `rgbt.evaluate` of a run folder."""
    out = folder.parent / "evaluated.npz"
    out.unlink(missing_ok=True)
    code, _, err = call(evaluate.entry, f"run={folder}", f"out={out}", *words)
    assert code == 0, err
    return Counts.load(out)


def scores_by_hand(counts: Counts) -> list[float]:
    """mIoU of all images, of the two by day and of the two at night; 0 of an absent class."""
    scores = []
    for images in (slice(None), slice(2), slice(2, None)):
        matrix = counts.counts[images].sum((0, 1))
        union = (matrix.sum(0) + matrix.sum(1) - np.diag(matrix))[:12]
        scores.append(float(np.mean(np.diag(matrix)[:12] / np.maximum(union, 1))))
    return scores


@pytest.mark.slow
def test_run_on_days_and_nights_counts_every_image(trained: Trained) -> None:
    folder = trained(*NIGHT)
    counts = Counts.load(folder / "counts_test.npz")
    cache = folder.parents[1] / "cache"
    dataset = build(compose([*DAYS_AND_NIGHTS, f"dataset.cache_dir={cache}"]).dataset)
    assert counts.names == dataset.names("test")
    assert counts.night == (False, False, True, True)
    assert counts.unscored == ("background", "ignore")
    labels = np.stack([dataset.read(name).label for name in counts.names])
    assert counts.counts.sum() == (labels != 255).sum()
    values = logged(folder, "test")[0]["values"]
    scores = [values[name] for name in ("mIoU", "day/mIoU", "night/mIoU")]
    assert scores == pytest.approx(scores_by_hand(counts))


@pytest.mark.slow
def test_statistics_of_each_domain_change_only_the_counts(trained: Trained, call: Call) -> None:
    folder = trained(*NIGHT)
    files = {path: path.read_bytes() for path in folder.glob("*") if path.is_file()}
    code, out, err = call(evaluate.entry, f"run={folder}", "batch_norm=adabn")
    assert code == 0, err
    assert "AdaBN" in out
    found = Counts.load(folder / "evaluations" / "test_adabn.npz")
    stored = Counts.load(folder / "counts_test.npz")
    assert (found.names, found.night) == (stored.names, stored.night)
    assert not np.array_equal(found.counts, stored.counts)
    assert {path: path.read_bytes() for path in files} == files


def without_target_head(folder: Path, place: Path) -> Path:
    """A copy of a run whose head of the target predicts class 0 everywhere."""
    shutil.copytree(folder, place)
    payload = load_checkpoint(place / "best.pt")
    for name, values in payload["model"].items():
        if name.startswith("heads.target."):
            values.zero_()
    save(place / "best.pt", payload)
    return place


def only_road(counts: np.ndarray) -> bool:
    return not counts[..., 1:].any()


@pytest.mark.slow
def test_night_images_are_predicted_by_the_targets_head(
    trained: Trained, call: Call, tmp_path: Path
) -> None:
    folder = trained(*NIGHT)
    broken = without_target_head(folder, tmp_path / "broken" / folder.name)
    whole = Counts.load(folder / "counts_test.npz").counts
    night, day = slice(2, 4), slice(0, 2)
    target = evaluated(call, broken).counts
    assert only_road(target[night])
    assert np.array_equal(target[day], whole[day])
    # And with the requested head.
    assert only_road(evaluated(call, broken, "head=target").counts)
    assert not only_road(evaluated(call, broken, "head=source").counts[night])
    assert np.array_equal(evaluated(call, folder, "head=own").counts, whole)
    # Images of a user need the request.
    rng = np.random.default_rng(0)
    write_png(tmp_path / "mine" / "street.png", rng.integers(0, 256, (48, 64, 4), dtype=np.uint8))
    words = (f"run={broken}", f"input={tmp_path / 'mine'}", f"out={tmp_path / 'out'}")
    assert call(predict.entry, *words)[0] == 2
    for head, scores in (("source", True), ("target", False)):
        assert call(predict.entry, *words, f"head={head}")[0] == 0
        found = cv2.imread(str(tmp_path / "out" / "street.png"), cv2.IMREAD_UNCHANGED)
        assert found.any() == scores


@pytest.mark.slow
def test_chain_without_validation_split_reports_its_last_checkpoints(
    call: Call, tmp_path: Path
) -> None:
    root, runs = write_freiburg(tmp_path / "freiburg"), tmp_path / "runs"
    data = ("dataset=freiburg", f"dataset.root={root}", "dataset.crop=null", f"runs_dir={runs}")
    words = ("+debug=smoke", *data, "scale.critic_width=4", *ON_CPU)
    for more, named in (
        (("+experiment=sh_source", "trainer.tested=best"), "dataset.val_sequences"),
        # At demo scale the teacher is tested with its best checkpoint, so that it needs images.
        (("+experiment=multi_head_night",), "upstream run thermal_teacher of multi_head_night"),
    ):
        code, _, err = call(main, *more, *words)
        assert code == 2
        assert_one_sentence(err, named)
    assert not runs.exists()
    code, _, err = call(main, "+experiment=sh_adversarial", *words)
    assert code == 0, err
    results = sorted(runs.glob("*/result.json"))
    assert len(results) == 2
    for path in results:
        result = json.loads(path.read_text())
        assert (result["best_step"], result["steps"]) == (2, 2)
        assert not {"val", "best_score"} & set(result)
        assert {line["kind"] for line in logged(path.parent)} == {"train", "test"}


@pytest.mark.usefixtures("pictures")
def test_run_keeps_the_thermal_range_it_found(call: Call, tmp_path: Path) -> None:
    """Evaluated, predicted, exported and resumed with it, though the training images change."""
    root = write_folder(tmp_path / "data")
    data = ("dataset=folder", f"dataset.root={root}", f"runs_dir={tmp_path / 'runs'}", *OWN)
    words = ("+experiment=grbm", "+debug=smoke", "masker.patch_size=32", *data, *ON_CPU)
    words = (*words, "dataset.thermal_range=auto")
    expected = folder(root, thermal_range="auto").images.chosen_range
    code, _, err = call(main, *words)
    assert code == 0, err
    run = only_run(tmp_path / "runs")
    marker = json.loads((run / "dataset.json").read_text())
    assert tuple(marker["thermal_range"]) == expected
    for path in root.glob("train/ir/*.tif"):
        counts = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        write_any(path, counts + np.uint16(3000))
    opened = open_run(run, [])
    reader = reader_of(opened.dataset)
    assert isinstance(reader, FileDataset)
    assert reader.images.limits == expected
    assert opened.changed == ()
    assert with_range(opened)["dataset"]["thermal_range"] == list(expected)
    typed = open_run(run, ["dataset.thermal_range=[20000,24000]"])
    assert (typed.thermal_range, typed.dataset.decoding()["thermal_range"]) == (None, (2e4, 24e3))
    # Degrees are no counts: those of the data set are found anew.
    degrees = "dataset.thermal_range={unit: centikelvin, range: auto}"
    (low, high) = open_run(run, [degrees]).thermal_range or (0, 0)
    assert -273.15 + 230 <= low < high <= -273.15 + 270
    spec = specify(compose(list(words)))
    assert spec.folder.name == run.name
    assert set_up_training(spec).session.thermal_range == expected
    again = set_up_training(specify(compose([*words, "fresh=true"]))).session.thermal_range
    assert again is not None
    assert again[0] == expected[0] + 3000
    for damaged in ({**marker, "thermal_range": [9, 9]}, {**marker, "thermal_range": [9, 1]}):
        del damaged["crc32"]
        write_json(run / "dataset.json", damaged)
        with pytest.raises(InputError, match="has no thermal_range of the run"):
            open_run(run, [])
