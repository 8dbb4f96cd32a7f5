"""Every experiment on days and nights, end to end: heads, resumed runs, conflicting settings."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from rgbt import evaluate, predict
from rgbt.checkpoints.stored import save
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.engine.checkpoint import load_checkpoint
from rgbt.metrics.counts import Counts
from rgbt.run import main
from rgbt.schemes.adversarial import Adversarial
from rgbt.spec.specify import specify
from tests.commands import Call, assert_one_sentence, logged, losses, short
from tests.conftest import write_png
from tests.days_and_nights import DAYS_AND_NIGHTS
from tests.test_run import ADAPTATION, EXPERIMENTS

ROOT = Path(__file__).resolve().parents[1]
QUICK = ("multi_head_night",)
"""Two kinds; the others are like one of them, or run below, and are slow."""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("adaptation")


class Runs:
    """Calls `rgbt.run` on the small data set; a finished run is found again."""

    def __init__(self, call: Call, place: Path, runs: Path) -> None:
        self.call, self.cache, self.runs = call, place / "cache", runs

    def words(self, experiment: str, *overrides: str) -> list[str]:
        return [
            *(f"+experiment={experiment}", *DAYS_AND_NIGHTS, f"dataset.cache_dir={self.cache}"),
            *(f"runs_dir={self.runs}", *(() if "max_steps" in str(overrides) else short(2))),
            *overrides,
        ]

    def folder(self, experiment: str, *overrides: str) -> Path:
        """Of a run, whether it is there or not."""
        return self.runs / specify(compose(self.words(experiment, *overrides))).key

    def output_of(self, experiment: str, *overrides: str) -> tuple[int, str, str]:
        return self.call(main, *self.words(experiment, *overrides))

    def __call__(self, experiment: str, *overrides: str) -> Path:
        """Of a run that is finished."""
        folder = self.folder(experiment, *overrides)
        if not (folder / "result.json").exists():
            code, _, err = self.output_of(experiment, *overrides)
            assert code == 0, err
            assert (folder / "result.json").exists()
        return folder


@pytest.fixture
def run(call: Call, place: Path) -> Runs:
    """In the folder of runs that all tests of this module share."""
    return Runs(call, place, place / "runs")


@pytest.fixture
def elsewhere(call: Call, place: Path, tmp_path: Path) -> Callable[[str], Runs]:
    return lambda name: Runs(call, place, tmp_path / name)


@pytest.fixture
def evaluated(call: Call, tmp_path: Path) -> Callable[..., Counts]:
    """Counts of `rgbt.evaluate` of a run folder."""

    def evaluate_run(folder: Path, *words: str) -> Counts:
        out = tmp_path / "evaluated.npz"
        code, _, err = call(evaluate.entry, f"run={folder}", f"out={out}", *words)
        assert code == 0, err
        return Counts.load(out)

    return evaluate_run


# ---- every experiment -----------------------------------------------------------------------


def mean_of_twelve(matrix: np.ndarray) -> float:
    """mIoU by hand; a class without pixels is 0."""
    ious = []
    for k in range(12):
        union = matrix[k].sum() + matrix[:, k].sum() - matrix[k, k]
        ious.append(matrix[k, k] / union if union else 0.0)
    return float(np.mean(ious))


@pytest.mark.parametrize(
    "experiment",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
        for name in EXPERIMENTS
        if name.startswith(ADAPTATION)
    ],
)
def test_every_experiment_trains_and_counts_every_image(run: Runs, experiment: str) -> None:
    folder = run(experiment)
    counts = Counts.load(folder / "counts_test.npz")
    dataset = build(compose(run.words(experiment)).dataset)
    assert counts.names == dataset.names("test")
    assert counts.night == (False, False, True, True)
    assert counts.unscored == ("background", "ignore")
    labels = np.stack([dataset.read(name).label for name in counts.names])
    assert counts.counts.sum() == (labels != 255).sum()
    lines = logged(folder)
    assert [(line["kind"], line["step"]) for line in lines] == [
        *(("train", 1), ("train", 2), ("val", 2), ("test", 2))
    ]
    scores = lines[-1]["values"]
    by_image = counts.counts.sum(1)
    assert scores["mIoU"] == pytest.approx(mean_of_twelve(by_image.sum(0)))
    assert scores["day/mIoU"] == pytest.approx(mean_of_twelve(by_image[:2].sum(0)))
    assert scores["night/mIoU"] == pytest.approx(mean_of_twelve(by_image[2:].sum(0)))
    result = json.loads((folder / "result.json").read_text())
    assert (result["best_step"], result["steps"]) == (2, 2)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["entropy", "adversarial_adaptsegnet", "adversarial_released"])
def test_schemes_that_no_experiment_chooses(run: Runs, scheme: str) -> None:
    heads = scheme == "adversarial_released"
    experiment = "multi_head_thermal" if heads else "sh_adversarial"
    extra = ["domains.target.labels=given"] if heads else []
    folder = run(experiment, f"scheme={scheme}", "model.weights=null", *extra)
    assert (folder / "counts_test.npz").exists()


def test_statistics_of_each_domain_change_the_counts_and_not_the_run(run: Runs, call: Call) -> None:
    folder = run("multi_head_night")
    files = {path: path.read_bytes() for path in folder.glob("*") if path.is_file()}
    code, out, err = call(evaluate.entry, f"run={folder}", "batch_norm=adabn")
    assert code == 0, err
    assert "AdaBN, of 2 images by day and 2 images at night (test), in batches of 4" in out
    found = Counts.load(folder / "evaluations" / "synth_freiburg_test_rgb_ring5_norm-adabn.npz")
    stored = Counts.load(folder / "counts_test.npz")
    assert (found.names, found.night) == (stored.names, stored.night)
    assert not np.array_equal(found.counts, stored.counts)
    assert {path: path.read_bytes() for path in folder.glob("*") if path.is_file()} == files


# ---- heads ----------------------------------------------------------------------------------


def without_head(folder: Path, head: str, place: Path) -> Path:
    """A copy of a run whose head scores nothing: it predicts class 0 everywhere."""
    shutil.copytree(folder, place)
    payload = load_checkpoint(place / "best.pt")
    zeroed = [name for name in payload["model"] if name.startswith(f"heads.{head}.")]
    assert zeroed
    for name in zeroed:
        payload["model"][name].zero_()
    save(place / "best.pt", payload)
    return place


def only_road(counts: np.ndarray) -> bool:
    return not counts[..., 1:].any()


@pytest.mark.slow
def test_night_images_are_predicted_by_the_targets_head(
    run: Runs, evaluated: Callable[..., Counts], tmp_path: Path
) -> None:
    folder = run("multi_head_night")
    whole = Counts.load(folder / "counts_test.npz").counts
    night, day = slice(2, 4), slice(0, 2)
    target = evaluated(without_head(folder, "target", tmp_path / "target")).counts
    assert only_road(target[night])
    assert not only_road(target[day])
    assert np.array_equal(target[day], whole[day])
    source = evaluated(without_head(folder, "source", tmp_path / "source")).counts
    assert only_road(source[day])
    assert np.array_equal(source[night], whole[night])
    # And with the requested head.
    assert only_road(evaluated(tmp_path / "target", "head=target").counts)
    assert not only_road(evaluated(tmp_path / "target", "head=source").counts[night])
    assert np.array_equal(evaluated(folder, "head=own").counts, whole)


@pytest.mark.slow
def test_thermal_images_are_predicted_by_the_targets_head(
    run: Runs, evaluated: Callable[..., Counts], tmp_path: Path
) -> None:
    """Its counts are stored, and its scores in every line follow from them."""
    folder = run("multi_head_thermal")
    broken = without_head(folder, "target", tmp_path / "broken")
    assert only_road(evaluated(broken, "modality=thermal").counts)
    whole = Counts.load(folder / "counts_test.npz").counts
    assert np.array_equal(evaluated(broken).counts, whole)
    assert np.array_equal(evaluated(broken, "modality=rgb").counts, whole)
    lines = logged(folder)
    for split in ("val", "test"):
        stored = Counts.load(folder / f"counts_{split}_thermal.npz")
        again = evaluated(folder, "modality=thermal", f"split={split}")
        assert (stored.split, stored.names) == (split, again.names)
        assert np.array_equal(stored.counts, again.counts)
        (values,) = (line["values"] for line in lines if line["kind"] == split)
        by_image = stored.counts.sum(1)
        assert values["thermal/mIoU"] == pytest.approx(mean_of_twelve(by_image.sum(0)))
    assert not only_road(stored.counts)
    assert not np.array_equal(stored.counts, whole)
    day, night = mean_of_twelve(by_image[:2].sum(0)), mean_of_twelve(by_image[2:].sum(0))
    assert (values["thermal/day/mIoU"], values["thermal/night/mIoU"]) == pytest.approx((day, night))
    for name in ("multi_head_night", "sh_source"):  # seen as the source is
        assert not list(run(name).glob("counts_*_thermal.npz"))


def heads_line(said: str) -> list[str]:
    return [" ".join(line.split()) for line in said.splitlines() if line.split()[:1] == ["heads"]]


def test_heads_of_the_predictions_are_reported(run: Runs, call: Call, tmp_path: Path) -> None:
    folder = run("multi_head_night")
    own = "heads source by day, target at night"
    assert heads_line(run.output_of("multi_head_night")[1]) == [own]
    for head, line in (("as trained", own), ("target", "heads target for all images")):
        words = (f"run={folder}", f"head={head}", f"out={tmp_path / 'x.npz'}")
        assert heads_line(call(evaluate.entry, *words)[1]) == [line]


def test_user_images_are_predicted_with_the_requested_head(
    run: Runs, call: Call, tmp_path: Path
) -> None:
    folder = run("multi_head_night")
    broken = without_head(folder, "target", tmp_path / "broken")
    dataset = build(compose(run.words("multi_head_night")).dataset)
    sample = dataset.read(dataset.names("test_day")[0])
    write_png(tmp_path / "mine" / "street.png", np.dstack([sample.rgb, sample.thermal]))
    entry, out = predict.entry, tmp_path / "out"
    words = (f"run={broken}", f"input={tmp_path / 'mine'}", f"out={out}")
    code, _, err = call(entry, *words)
    assert code == 2
    assert_one_sentence(err, "so no head can be selected. Set head=source or head=target")

    found = {}
    for head in ("source", "target"):
        code, _, err = call(entry, *words, f"head={head}")
        assert code == 0, err
        found[head] = cv2.imread(str(out / "street.png"), cv2.IMREAD_UNCHANGED)
    assert not found["target"].any()
    assert found["source"].any()


@pytest.mark.slow
def test_a_stage_begins_with_the_network_of_the_one_before(run: Runs) -> None:
    """With a rate of almost 0 it is that network still, and the teacher's labels are there."""
    stage = run("multi_head_night_stage1")
    second = run("multi_head_night", "optimizer.lr=1e-30", "scheme.critic_optimizer.lr=1e-30")
    before = load_checkpoint(stage / "last.pt")["model"]
    after = load_checkpoint(second / "last.pt")["model"]
    parameters = [name for name in before if "running" not in name and "num_batches" not in name]
    assert parameters
    assert all(torch.equal(before[name], after[name]) for name in parameters)
    (labels,) = run("thermal_teacher").glob("pseudo_labels/*/pseudo_labels.json")
    said = json.loads(labels.read_text())
    assert (said["split"], said["view"], said["images"]) == ("train_night", "thermal", 5)
    assert said["teacher"] == run("thermal_teacher").name


# ---- killed and continued -------------------------------------------------------------------


def heatnets(run: Runs) -> list[str]:
    """HeatNet on labels from a folder, so that it can be trained anywhere."""
    run("heatnet")
    (folder,) = run("thermal_teacher").glob("pseudo_labels/*")
    return ["heatnet", f"domains.target.labels={folder}", "domains.target.teacher_view=null"]


RESUMED: dict[str, tuple[Callable[[Runs], list[str]], int]] = {
    # The sixth step, after the segmentation has stepped.
    "one head": (lambda _: ["sh_adversarial", "model.weights=null"], 6),
    "two heads": (lambda _: ["multi_head_thermal", "model.weights=null"], 6),
    # Steps 1, 3, 5 are the discriminator's: the fifth one.
    "heatnet": (heatnets, 3),
}


def assert_same_runs(one: Path, other: Path) -> None:
    assert one.name == other.name
    payloads = [load_checkpoint(each / "last.pt") for each in (one, other)]
    for part in ("model", "others", "optimizers"):
        assert_equal(payloads[0][part], payloads[1][part])
    assert payloads[0]["others"]
    for split in ("val", "test"):
        counts = [Counts.load(each / f"counts_{split}.npz").counts for each in (one, other)]
        assert np.array_equal(*counts)
    assert losses(one) == losses(other)


def assert_equal(one: Any, other: Any) -> None:
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, other)
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_equal(one[key], other[key])
    elif isinstance(one, list):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_equal(a, b)
    else:
        assert one == other


@pytest.mark.slow
@pytest.mark.parametrize("case", ["two heads", "heatnet", "one head"])
def test_stopped_in_the_critics_phase_and_continued(
    run: Runs,
    elsewhere: Callable[[str], Runs],
    monkeypatch: pytest.MonkeyPatch,
    case: str,
) -> None:
    words, at = RESUMED[case][0](run), RESUMED[case][1]
    stopped, straight, calls = elsewhere("stopped"), elsewhere("straight"), 0

    def stop(self: Adversarial, seen: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == at:
            raise KeyboardInterrupt
        return phase(self, seen)

    phase = Adversarial._discriminator_phase
    with monkeypatch.context() as patch:
        patch.setattr(Adversarial, "_discriminator_phase", stop)
        assert stopped.output_of(*words, *short(6))[0] == 130
    folder = stopped.folder(*words, *short(6))
    assert not (folder / "result.json").exists()
    code, _, err = stopped.output_of(*words, *short(6))
    assert code == 0, err
    assert "resumes at step 4" in err
    assert_same_runs(folder, straight(*words, *short(6)))
    named = {name for line in losses(folder) for name in line}
    assert {"loss/critic/source", "loss/critic/target", "loss/target/adversarial"} <= named


@pytest.mark.slow
def test_a_step_of_two_batches_is_of_one_phase(run: Runs) -> None:
    folder = run("heatnet_no_teacher", "trainer.accumulate=2", *short(4))
    for number, line in enumerate(losses(folder)):
        assert ("loss/critic/source" in line) == (number % 2 == 0)
        assert ("loss/source/cross_entropy" in line) == (number % 2 == 1)
