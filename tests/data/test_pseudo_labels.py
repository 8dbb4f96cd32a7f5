"""Folders of pseudo-labels: what is read, what stands in for labels, what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.mfnet import CLASSES, MFNet
from rgbt.data.pseudo_labels import FORMAT, PseudoLabelled, PseudoLabels, Unlabelled

NAMES = ["00001D", "00002N"]
HW = (2, 3)
LABEL = np.array([[0, 8, 255], [3, 3, 255]], np.uint8)
CONFIDENCE = np.array([[0, 65535, 13107], [32768, 1, 52428]], np.uint16)


@pytest.fixture
def dataset(write_mfnet: Callable[..., Path]) -> MFNet:
    return MFNet(str(write_mfnet({"train": NAMES}, HW)))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Pseudo-labels of the first image."""
    made = tmp_path / "pseudo"
    write(made, NAMES[0], LABEL, CONFIDENCE)
    say(made)
    return made


def write(folder: Path, name: str, label: np.ndarray, confidence: np.ndarray) -> None:
    for kind, image in (("labels", label), ("confidence", confidence)):
        (folder / kind).mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(folder / kind / f"{name}.png"), image)


def say(folder: Path, **others: Any) -> None:
    manifest = {"format": FORMAT, "classes": CLASSES, "digest": "abc", **others}
    (folder / "pseudo_labels.json").write_text(json.dumps(manifest))


def test_labels_and_confidences_are_read(folder: Path) -> None:
    found = PseudoLabels(folder)
    label, confidence = found.read(NAMES[0], 9)
    assert (found.classes, found.digest) == (CLASSES, "abc")
    assert np.array_equal(label, LABEL)
    assert confidence.dtype == np.float32
    # 13107 and 52428 are a fifth and four fifths of 65535.
    expected = [[0, 1, 0.2], [32768 / 65535, 1 / 65535, 0.8]]
    assert confidence == pytest.approx(np.array(expected), abs=1e-7)


def test_invalid_folders_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        PseudoLabels(tmp_path / "nowhere")
    say(folder, format="rgbt pseudo-labels 9")
    with pytest.raises(InputError, match=r"expected the format .* got 'rgbt pseudo-labels 9'"):
        PseudoLabels(folder)
    (folder / "pseudo_labels.json").write_text("{")
    with pytest.raises(InputError, match="is damaged"):
        PseudoLabels(folder)
    (folder / "pseudo_labels.json").unlink()
    with pytest.raises(InputError, match="is not complete"):
        PseudoLabels(folder)


@pytest.mark.parametrize(
    ("confidence", "found"),
    [
        (np.zeros(HW, np.uint8), "uint8 of shape (2, 3)"),
        (np.zeros((2, 4), np.uint16), "uint16 of shape (2, 4)"),
        (None, "is missing"),
    ],
)
def test_invalid_confidences_are_refused(
    folder: Path, confidence: np.ndarray | None, found: str
) -> None:
    path = folder / "confidence" / f"{NAMES[0]}.png"
    if confidence is None:
        path.unlink()
    else:
        assert cv2.imwrite(str(path), confidence)
    with pytest.raises(InputError, match="16 bits of shape|is missing") as raised:
        PseudoLabels(folder).read(NAMES[0], 9)
    assert found in str(raised.value)


def test_pseudo_labels_replace_labels(dataset: MFNet, folder: Path) -> None:
    own = dataset.read(NAMES[0])
    sample = PseudoLabelled(dataset, folder, with_confidence=True).read(NAMES[0])
    assert np.array_equal(sample.rgb, own.rgb)
    assert np.array_equal(sample.thermal, own.thermal)
    assert sample.label is not None
    assert np.array_equal(sample.label, LABEL)
    assert sample.confidence is not None
    assert sample.confidence[1, 2] == pytest.approx(0.8)
    assert PseudoLabelled(dataset, folder, with_confidence=False).read(NAMES[0]).confidence is None


def test_unlabelled_samples_have_no_label(dataset: MFNet) -> None:
    sample = Unlabelled(dataset).read(NAMES[1])
    assert (sample.label, sample.confidence, sample.name) == (None, None, NAMES[1])
    assert np.array_equal(sample.rgb, dataset.read(NAMES[1]).rgb)


def test_labels_of_other_size_are_refused(dataset: MFNet, folder: Path) -> None:
    labelled = PseudoLabelled(dataset, folder, with_confidence=False)
    with pytest.raises(InputError, match="'00002N' has no pseudo-label in"):
        labelled.read(NAMES[1])
    write(folder, NAMES[1], LABEL[:, :2], CONFIDENCE[:, :2])
    with pytest.raises(
        InputError, match=r"'00002N' has \(2, 3\) pixels but its .* \(2, 2\); predict"
    ):
        labelled.read(NAMES[1])
    write(folder, NAMES[1], LABEL + 1, CONFIDENCE)
    with pytest.raises(InputError, match="label value 9 "):
        labelled.read(NAMES[1])
    say(folder, classes=("road", "car"))
    with pytest.raises(InputError, match=r"classes road, car, but mfnet has unlabeled, car"):
        PseudoLabelled(dataset, folder, with_confidence=False)
