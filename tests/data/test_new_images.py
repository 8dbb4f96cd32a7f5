"""New images of any folder: which files are pairs, by every data set's own patterns."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from rgbt.data.freiburg import LAYOUTS as FREIBURG
from rgbt.data.images import PairPattern, PairReader
from rgbt.data.kp import KP
from rgbt.data.mfnet import MFNet
from rgbt.data.new_images import of_arrays, of_files, of_path, of_split
from rgbt.data.pst900 import PST900
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
    files = ("fl_rgb/fl_rgb_1.png", "fl_ir_aligned/fl_ir_aligned_1.png")
    expected = images.read("1", *(tmp_path / each for each in files))
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


def test_an_unlabelled_split_needs_nothing_else(tmp_path: Path) -> None:
    for name in "12":
        own.write_frame(tmp_path, "sea", name)
    for path in (tmp_path / "sea" / "mask").iterdir():
        path.unlink()
    changes = {"folders": {"new": "sea"}, "unlabelled": ("new",), "night": "*night*"}
    dataset = own.folder(tmp_path, **changes)
    assert dataset.read("sea_1").label is None
    assert "dataset.label: " in refused(lambda: own.folder(tmp_path, folders={"new": "sea"}))


MINE = (PairPattern("{sequence}/rgb/{name}.jpg", "{sequence}/ir/{name}_ir.tif"),)
DAY = ("test/day/ImagesRGB/1_20_rgb.png", "test/day/ImagesIR/1_2_ir.png")
NIGHT = ("test/night/ImagesRGB/3_40_rgb.png", "test/night/ImagesIR/3_40_ir.png")


@pytest.mark.parametrize(
    ("layouts", "expected"),
    [
        (MINE, {"day_1": ("day/rgb/1.jpg", "day/ir/1_ir.tif")}),
        (MINE, {"1": ("rgb/1.png", "thermal/1.png"), "10": ("rgb/10.png", "thermal/10.png")}),
        (MINE, {"1": ("rgb/1.tif", "thermal/1.tif")}),
        (MINE, {"1_packed": ("1_packed.png", "1_packed.png")}),
        (MFNet.images.layouts, {"packed": ("images/packed.png", "images/packed.png")}),
        (MFNet.images.layouts, {"1": ("RGB/1.png", "Thermal/1.png")}),
        (
            KP.images.layouts,
            {
                "set00_V000_I1": (
                    "images/set00/V000/visible/I1.jpg",
                    "images/set00/V000/lwir/I1.jpg",
                )
            },
        ),
        (PST900.images.layouts, {"new_a": ("new/rgb/a.png", "new/thermal/a.png")}),
        (FREIBURG, {"test_night_3_40": NIGHT}),
        (FREIBURG[2:], {"test_day_1_2": DAY}),
    ],
)
def test_folder_is_read_by_patterns_of_data_set(
    tmp_path: Path,
    layouts: tuple[PairPattern, ...],
    expected: dict[str, tuple[str, str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write(tmp_path, *(name for pair in expected.values() for name in pair))
    read: dict[str, tuple[str, ...]] = {}

    def noted(self: PairReader, name: str, *paths: Path) -> Sample:
        read[name] = tuple(str(path.relative_to(tmp_path)) for path in paths)
        return Sample(RGB, GREY, None, name)

    monkeypatch.setattr(PairReader, "read", noted)
    chosen = of_path(Reading(PairReader(layouts=layouts)), str(tmp_path), "raise")
    assert [sample.name for sample in chosen.samples("raise")] == sorted(expected, key=len)
    assert read == expected


def test_thermal_images_are_not_rgb(tmp_path: Path) -> None:
    flat = Reading(PairReader(layouts=(PairPattern("{name}.png", "{name}_ir.png"),)))
    write(tmp_path, *(f"{name}.png" for name in ("10", "9", "7", "9_ir", "10_ir", "7_ir")))
    assert of_path(flat, str(tmp_path), "raise").names == ("7", "9", "10")


def test_new_images_are_read_like_training_images(tmp_path: Path) -> None:
    dataset = own.folder(own.write_folder(tmp_path / "known"))
    new = tmp_path / "new"
    own.write_frame(new, "sea", "1")
    (sample,) = of_path(dataset, str(new), "raise").samples("raise")
    own.write_frame(tmp_path / "known", "sea", "1")
    expected = own.folder(tmp_path / "known").read("sea_1")
    files = (new / "sea/rgb/1.png", new / "sea/ir/1_ir.tif")
    (alone,) = of_files(dataset, *files).samples("raise")
    for each in (sample, alone):
        assert each.label is None
        assert np.array_equal(each.thermal, expected.thermal)
        assert np.array_equal(each.rgb, expected.rgb)
    assert (sample.name, alone.name) == ("sea_1", "1")


def test_bad_new_images_raise_or_are_skipped(tmp_path: Path) -> None:
    dataset = own.folder(own.write_folder(tmp_path / "known"))
    new = tmp_path / "new"
    for name in "123":
        own.write_frame(new, "sea", name)
    (new / "sea/ir/3_ir.tif").unlink()
    assert "1 RGB images have no thermal image: " in refused(
        lambda: of_path(dataset, str(new), "raise")
    )
    own.write_tiff(new / "sea" / "ir" / "2_ir.tif", COUNTS[:3])
    chosen = of_path(dataset, str(new), "skip")
    assert "'sea_2': RGB is 6x8 pixels but thermal is 3x8" in refused(
        lambda: list(chosen.samples("raise"))
    )
    assert [sample.name for sample in chosen.samples("skip")] == ["sea_1"]
    assert sorted(chosen.skipped) == [str(new / "sea/rgb/3.png"), "sea_2"]
    (new / "sea" / "rgb" / "1.png").write_bytes(b"")
    assert "none of the 2 images can be read" in refused(
        lambda: list(of_path(dataset, str(new), "skip").samples("skip"))
    )
    for taken in (new, new / "sea" / "rgb", new / "sea" / "ir"):
        assert "holds the input images" in refused(lambda taken=taken: chosen.check_out(taken))
    chosen.check_out(tmp_path / "out")
    own.write_frame(new, "sea", "2_overlay")
    twice = of_path(dataset, str(new), "skip")
    assert "are the same" in refused(lambda: twice.check_out(tmp_path / "out"))
    empty = write(tmp_path / "empty", "1.bmp", "2.bmp")
    assert "holds no pair of images but 1.bmp, 2.bmp; expected RGB {split}/rgb/" in refused(
        lambda: of_path(dataset, str(empty), "raise")
    )
    assert "neither a file, nor a folder, nor a split" in refused(
        lambda: of_path(dataset, "nowhere", "raise")
    )


def test_split_is_predicted_without_labels(write_mfnet: WriteMFNet) -> None:
    root = write_mfnet({"new": ["00001D"]})
    (root / "labels" / "00001D.png").unlink()
    (sample,) = of_split(MFNet(str(root), splits={"new": "new.txt"}), "new").samples("raise")
    assert sample.label is None
