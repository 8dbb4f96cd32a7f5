"""Pairs of frames: the pixels that are outlined are those that TC counts as different."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from analysis.figures.frame_pairs import Frame, FramePair, Pairs
from analysis.figures.inputs import FigureInput
from analysis.figures.pairs import OUTLINED, coloured, draw, make
from rgbt import consistency
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from tests.analysis.figures.drawn import CLASSES, PALETTE, texts
from tests.analysis.figures.framed import METHODS, NAMES, predict, write_framed
from tests.commands import Call

SYNTH = (
    *("dataset=synth", "dataset.num_train=1", "dataset.num_val=2", "dataset.num_test=2"),
    *("dataset.height=48", "dataset.width=64", "dataset.ego_forward_m=0.5"),
)


@pytest.fixture(scope="module")
def framed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("framed")
    write_framed(folder)
    return folder


def given(folder: Path, *overrides: str, figure: str = "temporal/fig6", **values) -> FigureInput:
    words = overrides or ("dataset=mfnet", f"dataset.root={folder / 'mf'}")
    every = {
        "pairs": str(folder / "pairs"),
        "methods": ",".join(f"{each.upper()}:{folder / each}" for each in METHODS),
    }
    return FigureInput(figure, every | values, words, "ring5")


def pixels(counts: Counts, view: int) -> tuple[np.ndarray, np.ndarray]:
    """(compared, different) pixels of every image, of a set of views from 0."""
    classes = len(counts.classes)
    first = view * (classes + 1)
    labelled = counts.counts[:, first : first + classes].sum(1)
    total = labelled.sum((1, 2))
    return total, total - np.trace(labelled, axis1=1, axis2=2)


@pytest.mark.parametrize("view", [1, 2, 3])
def test_outlined_pixels_are_those_that_the_measurement_counts(
    call: Call, framed: Path, tmp_path: Path, view: int
) -> None:
    pairs = Pairs(given(framed, view_set=view))
    for index, method in enumerate(METHODS):
        words = (f"predictions={framed / method}", f"pairs={framed / 'pairs'}", f"out={tmp_path}")
        data = ("dataset=mfnet", f"dataset.root={framed / 'mf'}")
        assert call(consistency.entry, *words, *data)[0] == 0
        counts = Counts.load(tmp_path / "consistency_aligned_test.npz")
        compared, different = pixels(counts, view - 1)
        for name, total, wrong in zip(counts.names, compared, different, strict=True):
            found = pairs.read(name)
            assert 0 < wrong < total
            assert (found.compared.sum(), found.differ[index].sum()) == (total, wrong)
            assert found.shares[index] == pytest.approx(100 * wrong / total)


def test_outlined_pixels_of_true_second_frames_are_those_counted(
    call: Call, tmp_path: Path
) -> None:
    frames = ("frames=next", *SYNTH)
    assert call(consistency.entry, f"export={tmp_path / 'pairs'}", *frames)[0] == 0
    names = tuple(path.stem for path in (tmp_path / "pairs" / "rgb").glob("*.png"))
    predict(tmp_path, names, np.random.default_rng(1))
    words = (f"predictions={tmp_path / 'a'}", f"pairs={tmp_path / 'pairs'}", f"out={tmp_path}")
    assert call(consistency.entry, *words, *frames)[0] == 0
    counts = Counts.load(tmp_path / "consistency_next_test.npz")
    pairs = Pairs(given(tmp_path, *SYNTH))
    assert pairs.second == "next frame"
    for name, total, wrong in zip(counts.names, *pixels(counts, 0), strict=True):
        found = pairs.read(name)
        assert (found.compared.sum(), found.differ[0].sum()) == (total, wrong)


def test_frames_are_those_of_the_data_set_and_of_the_export(framed: Path) -> None:
    packed = cv2.imread(str(framed / "mf" / "images" / "00000D.png"), cv2.IMREAD_UNCHANGED)
    second = cv2.imread(str(framed / "pairs" / "rgb" / "00000D_view2.png"))
    heat = cv2.imread(str(framed / "pairs" / "thermal" / "00000D_view2.png"), cv2.IMREAD_GRAYSCALE)
    first, later = Pairs(given(framed, view_set=2)).read("00000D").frames
    np.testing.assert_array_equal(first.rgb, packed[..., 2::-1])
    np.testing.assert_array_equal(first.thermal, packed[..., 3])
    np.testing.assert_array_equal(later.rgb, second[..., ::-1])
    np.testing.assert_array_equal(later.thermal, heat)


def frame_pair() -> FramePair:
    """Two frames of 2 x 3 pixels; method B changes its mind about one of four compared pixels."""
    frames = tuple(
        Frame(
            rgb=np.full((2, 3, 3), 10 * index, np.uint8),
            thermal=np.array([[50, 100, 50], [50, 60 + 90 * index, 50]], np.uint8),
            label=np.array([[0, 1, 2], [0, 0, 255 * index]], np.uint8),
        )
        for index in (0, 1)
    )
    class_map = np.array([[0, 1, 2], [2, 1, 0]], np.uint8)
    none, one = np.zeros((2, 3), bool), np.zeros((2, 3), bool)
    one[0, 1] = True
    compared = np.array([[True, True, False], [True, True, False]])
    return FramePair(
        "00001N", (frames[0], frames[1]), ((class_map,) * 2,) * 2, (none, one), compared
    )


@pytest.mark.parametrize("layout", ["rows", "columns"])
def test_real_and_synthesised_frames_are_side_by_side(layout: str, tmp_path: Path) -> None:
    pair = frame_pair()
    assert pair.shares == (0, 25)
    figure = draw([pair, pair], ("A", "B"), (CLASSES, PALETTE), "synthesised", layout)
    said = texts(figure, tmp_path)
    assert [said.count(each) for each in ("00001N", "synthesised", OUTLINED)] == [2, 2, 1]
    assert [said.count(each) for each in ("RGB", "thermal", "A", "B")] == [1] * 4
    assert [said.count(each) for each in ("0.0 %", "25.0 %")] == [2, 2]
    order = np.arange(20).reshape(4, 5)  # frames x what is shown of each
    order = order if layout == "rows" else order.T
    shown = {place: axes for place, axes in zip(order.flat, figure.axes, strict=True)}
    for place, axes in shown.items():
        frame, title = divmod(place, 5)
        picture = axes.images[0].get_array()
        if title == 0:
            assert picture[0, 0, 0] == 10 * (frame % 2)
        # Only of the second frame of method B, at the pixel that differs.
        lines = [line.get_paths()[0] for line in axes.collections]
        assert len(lines) == (title == 4 and frame % 2 == 1)
        for line in lines:
            assert line.get_extents().bounds == pytest.approx((0.5, -0.5, 1, 1))


def test_thermal_has_the_colours_of_the_paper_and_one_scale_for_both_frames() -> None:
    levels = np.array([[50, 100, 150]], np.uint8)
    # Jet begins with dark blue and ends with dark red, also above the limits.
    found = coloured(levels, (50, 100))
    assert found.tolist() == [[[0, 0, 127], [127, 0, 0], [127, 0, 0]]]
    assert coloured(levels, (7, 7)).tolist() == [[[127, 0, 0]] * 3]


def test_largest_difference_is_picked_by_the_share_that_differs(framed: Path) -> None:
    pairs = Pairs(given(framed))
    gaps = {name: np.ptp(pairs.read(name).shares) for name in NAMES}
    figure = make(given(framed, pick="largest_difference", rows=1))
    titles = {axes.get_title() for axes in figure.axes}
    assert max(gaps, key=lambda name: gaps[name]) in titles
    assert min(gaps, key=lambda name: gaps[name]) not in titles


def test_pairs_that_do_not_fit_are_refused(framed: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="set 2|view_set=4: the export has the sets"):
        Pairs(given(framed, view_set=4))
    words = ("dataset=mfnet", f"dataset.root={framed / 'mf'}")
    with pytest.raises(InputError, match="exported with other second frames"):
        Pairs(given(framed, *words, "consistency.view.camera.fx=500"))
    with pytest.raises(InputError, match="exported from other images"):
        Pairs(given(framed, *SYNTH))
    with pytest.raises(InputError, match="there is no prediction .*rgbt predict input="):
        Pairs(given(framed, methods=f"A:{tmp_path}")).read("00000D")
    with pytest.raises(InputError, match="the export has no image '00009D'"):
        make(given(framed, names="00009D"))
    with pytest.raises(InputError, match="rows=3, but the export has 2 pairs"):
        make(given(framed, rows=3))
    shutil.copytree(framed / "a", tmp_path / "small")
    cv2.imwrite(str(tmp_path / "small" / "00000D_view1.png"), np.zeros((4, 4), np.uint8))
    with pytest.raises(InputError, match="00000D_view1.png is 4x4 pixels but its image is 48x64"):
        Pairs(given(framed, methods=f"A:{tmp_path / 'small'}")).read("00000D")


def test_unfinished_export_is_refused(framed: Path, tmp_path: Path) -> None:
    listed = json.loads((framed / "pairs" / "pairs.json").read_text())
    (tmp_path / "pairs").mkdir()
    (tmp_path / "pairs" / "pairs.json").write_text(json.dumps(listed | {"complete": False}))
    with pytest.raises(InputError, match="was interrupted; rerun its command"):
        Pairs(given(framed, pairs=str(tmp_path / "pairs")))
