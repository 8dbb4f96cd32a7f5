"""New images of any folder: which files are pairs, by every data set's own patterns."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from rgbt.data.freiburg import LAYOUTS as FREIBURG
from rgbt.data.images import PairReader
from rgbt.data.kp import KP
from rgbt.data.mfnet import MFNet
from rgbt.data.new_images import of_arrays, of_files, of_path, of_split
from rgbt.data.patterns import Patterns
from rgbt.data.pst900 import PST900
from rgbt.types import Sample
from tests.conftest import WriteMFNet, write_png
from tests.data.layouts import folder, refused, write_any, write_folder, write_frame

HW = (6, 8)
RGB = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(*HW, 3)
GREY = np.arange(48, dtype=np.uint8).reshape(HW)
COUNTS = (21800 + 100 * np.arange(48)).astype(np.uint16).reshape(HW)


class Reading:
    """A data set that only says how its images are read."""

    def __init__(self, *layouts: Patterns, **keys: object) -> None:
        self.images = PairReader(layouts=layouts, **keys)

    def pair(self, name: str) -> Sample:
        raise NotImplementedError


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_arrays_of_camera_values_are_read_like_files(tmp_path: Path, dtype: type) -> None:
    rgb, thermal = tmp_path / "1.png", tmp_path / "1_ir.png"
    write_png(rgb, RGB)
    cv2.imwrite(str(thermal), COUNTS)
    dataset = Reading(*FREIBURG, crop=(1, 5, 2, 8), thermal_range=(21800, 23700))
    expected = dataset.images.read("1", rgb, thermal)
    sample = of_arrays(dataset, RGB, COUNTS.astype(dtype))
    assert np.array_equal(sample.rgb, expected.rgb)
    assert np.array_equal(sample.thermal, expected.thermal)
    seen = of_arrays(dataset, sample.rgb, sample.thermal)
    assert np.array_equal(seen.thermal, expected.thermal), "grey levels are neither cut nor scaled"


def test_arrays_of_unclear_or_wrong_values_are_refused() -> None:
    low = Reading(*FREIBURG, thermal_range=(0, 200))
    said = refused(lambda: of_arrays(low, RGB, GREY))
    assert "8 bits may be grey levels or values of dataset.thermal_range=[0, 200]" in said
    assert "expected rgb uint8 of shape" in refused(lambda: of_arrays(low, RGB, COUNTS[:3]))
    said = refused(lambda: of_arrays(SimpleNamespace(splits=("test",)), RGB, COUNTS))
    assert "does not declare how to read new images" in said


def test_an_unlabelled_split_needs_nothing_else(tmp_path: Path) -> None:
    write_frame(tmp_path, "sea", "1")
    (tmp_path / "sea" / "mask" / "1.png").unlink()
    changes = {"folders": {"new": "sea"}, "unlabelled": ("new",), "night": "*night*"}
    assert folder(tmp_path, **changes).read("sea_1").label is None


MINE = (Patterns.of("{sequence}/rgb/{name}.jpg", "{sequence}/ir/{name}_ir.tif"),)
DAY = ("test/day/ImagesRGB/1_20_rgb.png", "test/day/ImagesIR/1_2_ir.png")
NIGHT = ("test/night/ImagesRGB/3_40_rgb.png", "test/night/ImagesIR/3_40_ir.png")
KAIST = tuple(f"images/set00/V000/{kind}/I1.jpg" for kind in ("visible", "lwir"))


@pytest.mark.parametrize(
    ("layouts", "expected"),
    [
        (MINE, {"day_1": ("day/rgb/1.jpg", "day/ir/1_ir.tif")}),
        (MINE, {"1": ("rgb/1.png", "thermal/1.png"), "10": ("rgb/10.png", "thermal/10.png")}),
        (MINE, {"1": ("rgb/1.tif", "thermal/1.tif")}),
        (MINE, {"1_packed": ("1_packed.png", "1_packed.png")}),
        (MFNet.images.layouts, {"packed": ("images/packed.png", "images/packed.png")}),
        (MFNet.images.layouts, {"1": ("RGB/1.png", "Thermal/1.png")}),
        (KP.images.layouts, {"set00_V000_I1": KAIST}),
        (PST900.images.layouts, {"new_a": ("new/rgb/a.png", "new/thermal/a.png")}),
        (FREIBURG, {"test_night_3_40": NIGHT}),
        (FREIBURG[2:], {"test_day_1_2": DAY}),
    ],
)
def test_folder_is_read_by_patterns_of_data_set(
    tmp_path: Path,
    layouts: tuple[Patterns, ...],
    expected: dict[str, tuple[str, str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in (name for pair in expected.values() for name in pair):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    read: dict[str, tuple[str, ...]] = {}

    def noted(self: PairReader, name: str, *paths: Path) -> Sample:
        read[name] = tuple(str(path.relative_to(tmp_path)) for path in paths)
        return Sample(RGB, GREY, None, name)

    monkeypatch.setattr(PairReader, "read", noted)
    chosen = of_path(Reading(*layouts), str(tmp_path), "raise")
    assert [sample.name for sample in chosen.samples("raise")] == sorted(expected, key=len)
    assert read == expected


def test_new_images_are_read_like_training_images(tmp_path: Path) -> None:
    dataset = folder(write_folder(tmp_path / "known"))
    new = tmp_path / "new"
    write_frame(new, "sea", "1")
    (sample,) = of_path(dataset, str(new), "raise").samples("raise")
    write_frame(tmp_path / "known", "sea", "1")
    expected = folder(tmp_path / "known").read("sea_1")
    files = (new / "sea/rgb/1.png", new / "sea/ir/1_ir.tif")
    (alone,) = of_files(dataset, *files).samples("raise")
    for each in (sample, alone):
        assert each.label is None
        assert np.array_equal(each.thermal, expected.thermal)
        assert np.array_equal(each.rgb, expected.rgb)
    assert (sample.name, alone.name) == ("sea_1", "1")


def test_bad_new_images_raise_or_are_skipped(tmp_path: Path) -> None:
    dataset = folder(write_folder(tmp_path / "known"))
    new = tmp_path / "new"
    for name in "123":
        write_frame(new, "sea", name)
    (new / "sea/ir/3_ir.tif").unlink()
    said = refused(lambda: of_path(dataset, str(new), "raise"))
    assert "1 RGB images have no thermal image: " in said
    write_any(new / "sea" / "ir" / "2_ir.tif", COUNTS[:3])
    chosen = of_path(dataset, str(new), "skip")
    said = refused(lambda: list(chosen.samples("raise")))
    assert "'sea_2': RGB is 6x8 pixels but thermal is 3x8" in said
    assert [sample.name for sample in chosen.samples("skip")] == ["sea_1"]
    assert sorted(chosen.skipped) == [str(new / "sea/rgb/3.png"), "sea_2"]
    (new / "sea" / "rgb" / "1.png").write_bytes(b"")
    said = refused(lambda: list(of_path(dataset, str(new), "skip").samples("skip")))
    assert "none of the 2 images can be read" in said
    for taken in (new, new / "sea" / "rgb", new / "sea" / "ir"):
        assert "holds the input images" in refused(lambda taken=taken: chosen.check_out(taken))
    chosen.check_out(tmp_path / "out")
    write_png(tmp_path / "empty" / "1.bmp", RGB)
    said = refused(lambda: of_path(dataset, str(tmp_path / "empty"), "raise"))
    assert "holds no pair of images but 1.bmp; expected RGB {split}/rgb/" in said
    said = refused(lambda: of_path(dataset, "nowhere", "raise"))
    assert "neither a file, nor a folder, nor a split" in said


def test_split_is_predicted_without_labels(write_mfnet: WriteMFNet) -> None:
    root = write_mfnet({"new": ["00001D"]})
    (root / "labels" / "00001D.png").unlink()
    (sample,) = of_split(MFNet(str(root), splits={"new": "new.txt"}), "new").samples("raise")
    assert sample.label is None
