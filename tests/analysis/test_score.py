from __future__ import annotations

import csv
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from analysis.predictions.maps import PixelMaps
from analysis.predictions.scoring import score_folder
from analysis.score import add_intervals, conventions, entry, score_tables, scores
from analysis.uncertainty import Resampling, estimate
from rgbt.config.common_options import PredictionFormatOptions
from rgbt.data.mfnet import MFNet
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from tests.analysis.counts import counts_of
from tests.analysis.test_results import make_run
from tests.commands import SPLITS, Call, assert_one_sentence
from tests.conftest import pair

ROOT = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("RGBT_SHARED", ROOT.parent / "shared"))
REAL = SHARED / "realdata"
HW = (48, 64)


@pytest.fixture
def predictions(data: Path, tmp_path: Path) -> Path:
    """Labels of split test with the left third taken for class 0."""
    folder = tmp_path / "method"
    folder.mkdir()
    for name in SPLITS["test"]:
        prediction = pair(name, HW)[2].copy()
        prediction[:, : HW[1] // 3] = 0
        cv2.imwrite(str(folder / f"{name}.png"), prediction)
    return folder


def place(data: Path) -> tuple[str, str]:
    return "dataset=mfnet", f"dataset.root={data}"


def test_a_folder_is_scored_and_written(
    call: Call, data: Path, predictions: Path, tmp_path: Path
) -> None:
    out = tmp_path / "scores"
    code, shown, err = call(
        entry, f"predictions={predictions}", *place(data), f"out={out}", "resamples=0"
    )
    assert code == 0, err
    counts = {name: Counts.load(out / f"counts_{name}5.npz") for name in ("ring", "vertical")}
    assert counts["ring"].names == tuple(SPLITS["test"])
    assert (out / "counts_horizontal5.npz").is_file()
    np.testing.assert_array_equal(counts["ring"].whole(), counts["vertical"].whole())
    assert PixelMaps.load(out / "maps.npz").name == "method"
    expected = value("region/5", counts["vertical"], "released")
    assert expected == 100  # the right strip is the label itself
    with (out / "scores.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["partition"] == "vertical5"]
    wanted = {"subset": "all", "region": "1", "class": "", "metric": "mIoU"}
    (row, *_) = (row for row in rows if wanted.items() <= row.items())
    assert float(row["value"]) == pytest.approx(
        value("region/1", counts["vertical"], "released"), abs=1e-3
    )
    assert row["low"] == ""
    page = (out / "scores.md").read_text()
    for text in (shown, page):
        assert "vertical5: mIoU, mAcc and IoU of each class by region" in text


def test_intervals_hold_the_score(call: Call, data: Path, tmp_path: Path) -> None:
    names = [f"{number:05d}D" for number in range(12)]
    folder = tmp_path / "method"
    folder.mkdir()
    (data / "test.txt").write_text("\n".join(names))
    for number, name in enumerate(names):
        label = pair(name, HW)[2]
        cv2.imwrite(str(data / "labels" / f"{name}.png"), label)
        cv2.imwrite(str(folder / f"{name}.png"), np.where(label > number % 4, label, 0))
    fewer = ("regions=2", "resamples=100", "blocks=none", "level=0.9")
    out = tmp_path / "scores"
    code, shown, err = call(
        entry, f"predictions={folder}", *place(data), *fewer, f"out={out}", "name=mine"
    )
    assert code == 0, err
    assert "90 % intervals over images" in shown
    with (out / "scores.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["low"]]
    assert {(row["region"], row["metric"]) for row in rows} == {
        *(("0", "mIoU"), ("1", "mIoU"), ("2", "mIoU"), ("0", "Var"))
    }
    for row in rows:
        assert row["method"] == "mine"
        if row["metric"] == "mIoU":
            assert float(row["low"]) < float(row["value"]) < float(row["high"])


def test_each_convention_has_separate_intervals() -> None:
    """A class that few images hold is absent from resamples: 0 pulls the mean down, exclude not."""
    images = np.zeros((20, 2, 3, 3), np.int32)
    images[:, :, 0, 0] = images[:, :, 2, 2] = 10 + np.arange(20)[:, None]
    images[:, :, 0, 1] = np.arange(20)[:, None] % 3
    images[:2, 0, 1, 1] = 5
    images[:, 1, 0, 1] = 0  # the second class is nowhere in the second region
    counts = counts_of(images)
    settings = Resampling(resamples=400, blocks="none")
    frame = scores("ours", counts)
    assert conventions(frame, counts) == ["released", "exclude"]
    add_intervals(frame, counts, settings)
    cells = frame[frame["metric"] == "mIoU"].set_index(["absent", "region"])
    for absent in ("released", "exclude"):
        expected = estimate([counts], ["mIoU", "region/2"], replace(settings, absent=absent))
        for region, metric in ((0, "mIoU"), (2, "region/2")):
            score, interval = cells.loc[absent, region], expected[metric].images
            assert interval is not None
            assert (score["low"], score["high"]) == (interval.low, interval.high)
            assert score["value"] == pytest.approx(expected[metric].value)
    assert cells.loc["released", 2]["high"] <= 67
    assert cells.loc["exclude", 2]["low"] > 90


def test_grids_show_the_numbers() -> None:
    """Both images. Left: ground 12/13, car 3/4, no person; right: ground 12/13, car 0, person 1/3.

    Day is the first image alone. Left: ground 4/5, car 3/4; right: 4/5, 0/1, 1/3.
    """
    first = [[[4, 0, 0], [1, 3, 0], [0, 0, 0]], [[4, 0, 0], [0, 0, 0], [1, 1, 1]]]
    second = [[[8, 0, 0], [0, 0, 0], [0, 0, 0]]] * 2
    given = {"classes": ("ground", "car", "person"), "partition": "vertical2"}
    counts = counts_of(np.array([first, second]), night=(False, True), **given)
    frame = scores("ours", counts)
    bounded = (frame["metric"] == "mIoU") & (frame["absent"] == "exclude")
    bounded &= (frame["region"] == 1) & (frame["subset"] == "all")
    frame.loc[bounded, ["low", "high"]] = 80.04, 85.0
    ious, accuracies, parts = score_tables(frame, counts, "said")
    rows = {row[0]: row[1:] for row in ious.rows}
    assert ious.header == ("", "whole", "region 1", "region 2")
    assert rows["mIoU released"] == ("61.88", "55.77", "41.88")
    assert rows["mIoU exclude"] == ("61.88", "83.65 [80.0, 85.0]", "41.88")
    assert (rows["car"], rows["person"]) == (("60.00", "75.00", "0.00"), ("33.33", "-", "33.33"))
    assert dict((row[0], row[1:]) for row in accuracies.rows)["car"] == ("75.00", "75.00", "-")
    assert parts.header == ("", "mIoU", "mAcc", "Var", "IoU1", "IoU2")
    by_part = {row[0]: row[1:] for row in parts.rows}
    assert by_part["day (1) released"] == ("57.78", "69.44", "48.23", "51.67", "37.78")
    assert parts.notes[1] == "said"
    cells = frame[frame["subset"] == "day"].set_index(["region", "class", "metric", "absent"])
    left, right = (80 + 75 + 0) / 3, (80 + 0 + 100 / 3) / 3
    assert cells["value"][0, "", "Var", "released"] == pytest.approx(((left - right) / 2) ** 2)
    excluded = ((80 + 75) / 2 - right) / 2
    assert cells["value"][0, "", "Var", "exclude"] == pytest.approx(excluded**2)


def test_counts_of_runs_are_scored(
    call: Call, data: Path, predictions: Path, tmp_path: Path
) -> None:
    out = tmp_path / "scores"
    arguments = (f"predictions={predictions}", *place(data), "resamples=0")
    call(entry, *arguments, f"out={out}", "name=scores")
    written = [x for x in (out / "scores.csv").read_text().splitlines() if "ring5" in x]
    stored = f"counts={out / 'counts_ring5.npz'}"
    code, _, err = call(entry, stored, "resamples=0", f"out={tmp_path / 'again'}")
    assert code == 0, err
    assert (tmp_path / "again" / "scores.csv").read_text().splitlines()[1:] == written
    code, _, err = call(entry, stored, "regions=9")
    assert code == 2
    assert "'regions' has no effect on stored counts" in err
    code, _, err = call(entry, stored, *place(data))
    assert "'dataset' has no effect on stored counts" in err


def test_a_folder_holds_scores_of_one_method(
    call: Call, data: Path, predictions: Path, tmp_path: Path
) -> None:
    out = tmp_path / "scores"
    arguments = (f"predictions={predictions}", *place(data), "resamples=0", f"out={out}")
    assert call(entry, *arguments)[0] == 0
    (out / "counts_test.npz").write_text("of a run")
    (out / "counts_ring9.npz").write_text("of an earlier call")
    twin = tmp_path / "elsewhere" / predictions.name  # of the same name
    shutil.copytree(predictions, twin)
    code, _, err = call(entry, f"predictions={twin}", *arguments[1:])
    assert code == 2
    assert (
        f"holds the scores of predictions={predictions} split=test; give predictions={twin}" in err
    )
    code, _, err = call(entry, f"counts={out}", "resamples=0", f"out={out}")
    assert code == 2
    assert f"give counts={out} its own folder" in err
    # The same method again: nothing of the first time is left, and nothing of others is touched.
    assert call(entry, *arguments, "regions=3")[0] == 0
    counted = {f"counts_{kind}3.npz" for kind in ("ring", "vertical", "horizontal")}
    left = {path.name for path in out.glob("*.npz")}
    assert left == counted | {"counts_test.npz", "maps.npz"}


def test_a_part_that_is_too_small_stops_nothing_else() -> None:
    night = tuple(number < 30 for number in range(100))
    array = np.random.default_rng(0).integers(0, 50, (100, 2, 3, 3))
    names = tuple(f"{number:05d}{'DN'[dark]}" for number, dark in enumerate(night))
    counts = counts_of(array, names=names, night=night)
    frame = scores("m", counts)
    assert "of 20 blocks of up to 5" in add_intervals(
        frame, counts, Resampling(resamples=100, blocks=5)
    )
    assert set(frame[frame["low"].notna()]["subset"]) == {"all", "day"}  # 6 blocks at night


def test_seeds_of_one_method_have_distinct_labels(call: Call, tmp_path: Path) -> None:
    for seed in (0, 1):
        make_run(tmp_path / "runs", f"aaa{seed}", "m", seed)
    code, shown, err = call(entry, "counts=m", f"runs_dir={tmp_path / 'runs'}", "resamples=0")
    assert code == 0, err
    assert "m seed 0, test" in shown
    assert "m seed 1, test" in shown


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("predictions=a",), "no data set is named; set dataset=mfnet"),
        (
            ("predictions=a", "dataset=mfnet", "out=/dev/null/x"),
            "(Not a directory); choose another folder",
        ),
        ((), "expected either predictions=folder or counts=run"),
        (("predictions=a", "counts=b"), "expected either predictions=folder or counts=run"),
        (("split=val",), "lacks 2 of the 2 images"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(
    call: Call, data: Path, predictions: Path, arguments: tuple[str, ...], word: str
) -> None:
    is_of_folder = arguments == ("split=val",)
    folder = (f"predictions={predictions}", *place(data)) if is_of_folder else ()
    code, _, err = call(entry, *folder, *arguments)
    assert code == 2
    assert_one_sentence(err, word)


@pytest.mark.parametrize("kind", ["rgb", "larger"])
def test_published_predictions_give_the_known_counts_in_every_form(
    tmp_path: Path, kind: str
) -> None:
    """LASNet's maps of 20 real test images, as they are and as other code would write them."""
    if not (REAL / "predictions20").is_dir():
        pytest.skip("needs published predictions of real images")
    dataset = MFNet(str(REAL / "mfnet20"))
    colours = np.array(dataset.palette, np.uint8)
    folder = tmp_path / "LASNet"
    folder.mkdir()
    for path in sorted((REAL / "predictions20" / "LASNet").glob("*.png")):
        indices = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        image = Image.fromarray(indices)
        if kind == "larger":
            image = image.resize((1280, 960), Image.Resampling.NEAREST)
        else:
            image = Image.fromarray(colours[indices])
        image.save(folder / f"Pred_{path.name}")
    given = PredictionFormatOptions(format="colour" if kind == "rgb" else "index", prefix="Pred_")
    resize: Any = "nearest" if kind == "larger" else "refuse"
    scored = score_folder(folder, dataset, "test", given=given, resize=resize)
    expected = json.loads((REAL / "predictions20" / "expected_confusions.json").read_text())
    for counts in scored.counts:
        np.testing.assert_array_equal(counts.whole(), expected["LASNet/test"]["confusion"])
    assert set(scored.resized.values()) == ({"960x1280 to 480x640"} if kind == "larger" else set())
