"""Predicting as a user does: class maps, pseudo-labels, networks of other classes."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbt import predict
from rgbt.data.pseudo_labels import PseudoLabels
from tests.commands import SPLITS, Call, Trained, assert_one_sentence, short

PREDICT = predict.entry
ONE = ("+experiment=mfnet", "masker.patch_size=null", *short(1))


def image(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


@pytest.mark.slow
def test_pseudo_labels_of_a_run(call: Call, trained: Trained, tmp_path: Path) -> None:
    folder, out = trained(*ONE), tmp_path / "pseudo"
    requested = (f"run={folder}", "input=train", f"out={out}", "pseudo_labels=true")
    code, said, err = call(PREDICT, *requested)
    assert code == 0, err
    assert str(out) in said
    manifest = PseudoLabels(out).manifest
    assert manifest["teacher"] == folder.name
    assert (manifest["view"], manifest["kept"], manifest["images"]) == ("rgbt", 1, 8)

    plain = tmp_path / "plain"
    assert call(PREDICT, f"run={folder}", "input=train", f"out={plain}")[0] == 0
    for name in SPLITS["train"]:
        label = image(out / "labels" / f"{name}.png")
        assert np.array_equal(label, image(plain / f"{name}.png"))
        confidence = image(out / "confidence" / f"{name}.png")
        assert confidence.dtype == np.uint16
        # The largest of nine probabilities is at least a ninth.
        assert confidence.min() >= 65535 // 9


def with_missing(data: Path, folder: Path, missing: str) -> Path:
    """Folders rgb and thermal of the test split, in which one image of each pair is black."""
    for name in SPLITS["test"]:
        packed = image(data / "images" / f"{name}.png")
        for part, pixels in (("rgb", packed[..., :3]), ("thermal", packed[..., 3])):
            (folder / part).mkdir(parents=True, exist_ok=True)
            black = np.zeros_like(pixels)
            cv2.imwrite(str(folder / part / f"{name}.png"), black if part == missing else pixels)
    return folder


def predicted(call: Call, out: Path, *words: str) -> list[np.ndarray]:
    code, _, err = call(PREDICT, f"out={out}", *words)
    assert code == 0, err
    return [image(out / f"{name}.png") for name in SPLITS["test"]]


@pytest.mark.parametrize("missing", ["rgb", "thermal"])
def test_missing_image_is_predicted_as_a_black_one(
    call: Call, trained: Trained, data: Path, tmp_path: Path, missing: str
) -> None:
    run = f"run={trained(*ONE)}"
    black = with_missing(data, tmp_path / "black", missing)
    whole = with_missing(data, tmp_path / "whole", "none")
    wanted = predicted(call, tmp_path / "wanted", run, f"input={black}")
    clean = predicted(call, tmp_path / "clean", run, "input=test")
    removed = f"corruption=removed:{missing}"
    for number, word in enumerate(("input=test", f"input={whole}")):
        found = predicted(call, tmp_path / f"out{number}", run, removed, word)
        assert all(map(np.array_equal, found, wanted))
        assert not any(map(np.array_equal, found, clean))


def test_corruption_of_time_needs_a_split(
    call: Call, trained: Trained, data: Path, tmp_path: Path
) -> None:
    run, whole = f"run={trained(*ONE)}", with_missing(data, tmp_path / "whole", "none")
    later = ("corruption=delayed", "severity=1")
    code, _, err = call(PREDICT, run, f"out={tmp_path / 'no'}", f"input={whole}", *later)
    assert code == 2
    assert_one_sentence(err, "input")
    shown = predicted(call, tmp_path / "delayed", run, "input=test", *later)
    # 00203D is the second image of the day, so its thermal image is that of 00201D.
    names = ("00203D", "00201D")
    rgb, thermal = (image(data / "images" / f"{name}.png") for name in names)
    cv2.imwrite(str(tmp_path / "rgb.png"), rgb[..., :3])
    cv2.imwrite(str(tmp_path / "thermal.png"), thermal[..., 3])
    files = (f"rgb={tmp_path / 'rgb.png'}", f"thermal={tmp_path / 'thermal.png'}")
    assert call(PREDICT, run, f"out={tmp_path / 'one'}", *files)[0] == 0
    assert np.array_equal(shown[2], image(tmp_path / "one" / "rgb.png"))


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("pseudo_labels=true", "corruption=removed:rgb"), "pseudo_labels=true"),
        (("threshold=0.5",), "threshold=0.5"),
        (("severity=2",), "severity"),
        (("corruption=remov",), "corruption"),
    ],
)
def test_corruption_without_effect_is_refused(
    call: Call, tmp_path: Path, words: tuple[str, ...], sentence: str
) -> None:
    code, _, err = call(PREDICT, "run=x", "input=test", f"out={tmp_path / 'out'}", *words)
    assert code == 2
    assert_one_sentence(err, sentence)
