"""New images of any folder: which files are pairs, by every data set's own patterns."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from rgbt.data.cache.dataset import CachedDataset
from rgbt.data.freiburg import LAYOUTS as FREIBURG
from rgbt.data.images import PairPattern, PairReader
from rgbt.data.kp import KP
from rgbt.data.mfnet import MFNet
from rgbt.data.new_images import find_pairs
from rgbt.data.pst900 import PST900
from rgbt.data.to_predict import of_arrays, of_files, of_path, of_split
from rgbt.types import Sample
from tests.conftest import WriteMFNet, write_png
from tests.data import folder_files as own
from tests.data.folder_files import refused

HW = (6, 8)
RGB = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(*HW, 3)
GREY = np.arange(48, dtype=np.uint8).reshape(HW)
COUNTS = (21800 + 100 * np.arange(48)).astype(np.uint16).reshape(HW)


def write(root: Path, *names: str) -> Path:
    """Files by what their names say: thermal of 16 or 8 bits, RGB, four channels."""
    for name in names:
        path = root / name
        kind = path.parent.name.lower()
        if "packed" in name:
            write_png(path, np.dstack([RGB, GREY]))
        elif kind in ("ir", "fl_ir_aligned", "imagesir"):
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), COUNTS)
        else:
            write_png(path, GREY if kind in ("thermal", "lwir") or "_lwir_" in name else RGB)
    return root


MINE = (
    PairPattern(
        "{sequence}/rgb/{name}.jpg", "{sequence}/ir/{name}_ir.tif", "{sequence}/{name}.png"
    ),
)


PACKED = ("images/packed.png", "images/packed.png")
KAIST = ("images/set00/V000/visible/I1.jpg", "images/set00/V000/lwir/I1.jpg")
DAY = ("test/day/ImagesRGB/1_20_rgb.png", "test/day/ImagesIR/1_2_ir.png")
NIGHT = ("test/night/ImagesRGB/3_40_rgb.png", "test/night/ImagesIR/3_40_ir.png")


@pytest.mark.parametrize(
    ("patterns", "expected"),
    [
        (MINE, {"day_1": ("day/rgb/1.jpg", "day/ir/1_ir.tif")}),
        (MINE, {"1": ("rgb/1.jpg", "ir/1_ir.tif")}),
        (MINE, {"1": ("RGB/1.JPG", "ir/1_IR.TIF")}),
        (MINE, {"1": ("rgb/1.png", "ir/1_ir.png")}),
        (MINE, {"1": ("rgb/1.png", "thermal/1.png")}),
        (MINE, {"1": ("rgb/1.bmp", "Thermal/1.tif")}),
        (MINE, {"1_packed": ("1_packed.png", "1_packed.png")}),
        (MFNet.images.layouts, {"packed": PACKED}),
        (MFNet.images.layouts, {"packed": ("packed.png", "packed.png")}),
        (MFNet.images.layouts, {"1": ("RGB/1.png", "Thermal/1.png")}),
        (KP.images.layouts, {"set00_V000_I1": KAIST}),
        (KP.images.layouts, {"I1": ("visible/I1.jpg", "lwir/I1.jpg")}),
        (
            KP.images.layouts,
            {"set00_V000_I1": ("set00_V000_visible_I1.png", "set00_V000_lwir_I1.png")},
        ),
        (PST900.images.layouts, {"new_a": ("new/rgb/a.png", "new/thermal/a.png")}),
        (PST900.images.layouts, {"a": ("rgb/a.png", "thermal/a.png")}),
        (FREIBURG, {"1_2": ("fl_rgb/fl_rgb_1_2.png", "fl_ir_aligned/fl_ir_aligned_1_2.png")}),
        (FREIBURG, {"test_day_1_2": DAY, "test_night_3_40": NIGHT}),
    ],
)
def test_find_pairs_uses_patterns_of_data_set(
    tmp_path: Path, patterns: tuple[PairPattern, ...], expected: dict[str, tuple[str, str]]
) -> None:
    write(tmp_path, *(name for pair in expected.values() for name in pair))
    found = find_pairs(tmp_path, patterns, "harbour")
    pairs = {
        pair.name: tuple(str(path.relative_to(tmp_path)) for path in pair[1:])
        for pair in found.pairs
    }
    assert pairs == expected
    assert (found.alone, found.others) == ({}, ())


def test_thermal_images_and_labels_are_not_rgb(tmp_path: Path) -> None:
    flat = (PairPattern("{name}.png", "{name}_ir.png", "{name}_mask.png"),)
    write_png(tmp_path / "7_mask.png", GREY)
    write(tmp_path, *(f"{name}.png" for name in ("10", "9", "7", "9_ir", "10_ir", "7_ir")))
    write(tmp_path, "view.jpg", "notes/x.png")
    found = find_pairs(tmp_path, flat, "harbour")
    assert [pair.name for pair in found.pairs] == ["7", "9", "10"]
    assert found.others == (tmp_path / "notes/x.png", tmp_path / "view.jpg")


def test_no_pair_is_refused_with_folder_content(tmp_path: Path) -> None:
    def why(*files: str) -> str:
        root = write(tmp_path / str(len(list(tmp_path.iterdir()))), *files)
        return refused(lambda: find_pairs(root, MINE, "harbour"))

    for files, words in (
        (("1.png", "2.png"), ("holds 1.png, 2.png. Expected the files of harbour (RGB {",)),
        (
            ("rgb/1.jpg", "ir/other_ir.tif"),
            ("rgb/1.jpg would be ", "ir/1_ir.tif, but ", "/ir holds other_ir.tif. Expected"),
        ),
        (("rgb/1.bmp", "rgb/1.tif", "ir/1_ir.tif"), ("would both be called '1'",)),
        (("rgb/1.bmp", "ir/1_ir.png", "ir/1_ir.bmp"), ("could both be the thermal image of one",)),
    ):
        sentence = why(*files)
        assert all(word in sentence for word in words), sentence


def test_new_images_are_read_like_training_images(tmp_path: Path) -> None:
    dataset = own.folder(own.write_folder(tmp_path / "known"))
    new = tmp_path / "new"
    own.write_frame(new, "sea", "1")
    (new / "sea" / "mask" / "1.png").unlink()
    chosen = of_path(dataset, str(new), "raise")
    (sample,) = chosen.samples("raise")
    own.write_frame(tmp_path / "known", "sea", "1")
    expected = own.folder(tmp_path / "known").read("sea_1")
    assert sample.label is None
    assert sample.name == "sea_1"
    assert np.array_equal(sample.thermal, expected.thermal)
    assert np.array_equal(sample.rgb, expected.rgb)

    files = (new / "sea/rgb/1.png", new / "sea/ir/1_ir.tif")
    (alone,) = of_files(dataset, *files).samples("raise")
    assert np.array_equal(alone.thermal, expected.thermal)
    assert alone.name == "1"


def test_new_freiburg_images_are_cropped_and_scaled(tmp_path: Path) -> None:
    write(tmp_path, "fl_rgb/fl_rgb_1.png", "fl_ir_aligned/fl_ir_aligned_1.png")
    images = PairReader(
        layouts=FREIBURG, counts=True, crop=(1, 5, 2, 8), thermal_range=(21800, 23700)
    )
    ((_, rgb, thermal),) = find_pairs(tmp_path, images.layouts, "freiburg").pairs
    sample = images.read("1", rgb, thermal)
    assert np.array_equal(sample.rgb, RGB[1:5, 2:8])
    # Count 21800 + 100 n lies at 100 n / 1900 of the range: 255 n / 19, halves upwards.
    index = np.arange(48).reshape(HW)[1:5, 2:8]
    assert np.array_equal(sample.thermal, np.minimum((2 * 255 * index + 19) // 38, 255))


class Reading:
    """A data set that only says how its images are read."""

    def __init__(self, images: PairReader) -> None:
        self.images = images

    def pair(self, name: str) -> Sample:
        raise NotImplementedError


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_arrays_of_camera_values_are_read_like_files(tmp_path: Path, dtype: type) -> None:
    write(tmp_path, "fl_rgb/fl_rgb_1.png", "fl_ir_aligned/fl_ir_aligned_1.png")
    images = PairReader(layouts=FREIBURG, crop=(1, 5, 2, 8), thermal_range=(21800, 23700))
    ((_, rgb, thermal),) = find_pairs(tmp_path, images.layouts, "freiburg").pairs
    expected = images.read("1", rgb, thermal)
    sample = of_arrays(Reading(images), RGB, COUNTS.astype(dtype))
    assert np.array_equal(sample.rgb, expected.rgb)
    assert np.array_equal(sample.thermal, expected.thermal)
    seen = of_arrays(Reading(images), sample.rgb, sample.thermal)
    assert np.array_equal(seen.thermal, expected.thermal), "grey levels are neither cut nor scaled"


def test_arrays_of_unclear_or_wrong_values_are_refused() -> None:
    low = Reading(PairReader(layouts=FREIBURG, thermal_range=(0, 200)))
    assert "8 bits may be grey levels or values of dataset.thermal_range=[0, 200]" in refused(
        lambda: of_arrays(low, RGB, GREY)
    )
    counts = Reading(PairReader(layouts=FREIBURG, counts=True, thermal_range=(21800, 23700)))
    assert "expected a thermal image of 16 bits" in refused(
        lambda: of_arrays(counts, RGB, COUNTS.astype(np.float32))
    )
    assert "does not declare how to read new images" in refused(
        lambda: of_arrays(SimpleNamespace(splits=("test",)), RGB, COUNTS)
    )


def test_bad_new_images_raise_or_are_skipped(tmp_path: Path) -> None:
    dataset = own.folder(own.write_folder(tmp_path / "known"))
    new = write(tmp_path / "new", *(f"rgb/{n}.png" for n in "123"))
    write(new, "ir/1_ir.tif", "ir/2_ir.tif")
    assert "1 of 3 RGB images have no thermal image, the first is " in refused(
        lambda: of_path(dataset, str(new), "raise")
    )
    own.write_tiff(new / "ir" / "2_ir.tif", COUNTS[:3])
    chosen = of_path(dataset, str(new), "skip")
    assert "'2': RGB is 6x8 pixels but thermal is 3x8" in refused(
        lambda: list(chosen.samples("raise"))
    )
    assert [sample.name for sample in chosen.samples("skip")] == ["1"]
    assert sorted(chosen.skipped) == [str(new / "rgb/3.png"), "2"]
    (new / "rgb" / "1.png").write_bytes(b"")
    assert "none of the 2 images can be read" in refused(
        lambda: list(of_path(dataset, str(new), "skip").samples("skip"))
    )


def test_split_is_predicted_without_labels(write_mfnet: WriteMFNet, tmp_path: Path) -> None:
    root = write_mfnet({"new": ["00001D"]})
    (root / "labels" / "00001D.png").unlink()
    dataset = MFNet(str(root), splits={"new": "new.txt"})
    for each in (dataset, CachedDataset(dataset, tmp_path / "cache", num_threads=1)):
        (sample,) = of_split(each, "new").samples("raise")
        assert sample.label is None


def test_an_unlabelled_split_needs_nothing_else(tmp_path: Path) -> None:
    for name in "12":
        own.write_frame(tmp_path, "sea", name)
    for path in (tmp_path / "sea" / "mask").iterdir():
        path.unlink()
    changes = {"folders": {"new": "sea"}, "unlabelled": ("new",), "night": "*night*"}
    dataset = own.folder(tmp_path, **changes)
    assert dataset.read("sea_1").label is None
    assert "dataset.label: " in refused(lambda: own.folder(tmp_path, folders={"new": "sea"}))


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    dataset = own.folder(own.write_folder(tmp_path / "known"))
    new = write(tmp_path / "new", "rgb/a.png", "ir/a_ir.tif")
    chosen = of_path(dataset, str(new), "raise")
    for taken in (new, new / "rgb", new / "ir"):
        assert "would be overwritten" in refused(lambda taken=taken: chosen.check_out(taken))
    chosen.check_out(tmp_path / "out")
    write(new, "rgb/a_overlay.png", "ir/a_overlay_ir.tif")
    twice = of_path(dataset, str(new), "raise")
    assert "'a' and 'a_overlay' would both be written to" in refused(
        lambda: twice.check_out(tmp_path / "out")
    )
