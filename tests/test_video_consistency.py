"""``rgbt consistency frames=video``: scores of predictions that follow a known motion."""

from __future__ import annotations

import csv
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbt import consistency
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from rgbt.randomness import numpy_generator
from tests.commands import Call, assert_one_sentence
from tests.conftest import write_png

ROOT = Path(__file__).resolve().parents[1]
REAL = Path(os.environ.get("RGBT_SHARED", ROOT.parent / "shared")) / "realdata"
HW = (48, 64)
STEP = 4
"""Columns by which everything moves to the left from frame to frame."""

NUMBERS = range(1, 5)


def scene() -> np.ndarray:
    noise = numpy_generator(0, "scene").integers(0, 256, (HW[0], HW[1] + STEP * 10))
    smooth = cv2.GaussianBlur(noise.astype(np.float32), (0, 0), 2.0)
    return (255 * (smooth - smooth.min()) / np.ptp(smooth)).astype(np.uint8)


def classes() -> np.ndarray:
    """Class map of the scene: upright stripes of 12 columns."""
    width = HW[1] + STEP * 10
    return np.broadcast_to(np.arange(width) // 12 % 3, (HW[0], width)).astype(np.uint8)


def shown(image: np.ndarray, number: int) -> np.ndarray:
    return np.ascontiguousarray(image[:, STEP * number : STEP * number + HW[1]])


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A video of four frames, of which the third is labelled."""
    for number in NUMBERS:
        gray = shown(scene(), number)
        write_png(tmp_path / "drive" / f"{number}.png", np.dstack([gray] * 4))
    write_png(tmp_path / "drive" / "label" / "3.png", shown(classes(), 3))
    return tmp_path / "drive"


def words(drive: Path) -> tuple[str, ...]:
    return (
        *("frames=video", "dataset=video", f"dataset.root={drive}", "dataset.num_classes=3"),
        *("dataset.classes=[a,b,c]", "dataset.rgb='{name}.png'", "dataset.thermal='{name}.png'"),
        *("dataset.label='label/{name}.png'", "dataset.absent=released"),
    )


def predict(folder: Path, *, wrong: tuple[int, ...] = ()) -> Path:
    """The stripes where they are; in `wrong` frames every class is the next one."""
    for number in NUMBERS:
        found = shown(classes(), number)
        write_png(folder / f"{number}.png", (found + (number in wrong)).astype(np.uint8) % 3)
    return folder


def measure(call: Call, drive: Path, folder: Path, *more: str) -> dict[str, Counts]:
    out = folder.parent / f"{folder.name}_out"
    code, text, err = call(
        consistency.entry, f"predictions={folder}", *words(drive), f"out={out}", *more
    )
    assert code == 0, err
    assert "Flow of 3 pairs" in text
    return {
        name: Counts.load(path)
        for name in ("flow", "triples")
        for path in out.glob(f"consistency_{name}*.npz")
    }


def test_predictions_that_follow_the_motion_are_consistent(
    call: Call, drive: Path, tmp_path: Path
) -> None:
    found = measure(call, drive, predict(tmp_path / "right"))
    assert found["flow"].names == ("2", "3", "4")
    assert found["triples"].names == ("3", "4")
    scores = {name: value(name, found["flow"], "released") for name in ("TC", "CA")}
    # The flow is rounded to whole pixels, so that a column beside a border may differ.
    assert scores["TC"] > 97
    assert scores["CA"] > 97
    assert value("warping_error", found["flow"], "released") < 1.5
    assert value("flicker", found["triples"], "released") < 1
    # Only the third frame has a label; all count for TC.
    labelled = found["flow"].counts[:, :3].sum((1, 2, 3))
    assert labelled[[0, 2]].tolist() == [0, 0]
    assert labelled[1] == found["flow"].counts[1].sum() > 0.6 * HW[0] * HW[1]
    with (tmp_path / "right_out" / "flow_test.csv").open() as file:
        records = list(csv.DictReader(file))
    assert [record["name"] for record in records] == ["2", "3", "4"]
    for record in records:
        assert float(record["displacement_px"]) == pytest.approx(STEP, abs=0.3)
        assert 0.6 < float(record["used"]) < 1 - STEP / HW[1] + 0.02
    assert (tmp_path / "right_out" / "pairs_flow_test.png").is_file()


def test_a_frame_that_is_wrong_alone_flickers(call: Call, drive: Path, tmp_path: Path) -> None:
    found = measure(call, drive, predict(tmp_path / "wrong", wrong=(2,)))
    by_pair = [value("warping_error", found["flow"].select([n]), "released") for n in ("2", "3")]
    assert min(by_pair) > 97
    assert value("warping_error", found["flow"].select(["4"]), "released") < 1.5
    # Frames 1, 2, 3 change and change back; frames 2, 3, 4 only change.
    assert value("flicker", found["triples"].select(["3"]), "released") > 97
    assert value("flicker", found["triples"].select(["4"]), "released") < 1.5


def test_other_sources_of_the_flow_have_files_of_their_own(
    call: Call, drive: Path, tmp_path: Path
) -> None:
    folder = predict(tmp_path / "right")
    usual = measure(call, drive, folder)["flow"].partition
    out = tmp_path / "right_out"
    before = set(out.iterdir())
    code, _, err = call(
        consistency.entry, f"predictions={folder}", *words(drive), f"out={out}", "flow=thermal"
    )
    assert code == 0, err
    assert usual == "flow1"
    (path,) = (
        each for each in set(out.iterdir()) - before if each.name.startswith("consistency_f")
    )
    assert Counts.load(path).partition == path.stem.removeprefix("consistency_").replace(
        "flow", "flow1"
    ).removesuffix("_test")


def test_mistakes_are_one_sentence_and_write_nothing(
    call: Call, drive: Path, tmp_path: Path
) -> None:
    folder = predict(tmp_path / "predicted")

    def refused(sentence: str, *more: str) -> None:
        out = tmp_path / "refused"
        code, _, err = call(
            consistency.entry, f"predictions={folder}", *words(drive), f"out={out}", *more
        )
        assert code == 2
        assert_one_sentence(err, sentence)
        assert not out.exists()

    refused("the exact flow of a video is not known; choose flow=rgb", "flow=exact")
    refused("'flow' has no effect on virtual views", "frames=virtual", "flow=rgb")
    refused("'least_used' has an effect on frames=video only", "frames=next", "least_used=0.5")
    refused("none of 3 pairs of frames has a reliable flow at 100 %", "least_used=1")
    refused("'pairs' has no effect on frames=video", f"pairs={tmp_path}")
    (folder / "2.png").unlink()
    refused("lacks the predictions of 1 of 4 images (2.png); predict every image.")
    predict(folder)
    packed = (drive / "2.png").read_bytes()
    (drive / "2.png").unlink()
    refused("lacks frame 2, which should follow '1'")
    write_png(drive / "2.png", np.zeros((32, 64, 4), np.uint8))
    write_png(folder / "2.png", np.zeros((32, 64), np.uint8))
    refused("frames of a video must have one size, but '1' has 48 x 64 pixels and '2' has 32 x 64")
    (drive / "2.png").write_bytes(packed[:-30])
    refused("2.png cannot be decoded")
    for number in (2, 3, 4):
        (drive / f"{number}.png").unlink()
    (drive / "label" / "3.png").unlink()
    refused("no two consecutive frames among its 1 frame(s)")


def test_images_of_videos_are_not_exported(call: Call, drive: Path, tmp_path: Path) -> None:
    code, _, err = call(consistency.entry, f"export={tmp_path / 'pairs'}", *words(drive))
    assert code == 2
    assert_one_sentence(err, "predict these as NAME.png, then give predictions=FOLDER")
    assert not (tmp_path / "pairs").exists()


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="needs real frames")
def test_published_maps_of_real_frames_have_the_documented_scores(
    call: Call, tmp_path: Path
) -> None:
    place = ("dataset=mfnet", f"dataset.root={REAL / 'mfnet20'}", "frames=video")
    lists = ("dataset.splits.train=test.txt", "dataset.splits.val=test.txt")
    folder = REAL / "predictions20" / "LASNet"
    code, shown, err = call(
        consistency.entry, f"predictions={folder}", *place, *lists, f"out={tmp_path / 'out'}"
    )
    assert code == 0, err
    assert "2 pairs are left out" in " ".join(shown.split())
    found = Counts.load(tmp_path / "out" / "consistency_flow_test.npz")
    # Another version of OpenCV may estimate another flow.
    assert value("TC", found, "released") == pytest.approx(31.29, abs=1)
    assert value("CA", found, "released") == pytest.approx(25.77, abs=1)
    assert value("warping_error", found, "released") == pytest.approx(2.91, abs=0.3)
