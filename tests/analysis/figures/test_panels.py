"""Qualitative panels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from analysis.figures.inputs import FigureInput
from analysis.figures.panels import (
    QualitativePanel,
    draw,
    image_mious,
    make_missing,
    most_different,
    panel,
)
from rgbt.checks import InputError
from rgbt.data.mfnet import MFNet
from tests.analysis.counts import counts_of
from tests.analysis.figures.drawn import strips

NAMES = ["00001D", "00002N"]
RINGS = strips(4, "ring")


@pytest.fixture
def dataset(write_mfnet) -> MFNet:
    return MFNet(str(write_mfnet({"test": NAMES}, hw=(24, 32))))


def made(dataset: MFNet, names: list[str] = NAMES, **methods) -> QualitativePanel:
    return panel(dataset, methods, names, RINGS)


def right(dataset: MFNet):
    return lambda name: dataset.read(name).label


def test_rows_hold_the_images_and_their_scores(dataset: MFNet) -> None:
    def wrong(name: str) -> np.ndarray:
        return (dataset.read(name).label + 1) % 9

    found = made(dataset, ours=right(dataset), theirs=wrong)
    assert [row.name for row in found.rows] == NAMES
    assert found.rows[1].mious == (100, 0)
    np.testing.assert_array_equal(found.rows[0].rgb, dataset.read("00001D").rgb)
    np.testing.assert_array_equal(found.rows[0].predictions[0], found.rows[0].label)
    # The innermost of four rings takes half of each side.
    assert found.box == (slice(6, 18), slice(8, 24))


def test_scores_of_an_image_exclude_unscored_classes(dataset: MFNet) -> None:
    label = dataset.read("00001D").label
    present = sorted(set(np.unique(label).tolist()) - {255})
    # One class is taken for another everywhere: 0, and of the other what is its own.
    lost, took = present[:2]
    own, more = (label == took).sum(), (label == lost).sum()

    def merged(name: str) -> np.ndarray:
        return np.where(dataset.read(name).label == lost, took, dataset.read(name).label)

    def miou(*left_out: int) -> float:
        dataset.unscored = tuple(dataset.classes[index] for index in left_out)
        return made(dataset, names=NAMES[:1], ours=merged).rows[0].mious[0]

    shared, others = own / (own + more), len(present) - 2
    assert miou() == pytest.approx(100 * (0 + shared + others) / (others + 2))
    assert miou(lost) == pytest.approx(100 * (shared + others) / (others + 1))
    assert miou(lost, took) == pytest.approx(100)


def test_ours_is_painted_in_the_colours_of_the_data_set(dataset: MFNet) -> None:
    figure = draw(made(dataset, names=NAMES[:1], ours=right(dataset)))
    shown = figure.axes[3].images[0].get_array()
    label = dataset.read("00001D").label
    np.testing.assert_array_equal(shown, np.array(dataset.palette, np.uint8)[label])


def test_missing_images_are_beside_each_other_with_their_scores(
    dataset: MFNet, tmp_path: Path
) -> None:
    label = dataset.read("00001D").label
    shifts = {"both": 0, "dark": 1, "cold": 2}  # classes that the prediction is away from the label
    for folder, shift in shifts.items():
        (tmp_path / folder).mkdir()
        wrong = ((label + shift) % 9).astype(np.uint8)
        cv2.imwrite(str(tmp_path / folder / "00001D.png"), wrong)
    options = {"methods": "both", "without_rgb": "dark", "without_thermal": "cold"}
    values = {key: f"CMX:{tmp_path / folder}" for key, folder in options.items()}
    words = ("dataset=mfnet", f"dataset.root={dataset.root}")
    figure = make_missing(FigureInput("crm/fig2", values | {"names": "00001D"}, words, "ring5"))
    shown = [axes.get_title() for axes in figure.axes]
    assert shown == [
        "RGB",
        "thermal",
        "ground truth",
        "CMX\nboth",
        "CMX\nno RGB",
        "CMX\nno thermal",
    ]
    palette = np.array(dataset.palette, np.uint8)
    for axes, shift in zip(figure.axes[3:], shifts.values(), strict=True):
        painted = axes.images[0].get_array()
        np.testing.assert_array_equal(painted, palette[(label + shift) % 9])
        assert [text.get_text() for text in axes.texts] == ["0.0" if shift else "100.0"]


def test_other_sizes_are_refused(dataset: MFNet) -> None:
    with pytest.raises(InputError, match="the prediction of '00001D' by 'ours' is 2x2 pixels"):
        made(dataset, ours=lambda _: np.zeros((2, 2), np.uint8))


def test_strips_have_no_centre(dataset: MFNet) -> None:
    with pytest.raises(InputError, match="no centre to put a box on"):
        panel(dataset, {"ours": right(dataset)}, NAMES, strips(5))


def test_miou_of_images_is_over_the_classes_that_occur() -> None:
    matrices = np.zeros((2, 1, 3, 3), int)
    matrices[0, 0, :2, :2] = [[3, 1], [0, 0]]  # IoU 3/4, and 0 for a class that is only predicted
    found = image_mious(counts_of(matrices, names=("a", "b")))
    assert found["a"] == pytest.approx(37.5)
    assert np.isnan(found["b"])


def test_largest_difference_between_first_and_last() -> None:
    mious = {
        "A": {"x": 10, "y": 50, "z": 0, "w": float("nan")},
        "B": {"x": 99, "y": 99, "z": 99, "w": 99},
        "C": {"x": 30, "y": 10, "z": 20, "w": 90},
    }
    names = ("w", "x", "y", "z")
    assert most_different(mious, names, 3) == ("y", "x", "z")
    with pytest.raises(InputError, match="rows=4, but there are only 3 images"):
        most_different(mious, names, 4)
    with pytest.raises(InputError, match="compares two methods"):
        most_different({"A": mious["A"]}, names, 1)
