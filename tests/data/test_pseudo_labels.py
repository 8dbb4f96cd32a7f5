"""Folders of pseudo-labels: what is read, what stands in for labels, what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.data.mfnet import CLASSES, MFNet
from rgbt.data.pseudo_labels import FORMAT, PseudoLabelled, PseudoLabels, Unlabelled
from tests.data.layouts import refused

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
    label, confidence = found.read(NAMES[0])
    assert (found.classes, found.digest) == (CLASSES, "abc")
    assert np.array_equal(label, LABEL)
    assert confidence.dtype == np.float32
    # 13107 and 52428 are a fifth and four fifths of 65535.
    expected = [[0, 1, 0.2], [32768 / 65535, 1 / 65535, 0.8]]
    assert confidence == pytest.approx(np.array(expected), abs=1e-7)


def test_invalid_folders_are_refused(folder: Path, tmp_path: Path) -> None:
    assert "does not exist" in refused(lambda: PseudoLabels(tmp_path / "nowhere"))
    say(folder, format="rgbt pseudo-labels 9")
    assert "got 'rgbt pseudo-labels 9'" in refused(lambda: PseudoLabels(folder))
    (folder / "pseudo_labels.json").write_text("{")
    assert "is damaged" in refused(lambda: PseudoLabels(folder))
    (folder / "pseudo_labels.json").unlink()
    assert "is not complete" in refused(lambda: PseudoLabels(folder))


def test_pseudo_labels_replace_labels(dataset: MFNet, folder: Path) -> None:
    own = dataset.read(NAMES[0])
    sample = PseudoLabelled(dataset, folder, with_confidence=True).read(NAMES[0])
    assert np.array_equal(sample.rgb, own.rgb)
    assert np.array_equal(sample.thermal, own.thermal)
    assert np.array_equal(sample.label, LABEL)
    assert sample.confidence[1, 2] == pytest.approx(0.8)
    assert PseudoLabelled(dataset, folder, with_confidence=False).read(NAMES[0]).confidence is None


def test_unlabelled_samples_have_no_label(dataset: MFNet) -> None:
    sample = Unlabelled(dataset).read(NAMES[1])
    assert (sample.label, sample.confidence, sample.name) == (None, None, NAMES[1])
    assert np.array_equal(sample.rgb, dataset.read(NAMES[1]).rgb)


@pytest.mark.parametrize(
    ("label", "confidence", "said"),
    [
        (LABEL, CONFIDENCE.astype(np.uint8), "uint8 of shape (2, 3)"),
        (LABEL, np.zeros((2, 4), np.uint16), "uint16 of shape (2, 4)"),
        (LABEL[:, :2], CONFIDENCE[:, :2], "'00002N' has (2, 3) pixels but its pseudo-label in"),
        (LABEL + 1, CONFIDENCE, "label value 9 "),
        (None, None, "'00002N' has no pseudo-label in"),
    ],
)
def test_invalid_labels_are_refused(
    dataset: MFNet, folder: Path, label: Any, confidence: Any, said: str
) -> None:
    if label is not None:
        write(folder, NAMES[1], label, confidence)
    labelled = PseudoLabelled(dataset, folder, with_confidence=False)
    assert said in refused(lambda: labelled.read(NAMES[1]))
    say(folder, classes=("road", "car"))
    told = refused(lambda: PseudoLabelled(dataset, folder, with_confidence=False))
    assert "classes road, car, but mfnet has unlabeled, car" in told
