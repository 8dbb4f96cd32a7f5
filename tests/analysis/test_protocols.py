"""Scores by other protocols, by hand and on published maps; the figures of the page about them."""

from __future__ import annotations

import csv
import json
import math
import re
import shlex
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from analysis.protocols import protocol_scores, protocol_table
from analysis.score import entry
from rgbt import evaluate
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.scores import summary
from tests.analysis.counts import counts_of
from tests.analysis.test_results import make_run
from tests.analysis.test_score import REAL, place
from tests.commands import SPLITS, Call, assert_one_sentence
from tests.conftest import pair
from tests.docs.pages import ROOT, Page

CLASSES = ("ground", "car", "person", "sign", "bus")
GROUND = ("ground",)
# Rows: label; sign is predicted only, bus nowhere.
FIRST = [[4, 0, 0, 0, 0], [1, 3, 0, 0, 0], *[[0] * 5] * 3]
SECOND = [[6, 2, 0, 1, 0], [0] * 5, [0, 0, 1, 0, 0], *[[0] * 5] * 2]
PAGE = ROOT / "docs/how-to/why-my-number-differs.md"
MAPS = REAL / "predictions_dcfnet"


def two_images(**changed: object) -> Counts:
    """Both images, whose pixels are spread over two regions."""
    images = np.array([FIRST, SECOND])
    part = images // 2
    return counts_of(np.stack([part, images - part], 1), classes=CLASSES, **changed)


def test_every_protocol_by_hand() -> None:
    """IoUs: first image ground 4/5, car 3/4; second 6/9, 0/2, person 1, sign 0/1.

    Of both: ground 10/14, car 3/6, person 1, sign 0/1; without ground's labels car 3/4, no sign.
    """
    expected = {
        ("scored", "released"): ((10 / 14 + 1.5) / 5, (1.55 / 5 + (6 / 9 + 1) / 5) / 2),
        ("scored", "exclude"): ((10 / 14 + 1.5) / 4, (1.55 / 2 + (6 / 9 + 1) / 4) / 2),
        ("scored", "labelled"): ((10 / 14 + 1.5) / 3, (1.55 / 2 + (6 / 9 + 1) / 2) / 2),
        ("unscored", "released"): (1.5 / 4, (0.75 / 4 + 1 / 4) / 2),
        ("unscored", "exclude"): (1.5 / 3, (0.75 / 1 + 1 / 3) / 2),
        ("unscored", "labelled"): (1.5 / 2, (0.75 + 1) / 2),
        ("ignored", "released"): (1.75 / 4, (0.75 / 4 + 1 / 4) / 2),
        ("ignored", "exclude"): (1.75 / 2, (0.75 + 1) / 2),
        ("ignored", "labelled"): (1.75 / 2, (0.75 + 1) / 2),
    }
    # Accuracies: first image 4/4, 3/4; second 6/9, person 1; of both 10/13, 3/4, 1.
    accuracies = {
        ("scored", "released"): ((10 / 13 + 1.75) / 5, (1.75 / 5 + (6 / 9 + 1) / 5) / 2),
        ("scored", "labelled"): ((10 / 13 + 1.75) / 3, (1.75 / 2 + (6 / 9 + 1) / 2) / 2),
        ("unscored", "exclude"): (1.75 / 2, (0.75 + 1) / 2),
        ("ignored", "released"): (1.75 / 4, (0.75 / 4 + 1 / 4) / 2),
    }
    frame = protocol_scores("ours", two_images(), GROUND)
    assert len(frame) == 9 * 4
    values = frame.set_index(["background", "absent", "over", "metric"])["value"]
    for metric, rules in {"mIoU": expected, "mAcc": accuracies}.items():
        for rule, (matrix, images) in rules.items():
            assert values[(*rule, "matrix", metric)] == pytest.approx(100 * matrix), rule
            assert values[(*rule, "images", metric)] == pytest.approx(100 * images), rule


def test_images_without_a_class_are_left_out_and_single_classes_count() -> None:
    empty = [[8, 0, 0, 0, 0], *[[0] * 5] * 4]
    counts = counts_of(np.array([FIRST, empty])[:, None], classes=CLASSES)
    values = protocol_scores("ours", counts, GROUND).set_index(
        ["background", "absent", "over", "metric"]
    )["value"]
    assert values["scored", "exclude", "images", "mIoU"] == pytest.approx(100 * (1.55 / 2 + 1) / 2)
    assert values["ignored", "exclude", "images", "mIoU"] == pytest.approx(75)
    assert values["ignored", "released", "images", "mIoU"] == pytest.approx(75 / 4 / 2)
    # As in the other tables: one labelled class of several gives no mean over classes.
    assert math.isnan(values["unscored", "exclude", "matrix", "mIoU"])


@pytest.mark.parametrize(
    ("changed", "row"),
    [
        ({}, ("count as 0", "in the mean", "44.29 *", "50.38 *")),
        ({"absent": "exclude"}, ("left out", "in the mean", "55.36 *", "83.97 *")),
        ({"unscored": GROUND}, ("count as 0", "not in the mean", "37.50 *", "43.75 *")),
        ({"unscored": ("ground", "bus")}, ("count as 0", "not in the mean", "50.00 *", "58.33 *")),
    ],
)
def test_protocol_of_the_counts_is_marked(changed: dict[str, object], row: tuple[str, ...]) -> None:
    counts = two_images(**changed)
    frame = protocol_scores("ours", counts, GROUND)
    table = protocol_table(frame, counts, GROUND, "test.txt")
    (marked,) = [cells for cells in table.rows if any("*" in cell for cell in cells)]
    assert marked[:4] == row
    assert f"mean over {5 - len(counts.unscored)} of 5 classes" in table.notes[0]
    assert f"(absent={counts.absent})" in table.notes[0]
    assert "2 images of split test (test.txt)" in table.notes[0]
    assert "in an image: 8 to 10." in table.notes[0]


def test_unscored_background_is_in_the_mean_of_its_rule() -> None:
    """Counts whose means leave out the ground have the same scores by each rule."""
    frames = []
    for unscored in ((), GROUND):
        frames.append(protocol_scores("ours", two_images(unscored=unscored), GROUND))
    np.testing.assert_array_equal(frames[0]["value"], frames[1]["value"])


def test_background_that_is_no_class_is_refused() -> None:
    for wrong in ("sky",), CLASSES:
        with pytest.raises(InputError, match=r"^background: "):
            protocol_scores("ours", two_images(), wrong)


def rows_of(path: Path) -> dict[tuple[str, ...], float]:
    """(background, absent, over, metric) -> value of a file of protocols."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    keys = ("background", "absent", "over", "metric")
    return {tuple(row[key] for key in keys): float(row["value"] or "nan") for row in rows}


def test_command_shows_and_writes_protocols(call: Call, data: Path, tmp_path: Path) -> None:
    folder, out = tmp_path / "method", tmp_path / "scores"
    folder.mkdir()
    for name in SPLITS["test"]:
        cv2.imwrite(str(folder / f"{name}.png"), pair(name, (48, 64))[2])
    words = (f"predictions={folder}", *place(data), "resamples=0")
    code, shown, err = call(entry, *words, f"out={out}")
    assert code == 0, err
    assert shown.count("the same counts by other protocols") == 1
    assert "(test.txt, labels of 48x64 pixels" in " ".join(shown.split())
    assert "the same counts by other protocols" in (out / "scores.md").read_text()
    assert rows_of(out / "protocols.csv")["scored", "labelled", "matrix", "mIoU"] == 100
    stored = (f"counts={out / 'counts_ring5.npz'}", "resamples=0")
    code, shown, err = call(entry, *stored)
    assert code == 0, err
    assert "background=NAME adds" in " ".join(shown.split())
    assert "not in the mean" not in shown
    code, shown, err = call(entry, *stored, "background=unlabeled")
    assert code == 0, err
    assert "not in the mean" in shown
    code, _, err = call(entry, *stored, "background=sky")
    assert code == 2
    assert_one_sentence(err, "background: ")


def test_counts_of_a_run_have_its_background(call: Call, tmp_path: Path) -> None:
    folder = make_run(tmp_path / "runs", "aaa0", "m", 0)
    (name, *_) = Counts.load(folder / "counts_test.npz").classes
    (folder / "config.yaml").write_text(f"dataset: {{background: [{name}, of_another_map]}}\n")
    code, shown, err = call(entry, "counts=aaa0", f"runs_dir={tmp_path / 'runs'}", "resamples=0")
    assert code == 0, err
    assert f"Background: {name}." in shown


@pytest.mark.parametrize("method", ["MFNet_final_pth", "LASNet", "SGFNet", "MMSMCNet"])
def test_published_maps_have_the_known_scores(method: str) -> None:
    """The matrix of all images was counted by another program; the scores are computed here."""
    path = REAL / "predictions20" / "expected_confusions.json"
    if not path.is_file():
        pytest.skip("needs published predictions of real images")
    matrix = np.array(json.loads(path.read_text())[f"{method}/test"]["confusion"])
    values = protocol_scores(method, counts_of(matrix[None]), ("class0",)).set_index(
        ["background", "absent", "over", "metric"]
    )["value"]
    right, union = matrix.diagonal(), matrix.sum(0) + matrix.sum(1) - matrix.diagonal()
    ious = [100 * a / b if b else math.nan for a, b in zip(right, union, strict=True)]
    labelled = matrix.sum(1) > 0
    for absent, expected in {
        "released": np.nansum(ious) / 9,
        "exclude": np.nanmean(ious),
        "labelled": np.array(ious)[labelled].mean(),
    }.items():
        assert values["scored", absent, "matrix", "mIoU"] == pytest.approx(expected)


def tables_of_the_page() -> dict[str, dict[str, list[str]]]:
    """Section -> first cell of a row -> the other cells, of tables with figures."""
    sections: dict[str, dict[str, list[str]]] = {}
    title = ""
    for line in Page.read(PAGE).prose.values():
        title = line.removeprefix("## ") if line.startswith("## ") else title
        cells = [cell.strip() for cell in line.strip("| ").split("|")]
        if line.startswith("|") and re.fullmatch(r"\d+\.\d\d", cells[-1]):
            sections.setdefault(title, {})[cells[0]] = cells[1:]
    return sections


def commands_of_the_page(start: str) -> list[list[str]]:
    """Words of the commands that begin with `start`, without "rgbt" and its name."""
    found = []
    for block in Page.read(PAGE).blocks:
        for line in block.text.replace("\\\n", " ").splitlines():
            if block.language == "bash" and line.startswith(start):
                found.append(shlex.split(line)[2:])
    return found


def needs_real_maps() -> None:
    if not (MAPS.is_dir() and (REAL / "mfnet20").is_dir() and (REAL / "mfnet200").is_dir()):
        pytest.skip("needs published predictions of real images")


def test_figures_of_maps_on_the_page_are_measured(call: Call, tmp_path: Path) -> None:
    """The page's own commands, on the images that its lists name."""
    needs_real_maps()
    found, shown = {}, ""
    roots = {"test": "mfnet20", "val": "mfnet200"}
    for split, words in zip(roots, commands_of_the_page("rgbt score"), strict=True):
        kept = [word for word in words if not word.startswith(("predictions", "dataset."))]
        root = f"dataset.root={REAL / roots[split]}"
        out = f"out={tmp_path / split}"
        code, printed, err = call(entry, *kept, f"predictions={MAPS / split}", root, out)
        assert code == 0, err
        shown += printed
        found[split] = rows_of(tmp_path / split / "protocols.csv")

    def pair_of(*key: str) -> list[str]:
        return [f"{found[split][key]:.2f}" for split in roots]

    rules = {"count as 0": "released", "left out": "exclude"}
    rules |= {"left out, predicted or not": "labelled"}
    treated = {"in the mean": "scored", "not in the mean": "unscored"}
    treated |= {"its labels ignored": "ignored"}
    means = {
        f"{over}, absent classes {rule}": pair_of("scored", rules[rule], key, "mIoU")
        for rule in ("count as 0", "left out")
        for over, key in (("one matrix", "matrix"), ("by image", "images"))
    }
    with (tmp_path / "test" / "scores.csv").open() as file:
        scores = [row for row in csv.DictReader(file) if row["partition"] == "ring5"]
    wanted = {"absent": "released", "region": "0", "class": "", "metric": "mIoU"}
    parts = {row["subset"]: row["value"] for row in scores if wanted.items() <= row.items()}
    test, val = pair_of("scored", "released", "matrix", "mIoU")
    page = tables_of_the_page()
    assert page["1. Absent classes"] == {
        said: pair_of("scored", rule, "matrix", "mIoU") for said, rule in rules.items()
    }
    assert page["2. Background"] == {
        said: pair_of(rule, "released", "matrix", "mIoU") for said, rule in treated.items()
    }
    assert page["3. Mean over images"] == means
    assert page["4. Another list"] == {
        "20 test images": [test],
        "100 validation images": [val],
        "10 test images by day": [f"{float(parts['day']):.2f}"],
        "10 test images at night": [f"{float(parts['night']):.2f}"],
    }
    (block,) = [block for block in Page.read(PAGE).blocks if block.language == "text"]
    lines = {" ".join(line.split()) for line in shown.splitlines()}
    assert {" ".join(line.split()) for line in block.text.splitlines()} <= lines


def test_lists_of_the_page_are_those_of_the_images(tmp_path: Path) -> None:
    needs_real_maps()
    lists = {"twenty.txt": REAL / "mfnet20/test.txt", "hundred.txt": REAL / "mfnet200/val.txt"}
    for block in Page.read(PAGE).blocks:
        for line in block.text.splitlines():
            if line.startswith("(seq"):
                text = line.replace("/data/MFNet", str(tmp_path))
                subprocess.run(["bash", "-c", text], check=True)
    for name, known in lists.items():
        assert sorted((tmp_path / name).read_text().split()) == sorted(known.read_text().split())


@pytest.mark.slow
def test_figures_of_weights_on_the_page_are_measured(call: Call, tmp_path: Path) -> None:
    weights = REAL / "mfnet_weights/final.pth"
    if not (weights.is_file() and (REAL / "mfnet20").is_dir()):
        pytest.skip("needs released weights and real images")
    (words,) = commands_of_the_page("rgbt evaluate")
    kept = [word for word in words if not word.startswith(("model.weights", "dataset."))]
    kept = [word for word in kept if not word.startswith(("scale.", "prediction."))]
    kept += [f"model.weights={weights}", f"dataset.root={REAL / 'mfnet20'}"]
    kept += ["data.num_workers=0", "trainer.threads=1"]
    tables = tables_of_the_page()
    rows = {
        settings: float(figure)
        for section in ("5. Size", "6. Inputs and test-time augmentation")
        for settings, figure in tables[section].values()
    }
    assert set(words) - set(kept) >= {"scale.test_short_edge=240", "prediction.counted=image"}
    assert len(rows) == 8
    for number, (settings, figure) in enumerate(rows.items()):
        own = settings.strip("`").split() if settings.startswith("`") else []
        runs = tmp_path / str(number)
        code, _, err = call(evaluate.entry, *kept, *own, f"runs_dir={runs}")
        assert code == 0, err
        (path,) = runs.glob("evaluations/*/*.npz")
        assert 100 * summary(Counts.load(path), "released")["mIoU"] == pytest.approx(
            figure, abs=0.011
        ), settings
