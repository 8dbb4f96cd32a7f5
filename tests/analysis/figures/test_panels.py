"""Qualitative panels, pairs of frames and masks: what is shown and which pixels are marked."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from analysis.figures.inputs import FIGURES, Config
from analysis.figures.panels import (
    HIDDEN,
    PATCHES,
    STRIDE,
    FramePair,
    PictureOptions,
    draw_pairs,
    masker_overrides,
    panel,
    read_pairs,
    under_mask,
)
from rgbt import consistency
from rgbt.checks import InputError
from rgbt.config.common_options import PredictionFormatOptions
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.data.mfnet import MFNet
from rgbt.files.plain_files import write_json
from rgbt.metrics.counts import Counts
from rgbt.types import MaskPair, Sample
from tests.analysis.figures.drawn import CLASSES, PALETTE, texts
from tests.analysis.figures.framed import METHODS, predict, write_framed
from tests.commands import Call

SYNTH = (
    *("dataset=synth", "dataset.num_train=1", "dataset.num_val=2", "dataset.num_test=2"),
    *("dataset.height=48", "dataset.width=64", "dataset.ego_forward_m=0.5"),
)


@pytest.fixture
def dataset(write_mfnet) -> MFNet:
    return MFNet(str(write_mfnet({"test": ["00001D", "00002N"]}, hw=(24, 32))))


def shifted(dataset: MFNet, folder: Path, by: int, name: str = "00001D") -> Path:
    """A folder with a prediction that is so many classes away from the label."""
    folder.mkdir()
    label = dataset.read(name).label
    assert label is not None
    cv2.imwrite(str(folder / f"{name}.png"), ((label + by) % 9).astype(np.uint8))
    return folder


def test_missing_images_are_beside_each_other_with_their_scores(
    dataset: MFNet, tmp_path: Path
) -> None:
    shifts = {"methods": 0, "without_rgb": 1, "without_thermal": 2}
    values = {key: f"CMX:{shifted(dataset, tmp_path / key, by)}" for key, by in shifts.items()}
    config = Config(("dataset=mfnet", f"dataset.root={dataset.root}"))
    figure, frame = FIGURES["crm/fig2"](config, values | {"names": "00001D"})
    titles = ["RGB", "thermal", "ground truth", "CMX\nboth", "CMX\nno RGB", "CMX\nno thermal"]
    assert [axes.get_title() for axes in figure.axes] == titles
    assert frame["mIoU"].tolist() == [100, 0, 0]
    label, palette = dataset.read("00001D").label, np.array(dataset.palette, np.uint8)
    np.testing.assert_array_equal(figure.axes[0].images[0].get_array(), dataset.read("00001D").rgb)
    for axes, by in zip(figure.axes[3:], shifts.values(), strict=True):
        painted = axes.images[0].get_array()
        np.testing.assert_array_equal(painted, palette[(label + by) % 9])
        assert [text.get_text() for text in axes.texts] == ["0.0" if by else "100.0"]


def test_scores_of_an_image_exclude_unscored_classes(dataset: MFNet, tmp_path: Path) -> None:
    label = np.minimum(dataset.read("00001D").label, 7)  # no pixel of class 8
    cv2.imwrite(str(dataset.files("00001D")[-1]), label)
    present = sorted(set(np.unique(label).tolist()) - {255})
    # One class is taken for another everywhere: 0, and of the other what is its own.
    lost, took = present[:2]
    own, more = (label == took).sum(), (label == lost).sum()
    cv2.imwrite(str(tmp_path / "00001D.png"), np.where(label == lost, took, label))

    def miou(*left_out: int) -> float:
        dataset.unscored = tuple(dataset.classes[index] for index in left_out)
        *_, frame = panel(dataset, {"ours": tmp_path}, ["00001D"], PredictionFormatOptions())
        return frame["mIoU"][0]

    shared, others = own / (own + more), len(present) - 2
    assert miou() == pytest.approx(100 * (0 + shared + others) / (others + 2))
    assert miou(lost) == pytest.approx(100 * (shared + others) / (others + 1))
    assert miou(lost, took) == pytest.approx(100)


# Pairs of frames.


@pytest.fixture(scope="module")
def framed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("framed")
    write_framed(folder)
    return folder


def config_of(folder: Path, *more: str) -> Config:
    words = ("dataset=mfnet", f"dataset.root={folder / 'mf'}", *more)
    return Config(words, {"consistency": "views"})


def values(folder: Path, **changed) -> dict:
    methods = ",".join(f"{method.upper()}:{folder / method}" for method in METHODS)
    return {"pairs": str(folder / "pairs"), "methods": methods, "view_set": 1} | changed


def opened(
    folder: Path, names: Sequence[str], config: Config | None = None, **changed
) -> tuple[list[FramePair], str]:
    given = values(folder, **changed)
    options = PictureOptions(methods=given["methods"], names=",".join(names))
    return read_pairs(config or config_of(folder), options, given["pairs"], given["view_set"])


def pixels(counts: Counts, view: int) -> tuple[np.ndarray, np.ndarray]:
    """(compared, different) pixels of every image, of a set of views from 0."""
    classes = len(counts.classes)
    first = view * (classes + 1)
    labelled = counts.counts[:, first : first + classes].sum(1)
    total = labelled.sum((1, 2))
    return total, total - np.trace(labelled, axis1=1, axis2=2)


def test_outlined_pixels_are_those_that_the_measurement_counts(
    call: Call, framed: Path, tmp_path: Path
) -> None:
    words = (f"predictions={framed / 'b'}", f"pairs={framed / 'pairs'}", f"out={tmp_path}")
    data = ("dataset=mfnet", f"dataset.root={framed / 'mf'}")
    assert call(consistency.entry, *words, *data)[0] == 0
    counts = Counts.load(tmp_path / "test_aligned3.npz")
    for view in (1, 2, 3):
        pairs, _ = opened(framed, counts.names, view_set=view)
        for found, total, wrong in zip(pairs, *pixels(counts, view - 1), strict=True):
            assert 0 < wrong < total
            assert (found.compared.sum(), found.differ[1].sum()) == (total, wrong)
            assert found.shares[1] == pytest.approx(100 * wrong / total)


def test_outlined_pixels_of_true_second_frames_are_those_counted(
    call: Call, tmp_path: Path
) -> None:
    frames = ("frames=next", *SYNTH)
    assert call(consistency.entry, f"export={tmp_path / 'pairs'}", *frames)[0] == 0
    names = tuple(path.stem for path in (tmp_path / "pairs" / "rgb").glob("*.png"))
    predict(tmp_path, names, np.random.default_rng(1))
    words = (f"predictions={tmp_path / 'a'}", f"pairs={tmp_path / 'pairs'}", f"out={tmp_path}")
    assert call(consistency.entry, *words, *frames)[0] == 0
    (path,) = tmp_path.glob("test_next1-*.npz")  # marked by the motion of the data set
    counts = Counts.load(path)
    pairs, second = opened(tmp_path, counts.names, Config(SYNTH))
    assert second == "next frame"
    for found, total, wrong in zip(pairs, *pixels(counts, 0), strict=True):
        assert (found.compared.sum(), found.differ[0].sum()) == (total, wrong)


def test_frames_equal_those_of_data_set_and_export(framed: Path) -> None:
    packed = cv2.imread(str(framed / "mf" / "images" / "00000D.png"), cv2.IMREAD_UNCHANGED)
    second = cv2.imread(str(framed / "pairs" / "rgb" / "00000D_view2.png"))
    heat = cv2.imread(str(framed / "pairs" / "thermal" / "00000D_view2.png"), cv2.IMREAD_GRAYSCALE)
    ((pair,), what) = opened(framed, ["00000D"], view_set=2)
    assert (what, pair.first.name, pair.second.name) == ("synthesised", "00000D", "00000D_view2")
    np.testing.assert_array_equal(pair.first.rgb, packed[..., 2::-1])
    np.testing.assert_array_equal(pair.first.thermal, packed[..., 3])
    np.testing.assert_array_equal(pair.second.rgb, second[..., ::-1])
    np.testing.assert_array_equal(pair.second.thermal, heat)


def frame_pair() -> FramePair:
    """Two frames of 2 x 3 pixels; method B changes its mind about one of four compared pixels."""
    first, second = (
        Sample(
            rgb=np.full((2, 3, 3), 10 * index, np.uint8),
            thermal=np.array([[50, 100, 50], [50, 60 + 90 * index, 50]], np.uint8),
            label=np.array([[0, 1, 2], [0, 0, 255 * index]], np.uint8),
            name="00001N",
        )
        for index in (0, 1)
    )
    class_map = np.array([[0, 1, 2], [2, 1, 0]], np.uint8)
    none, one = np.zeros((2, 3), bool), np.zeros((2, 3), bool)
    one[0, 1] = True
    compared = np.array([[True, True, False], [True, True, False]])
    predictions = ((class_map, class_map), (class_map, class_map))
    return FramePair(first, second, predictions, (none, one), compared)


@pytest.mark.parametrize("layout", ["rows", "columns"])
def test_real_and_synthesised_frames_are_side_by_side(layout: str, tmp_path: Path) -> None:
    pair = frame_pair()
    assert pair.shares == (0, 25)
    legend = (CLASSES, PALETTE, [])
    figure = draw_pairs([pair, pair], ("A", "B"), legend, "synthesised", layout)
    said = texts(figure, tmp_path)
    assert [said.count(text) for text in ("00001N", "synthesised", "0.0 %", "25.0 %")] == [2] * 4
    assert [said.count(text) for text in ("RGB", "thermal", "A", "B")] == [1] * 4
    order = np.arange(20).reshape(4, 5)  # frames x what is shown of each
    order = order if layout == "rows" else order.T
    for place, axes in zip(order.flat, figure.axes, strict=True):
        frame, title = divmod(place, 5)
        picture = axes.images[0].get_array()
        if title == 0:
            assert picture[0, 0, 0] == 10 * (frame % 2)
        if title == 1:  # jet, with the limits 50 and 100 of the first frame in both
            assert picture[:, 0].tolist() == [[0, 0, 127]] * 2
            assert (picture[1, 1].tolist() == [127, 0, 0]) == (frame % 2 == 1)
        # Only of the second frame of method B, at the pixel that differs.
        lines = [line.get_paths()[0] for line in axes.collections]
        assert len(lines) == (title == 4 and frame % 2 == 1)
        for line in lines:
            assert line.get_extents().bounds == pytest.approx((0.5, -0.5, 1, 1))


def test_pairs_that_do_not_fit_are_refused(framed: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="view_set=4: the export has no such set"):
        opened(framed, [], view_set=4)
    for config in (config_of(framed, "consistency.view.camera.fx=500"), Config(SYNTH)):
        with pytest.raises(InputError, match="exported from other images or other second frames"):
            opened(framed, [], Config(config.overrides, {"consistency": "views"}))
    with pytest.raises(InputError, match="there is no prediction"):
        opened(framed, ["00000D"], methods=f"A:{tmp_path}")
    listed = json.loads((framed / "pairs" / "pairs.json").read_text())
    write_json(tmp_path / "pairs.json", listed | {"complete": False})
    with pytest.raises(InputError, match="was interrupted; rerun its command"):
        opened(framed, [], pairs=str(tmp_path))


# Masks.


def sample(height: int = 100, width: int = 140) -> Sample:
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 100, (height, width, 3), dtype=np.uint8)
    return Sample(rgb=rgb, thermal=rgb[..., 0].copy(), label=None, name="00001D")


def test_known_mask_hides_its_cells_in_the_cut_image() -> None:
    """100 x 140 cut to 64 x 128 around the middle: from row 18, column 6."""

    def left_half(image_hw, centre_yx, generator):
        assert (image_hw, centre_yx.tolist()) == ((64, 128), [[32, 64]])
        cells = torch.tensor([[[True, False]]])
        return MaskPair(cells, ~cells)

    (rgb, thermal), hidden = under_mask(sample(), left_half, 64, torch.Generator())
    assert hidden[0, :, :64].all()
    assert not hidden[0, :, 64:].any()
    np.testing.assert_array_equal(hidden[1], ~hidden[0])
    assert (rgb[:, :64] == HIDDEN).all()
    np.testing.assert_array_equal(rgb[:, 64:], sample().rgb[18:82, 70:134])
    np.testing.assert_array_equal(thermal[:, :64, 1], sample().thermal[18:82, 6:70])


def test_the_maskers_of_the_paper() -> None:
    found, multiple = {}, math.lcm(STRIDE, *PATCHES)
    for title, words in masker_overrides(PATCHES).items():
        masker = build(compose(words).masker)
        _, hidden = under_mask(sample(), masker, multiple, torch.Generator().manual_seed(0))
        np.testing.assert_array_equal(hidden[1], ~hidden[0])
        found[title] = hidden[0]
    assert list(found) == ["square", *(f"{n} x {n} pixels" for n in PATCHES)]
    for size in PATCHES:
        hidden = found[f"{size} x {size} pixels"]
        cells = hidden[::size, ::size]
        np.testing.assert_array_equal(np.kron(cells, np.ones((size, size), bool)), hidden)
        assert cells.mean() == 0.5
    rows, columns = np.nonzero(found["square"])
    box = found["square"][rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    assert box.all()
    assert box.shape == (32, 64)  # half of each side
