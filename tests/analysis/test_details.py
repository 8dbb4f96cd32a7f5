"""Intervals of details over images, and the counts that belong to a method."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.compare import metrics_of
from analysis.details import entry
from analysis.results import open_counts
from analysis.uncertainty import Resampling, compare, estimate
from analysis.uncertainty.same_images import in_order
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import Details
from rgbt.metrics.named import value
from rgbt.metrics.scores import ece
from rgbt.runs.folder import RunFolder
from tests.analysis import counts as makes
from tests.analysis.test_results import make_run
from tests.analysis.uncertainty.simulated import pairs_of
from tests.commands import Call, assert_one_sentence
from tests.measured import store

IMAGES = 40
SETTINGS = Resampling(resamples=2000, blocks="none")
BOUNDARY, CALIBRATION = Details("boundary", (0.02,)), Details("calibration", (2.0,))


def counts_of(array: np.ndarray, partition: str) -> Counts:
    return makes.counts_of(array, partition=partition, classes=("road", "car"))


def boundaries(seed: int = 0, images: int = IMAGES) -> Counts:
    """Two regions; the labels are those of seed 0, whatever the seed."""
    sizes = np.random.default_rng(0).integers(20, 60, (images, 2, 2))
    rng = np.random.default_rng(seed)
    both = rng.integers(5, 20, sizes.shape)
    predicted = both + rng.integers(0, 30, sizes.shape)
    return counts_of(np.stack([both, sizes, predicted], 2), BOUNDARY.partition("ring2"))


def calibrated(seed: int = 0) -> Counts:
    """One region, 100 pixels an image in the upper bin, of which about 70 are right."""
    right = np.random.default_rng(seed).binomial(100, 0.7, IMAGES)
    array = np.zeros((IMAGES, 2, 3, 2), np.int64)
    array[:, 1, 0, 0], array[:, 1, 1, 0], array[:, 1, 2, 0] = 100, right, 800_000
    return counts_of(array, CALIBRATION.partition("ring1"))


def test_interval_of_calibration_error_is_corrected_and_never_negative() -> None:
    counts = calibrated()
    found = estimate([counts], ["ECE"], SETTINGS)["ECE"]
    right = counts.counts[:, 1, 1, 0].sum()
    assert found.value == pytest.approx(100 * (0.8 - right / 4000))
    assert 0 <= found.images.low < found.value < found.images.high
    # Right on average: chance alone makes the error, so that the interval begins at 0.
    array = counts.counts.copy()
    array[:, 1, 2, 0] = right * 10_000 // IMAGES
    fair = estimate([counts_of(array, counts.partition)], ["ECE"], SETTINGS)["ECE"]
    assert fair.images.low == 0


def test_difference_between_two_methods_has_an_interval() -> None:
    array = boundaries(1).counts.copy()
    array[:, :, [0, 2]] += 5
    better = replace(boundaries(1), counts=array)
    metrics = metrics_of("auto", [better], SETTINGS)
    assert metrics == ["boundary_mIoU", "region/1/boundary_mIoU", "region/2/boundary_mIoU"]
    found = compare([boundaries(1)], [better], metrics, SETTINGS).differences[0]
    assert found.interval.low > 0
    assert found.difference.p < 0.01


@pytest.mark.parametrize("first", [boundaries(), calibrated()])
def test_labels_of_two_methods_are_compared(first: Counts) -> None:
    """Pixels of the labelled boundary, or of the region; bins are those of the prediction."""
    array = first.counts.copy()
    array[3, 0, 1 if first.counts[..., 0].any(0).all() else 0, 1] += 1
    with pytest.raises(InputError, match="'00003D' has different labels"):
        in_order(first, replace(first, counts=array), "pixels")
    if "calibration" in first.partition:
        moved = np.roll(first.counts, 1, axis=1)
        in_order(first, replace(first, counts=moved), "pixels")
        in_order(first, boundaries(), "labels")  # nothing to compare


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """A method with two seeds and stored details, a run without any."""
    runs = tmp_path / "runs"
    for seed in range(2):
        folder = make_run(runs, f"plain{seed}", "plain", seed)
        plain = counts_of(np.broadcast_to([[2 - seed, seed], [1, 3]], (IMAGES, 2, 2, 2)), "ring2")
        store(folder, plain)
        RunFolder(folder).finish(makes.result_of(folder.name, plain))
        for view in ("rgbt", "thermal"):
            for made in (boundaries(seed), calibrated(seed)):
                store(folder, made, view=view)
        store(folder, boundaries(9), view="rgb", dataset="other", dataset_name="kitti")
    make_run(runs, "bare0", "bare", 0)
    return runs


def test_seeds_of_a_method_are_shown_together(call: Call, runs: Path, tmp_path: Path) -> None:
    words = (f"runs_dir={runs}", "resamples=200", "blocks=none")
    code, out, err = call(entry, "run=plain", *words, f"out={tmp_path / 'out'}")
    assert (code, err) == (0, "")
    assert "intervals over images and seeds" in out
    rows = list(csv.DictReader((tmp_path / "out" / "details.csv").open()))
    assert {(row["details"], row["input"]) for row in rows} == {
        ("", "rgbt"),
        *((kind, view) for kind in ("boundary", "calibration") for view in ("rgbt", "thermal")),
    }
    (row,) = (row for row in rows if (row["metric"], row["input"]) == ("ECE", "rgbt"))
    expected = [value("ECE", calibrated(seed), "released") for seed in range(2)]
    assert float(row["value"]) == pytest.approx(np.mean(expected))
    assert float(row["low"]) < float(row["value"]) < float(row["high"])
    assert row["seeds"] == "2"
    # Tables of one line have one for each input: of single frames both images, of ECE also thermal.
    lines = (tmp_path / "out" / "details.md").read_text().splitlines()
    assert sum(line.startswith(("| rgbt |", "| thermal |")) for line in lines) == 3
    assert call(entry, "run=plain0", *words)[0] == 0


def test_file_of_pairs_is_shown_by_videos(call: Call, tmp_path: Path) -> None:
    """Twelve videos of two pairs each."""
    names = tuple(f"v{index % 12}_{index // 12:03d}" for index in range(24))
    replace(pairs_of(24, 0.5), names=names).save(tmp_path / "pairs.npz")
    code, shown, err = call(entry, f"run={tmp_path}/pairs.npz", "resamples=200")
    assert code == 0, err
    text = " ".join(shown.split())
    assert "Consistency of pairs of frames in percent" in text
    assert "all images" in text
    assert "12 blocks of 2 neighbouring frames" in text
    assert "each is one block" in text


def test_missing_details_are_named(call: Call, runs: Path) -> None:
    (runs / "plain1" / "evaluations" / "test_thermal_ring1-calibration-2.npz").unlink()
    with pytest.raises(InputError, match="condition=thermal is not counted .* has clean, "):
        open_counts("plain1", runs, condition="thermal")  # the rest are details
    for words, sentence in (
        (["run=bare"], "modality=all details=boundary"),
        (["run=plain"], "plain1 has no counts of calibration of split 'test'"),
    ):
        code, _, err = call(entry, *words, f"runs_dir={runs}")
        assert code == 2
        assert_one_sentence(err, sentence)


@pytest.mark.slow
@pytest.mark.parametrize("gap", [0.0, 0.03, 0.1])
def test_interval_of_a_calibration_error_holds_the_truth(gap: float) -> None:
    """60 images, bins that are too confident by `gap`, and images that differ."""
    rng = np.random.default_rng(0)
    centre = (np.arange(15) + 0.5) / 15

    def drawn(images: int) -> np.ndarray:
        right = np.clip(centre * (1 - gap) + 0.05 * rng.normal(size=(images, 15)), 0, 1)
        number = np.full((images, 15), 100)
        units = np.broadcast_to(np.rint(100 * centre * 10_000), number.shape).astype(np.int64)
        one = np.stack([number, rng.binomial(number, right), units], 2)[..., None]
        return np.concatenate([one, np.zeros_like(one)], -1)  # all are predicted as road

    truth = 100 * float(ece(drawn(50_000).sum(0)))
    settings = Resampling(resamples=300, blocks="none")
    found = [counts_of(drawn(60), "ring1-calibration-15") for _ in range(100)]
    holds = sum(truth in estimate([counts], ["ECE"], settings)["ECE"].images for counts in found)
    assert holds >= 88  # 95 but for chance
