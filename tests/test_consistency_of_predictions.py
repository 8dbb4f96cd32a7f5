"""TC and CA of any method: exported pairs of frames, and predictions of them read back."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbt import consistency, predict
from rgbt.config.command import built
from rgbt.files.budgets import read_json
from rgbt.metrics.counts import Counts
from rgbt.transforms.view_sets import PUBLISHED
from tests.commands import SPLITS, Call, Trained, assert_one_sentence, short

TEMPORAL = ("+experiment=temporal_con", "masker.patch_size=null", *short(2))
PROTOCOLS = ("aligned", "released")
VIEWS = 3
SYNTH = (
    *("dataset=synth", "dataset.num_train=1", "dataset.num_val=2", "dataset.num_test=2"),
    *("dataset.height=48", "dataset.width=64", "dataset.ego_forward_m=0.5"),
)


def of(data: Path) -> tuple[str, str]:
    return "dataset=mfnet", f"dataset.root={data}"


@pytest.fixture
def exported(call: Call, data: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "pairs"
    code, _, err = call(consistency.entry, f"export={folder}", *of(data))
    assert code == 0, err
    return folder


@pytest.fixture
def predicted(exported: Path, tmp_path: Path) -> Path:
    """Predictions of a method that sees class 1 where red is bright."""
    folder = tmp_path / "predicted"
    folder.mkdir()
    for path in (exported / "rgb").glob("*.png"):
        red = cv2.imread(str(path))[..., 2]
        cv2.imwrite(str(folder / path.name), (red > 127).astype(np.uint8))
    shutil.copy(exported / "pairs.json", folder)
    return folder


def file_of(folder: Path, protocol: str) -> Path:
    return folder / f"consistency_{protocol}_test.npz"


def test_export_writes_both_frames_of_every_pair_and_their_list(exported: Path, data: Path) -> None:
    names = [f"{name}{view}" for name in SPLITS["test"] for view in ("", "_view1", "_view3")]
    for name in names:
        assert cv2.imread(str(exported / "rgb" / f"{name}.png")).shape == (48, 64, 3)
        thermal = cv2.imread(str(exported / "thermal" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        assert thermal.shape == (48, 64)
    packed = cv2.imread(str(data / "images" / "00202N.png"), cv2.IMREAD_UNCHANGED)
    first = cv2.imread(str(exported / "rgb" / "00202N.png"))
    assert np.array_equal(first, packed[..., :3])
    listed = read_json(exported / "pairs.json", dict[str, object], "")
    assert (listed["split"], listed["frames"], listed["views"]) == ("test", "virtual", "published")
    assert listed["sets"] == ["released_1", "released_2", "released_3"]
    assert len(listed["pairs"]) == VIEWS * len(SPLITS["test"])
    lines = (PUBLISHED / "released_2.csv").read_text().splitlines()
    angles = [float(word) for word in lines[3].split(",")]  # the third image, after the header
    expected = dict(zip(("yaw", "pitch", "roll"), angles, strict=True))
    assert listed["pairs"][7] == {
        "first": "00203D", "second": "00203D_view2", "set": 2, **expected,
    }  # fmt: skip


def test_export_is_repeated_and_replaces_nothing_else(
    call: Call, exported: Path, data: Path, tmp_path: Path
) -> None:
    before = {path: path.read_bytes() for path in exported.rglob("*.*")}
    (exported / "rgb" / "00201D.png").unlink()  # as if the first call had been interrupted
    assert call(consistency.entry, f"export={exported}", *of(data))[0] == 0
    assert {path: path.read_bytes() for path in exported.rglob("*.*")} == before
    for folder, words, sentence in (
        (exported, ("split=val",), "holds other pairs (pairs.json); choose another folder"),
        (data, (), "holds other files; choose an empty folder"),
        (data / "test.txt", (), "is a file; choose a folder"),
    ):
        code, _, err = call(consistency.entry, f"export={folder}", *of(data), *words)
        assert code == 2
        assert_one_sentence(err, sentence)


def test_predictions_of_a_network_count_as_the_network_does(
    call: Call, trained: Trained, exported: Path, data: Path, tmp_path: Path
) -> None:
    run = trained(*TEMPORAL)
    folder, out = tmp_path / "written", tmp_path / "counts"
    code, _, err = call(predict.entry, f"run={run}", f"input={exported}", f"out={folder}")
    assert code == 0, err
    words = (f"predictions={folder}", f"pairs={exported}", f"out={out}")
    code, shown, err = call(consistency.entry, *words, *of(data))
    assert code == 0, err
    assert "Consistency of written (mfnet, test; virtual: published)" in " ".join(shown.split())
    for protocol in PROTOCOLS:
        mine = Counts.load(file_of(out, protocol))
        network = Counts.load(file_of(run / "evaluations", protocol))
        assert np.array_equal(mine.counts, network.counts)
        assert (mine.names, mine.night, mine.classes) == (
            *(network.names, network.night, network.classes),
        )
        assert (mine.partition, mine.dataset, mine.split, mine.absent) == (
            *(network.partition, network.dataset, network.split, network.absent),
        )


def test_predictions_of_true_second_frames_count_as_the_network_does(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    run = Path(shutil.copytree(trained(*TEMPORAL), tmp_path / "run"))
    pairs, folder, out = (tmp_path / name for name in ("pairs", "written", "counts"))
    frames = ("frames=next", *SYNTH)
    assert call(consistency.entry, f"run={run}", f"out={tmp_path / 'own'}", *frames)[0] == 0
    assert call(consistency.entry, f"export={pairs}", *frames)[0] == 0
    assert call(predict.entry, f"run={run}", f"input={pairs}", f"out={folder}", *SYNTH)[0] == 0
    words = (f"predictions={folder}", f"pairs={pairs}", f"out={out}")
    code, _, err = call(consistency.entry, *words, *frames)
    assert code == 0, err
    mine, network = (Counts.load(file_of(each, "next")) for each in (out, tmp_path / "own"))
    assert mine.counts.sum() > 0
    assert np.array_equal(mine.counts, network.counts)
    assert (mine.partition, mine.dataset) == (network.partition, network.dataset)


def test_predictions_in_colours_and_with_a_prefix_count_the_same(
    call: Call, data: Path, exported: Path, predicted: Path, tmp_path: Path
) -> None:
    """As an author's script writes them: RGB colours through OpenCV, Pred_weights_NAME.png."""
    colours = np.array(built("dataset", of(data)).palette, np.uint8)
    folder = tmp_path / "painted"
    folder.mkdir()
    for path in predicted.glob("*.png"):
        indices = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(folder / f"Pred_w_{path.name}"), colours[indices])
    shown = {}
    for each in (predicted, folder):
        words = (f"predictions={each}", f"pairs={exported}", *of(data))
        code, out, err = call(consistency.entry, *words)
        assert code == 0, err
        shown[each] = out.replace(each.name, "NAME")
    assert shown[predicted] == shown[folder]
    assert "with red and blue exchanged. Files are named Pred_w_NAME.png." in err


def test_predictions_without_out_write_nothing(call: Call, data: Path, predicted: Path) -> None:
    before = sorted(predicted.parent.rglob("*"))
    code, shown, _ = call(consistency.entry, f"predictions={predicted}", *of(data))
    assert code == 0
    assert "TC aligned" in shown
    assert sorted(predicted.parent.rglob("*")) == before


WRONG = {
    "sets": (("consistency.sets=[released_1]",), "another set of views (released_1, released_2"),
    "camera": (("consistency.view.camera.fx=500",), "give the consistency settings of the export"),
    "split": (("split=val",), "exported with split=test, but split=val is counted; set split=test"),
    "list": (("pairs={tmp}",), "pairs.json does not exist; name the folder of the export with"),
    "run": (("run=runs/1c0ffe",), "'run' has no effect on images of pairs"),
    "both": (("export={tmp}/more",), "expected one of export=... and predictions=..., got both"),
    "key": (("model=mfnet",), "'model' has no effect on images of pairs"),
}


@pytest.mark.parametrize(("words", "sentence"), WRONG.values(), ids=WRONG)
def test_predictions_with_other_settings_are_refused(
    call: Call, data: Path, predicted: Path, tmp_path: Path, words: tuple[str, ...], sentence: str
) -> None:
    given = (word.format(tmp=tmp_path) for word in words)
    code, _, err = call(consistency.entry, f"predictions={predicted}", *of(data), *given)
    assert code == 2
    assert_one_sentence(err, sentence)


def test_predictions_in_other_files_are_refused(
    call: Call, data: Path, predicted: Path, exported: Path
) -> None:
    def refused(sentence: str) -> None:
        code, _, err = call(consistency.entry, f"predictions={predicted}", *of(data))
        assert code == 2
        assert_one_sentence(err, sentence)

    path = predicted / "00202N_view2.png"
    content = path.read_bytes()
    path.unlink()
    refused("lacks the predictions of 1 of 12 images (00202N_view2.png)")
    cv2.imwrite(str(path), np.zeros((24, 32), np.uint8))
    refused(f"{path} is 24x32 pixels but its image is 48x64")
    path.write_bytes(content)
    (predicted / "elsewhere.png").write_bytes(content)
    refused("holds 1 PNG files of no exported image (elsewhere.png)")
    (predicted / "elsewhere.png").unlink()
    label = data / "labels" / "00201D.png"
    cv2.imwrite(str(label), np.zeros((48, 64), np.uint8))
    refused("the pairs were exported from other images (mfnet, ")
    listed = json.loads((exported / "pairs.json").read_text())
    (predicted / "pairs.json").write_text(json.dumps({**listed, "complete": False}))
    refused("the export of mfnet was interrupted; rerun its command")
    (predicted / "pairs.json").write_text("{}")
    refused("is damaged")


def test_export_of_an_image_named_like_a_view_is_refused(
    call: Call, data: Path, tmp_path: Path
) -> None:
    for folder in ("images", "labels"):
        shutil.copy(data / folder / "00202N.png", data / folder / "00201D_view1.png")
    (data / "test.txt").write_text("00201D\n00201D_view1\n")
    code, _, err = call(consistency.entry, f"export={tmp_path / 'pairs'}", *of(data))
    assert code == 2
    assert_one_sentence(err, "'00201D' would have the name '00201D_view1' of another image")


def test_a_network_ignores_no_option_of_predictions(call: Call, tmp_path: Path) -> None:
    code, _, err = call(consistency.entry, "run=x", f"pairs={tmp_path}")
    assert code == 2
    assert_one_sentence(err, "'pairs' has no effect on a network; omit it")
    code, _, err = call(consistency.entry, f"export={tmp_path / 'pairs'}")
    assert code == 2
    assert_one_sentence(err, "no data set is named; set dataset=mfnet")
