"""New images of any folder, and predicted label images of any method."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image

from rgbt.data.freiburg import LAYOUTS as FREIBURG
from rgbt.data.images import PairReader
from rgbt.data.kp import KP
from rgbt.data.mfnet import MFNet
from rgbt.data.new_images import of_arrays, of_files, of_path, of_split
from rgbt.data.patterns import Patterns
from rgbt.data.predictions import PredictionReader
from rgbt.data.pst900 import PST900
from rgbt.types import Sample
from tests.conftest import write_png
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


def test_arrays_of_camera_values_are_read_like_files(tmp_path: Path) -> None:
    rgb, thermal = tmp_path / "1.png", tmp_path / "1_ir.png"
    write_png(rgb, RGB)
    cv2.imwrite(str(thermal), COUNTS)
    dataset = Reading(*FREIBURG, crop=(1, 5, 2, 8), thermal_range=(21800, 23700))
    expected = dataset.images.read("1", rgb, thermal)
    sample = of_arrays(dataset, RGB, COUNTS)
    assert np.array_equal(sample.rgb, expected.rgb)
    assert np.array_equal(sample.thermal, expected.thermal)
    seen = of_arrays(dataset, sample.rgb, sample.thermal)
    assert np.array_equal(seen.thermal, expected.thermal), "grey levels are neither cut nor scaled"


def test_both_images_of_a_pair_are_turned_by_their_own_orientation(tmp_path: Path) -> None:
    """RGB was stored upside down (3), thermal on its side (8: a quarter to the left)."""
    rgb, thermal = tmp_path / "rgb" / "1.png", tmp_path / "thermal" / "1.png"
    stored = {rgb: (RGB[::-1, ::-1], 3), thermal: (np.rot90(GREY, -1), 8)}
    for path, (image, orientation) in stored.items():
        path.parent.mkdir()
        exif = Image.Exif()
        exif[0x0112] = orientation
        Image.fromarray(np.ascontiguousarray(image)).save(path, exif=exif)
    found = of_path(Reading(), str(tmp_path), "raise")
    (sample,) = found.samples("raise")
    assert np.array_equal(sample.rgb, RGB)
    assert np.array_equal(sample.thermal, GREY)


def test_arrays_of_unclear_or_wrong_values_are_refused() -> None:
    low = Reading(*FREIBURG, thermal_range=(0, 200))
    said = refused(lambda: of_arrays(low, RGB, GREY))
    assert "8 bits may be grey levels or values of dataset.thermal_range=[0, 200]" in said
    assert "expected rgb uint8 of shape" in refused(lambda: of_arrays(low, RGB, COUNTS[:3]))
    said = refused(lambda: of_arrays(SimpleNamespace(splits=("test",)), RGB, COUNTS))
    assert "does not declare how to read new images" in said


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
    for found in (sample, alone):
        assert found.label is None
        assert np.array_equal(found.thermal, expected.thermal)
        assert np.array_equal(found.rgb, expected.rgb)
    assert (sample.name, alone.name) == ("sea_1", "1")


def test_bad_new_images_raise_or_are_skipped(tmp_path: Path) -> None:
    dataset, new = folder(write_folder(tmp_path / "known")), tmp_path / "new"
    for name in "123":
        write_frame(new, "sea", name)
    (new / "sea/ir/3_ir.tif").unlink()
    said = refused(lambda: of_path(dataset, str(new), "raise"))
    assert "1 RGB images have no thermal image: " in said
    write_any(new / "sea" / "ir" / "2_ir.tif", COUNTS[:3])
    chosen = of_path(dataset, str(new), "skip")
    assert "'sea_2': RGB is 6x8 pixels but" in refused(lambda: list(chosen.samples("raise")))
    assert [sample.name for sample in chosen.samples("skip")] == ["sea_1"]
    assert sorted(chosen.skipped) == [str(new / "sea/rgb/3.png"), "sea_2"]
    (new / "sea" / "rgb" / "1.png").write_bytes(b"")
    said = refused(lambda: list(of_path(dataset, str(new), "skip").samples("skip")))
    assert "none of the 2 images can be read" in said
    for taken in (new, new / "sea" / "rgb", new / "sea" / "ir"):
        assert "holds the input images" in refused(lambda taken=taken: chosen.check_out(taken))
    write_png(tmp_path / "empty" / "1.bmp", RGB)
    said = refused(lambda: of_path(dataset, str(tmp_path / "empty"), "raise"))
    assert "holds no pair of images but 1.bmp; expected RGB {split}/rgb/" in said
    assert "neither a file, nor a folder" in refused(lambda: of_path(dataset, "nowhere", "raise"))


def test_split_is_predicted_without_labels(tmp_path: Path) -> None:
    root = write_folder(tmp_path)
    (root / "test" / "mask" / "1.png").unlink()
    assert [sample.label for sample in of_split(folder(root), "test").samples("raise")] == [
        None
    ] * 2


# Predictions.

CLASSES = ("ground", "car", "person")
PALETTE = ((0, 0, 0), (64, 0, 128), (64, 64, 0))
INDICES = np.array([[0, 1, 2], [2, 1, 0]], np.uint8)
COLOURS = np.array(PALETTE, np.uint8)[INDICES]


def read(path: Path, form: str = "index", **options: Any) -> np.ndarray:
    return PredictionReader(CLASSES, PALETTE, form, **options).read(path)  # type: ignore[arg-type]


def save(path: Path, values: object, palette: object = None) -> Path:
    image = Image.fromarray(np.asarray(values))
    if palette is not None:
        image = Image.frombytes("P", image.size, image.tobytes())
        image.putpalette(np.array(palette, np.uint8).ravel().tolist())
    image.save(path)
    return path


def test_files_of_each_kind_give_equal_classes(tmp_path: Path) -> None:
    opaque = np.dstack([COLOURS, np.full(INDICES.shape, 255, np.uint8)])
    for form, values, palette in [
        *(("index", INDICES, None), ("index", INDICES, PALETTE), ("colour", INDICES, PALETTE)),
        *(("colour", COLOURS, None), ("colour", opaque, None)),
    ]:
        path = save(tmp_path / "x.png", values, palette)
        np.testing.assert_array_equal(read(path, form), INDICES)


def test_palette_of_other_classes_is_refused_as_indices(tmp_path: Path) -> None:
    """The stored numbers are 0, 2, 1 where the colours say 0, 1, 2."""
    shuffled = save(tmp_path / "p.png", INDICES, [PALETTE[0], PALETTE[2], PALETTE[1]])
    assert "index 1 (car) is shown in the colour of person" in refused(lambda: read(shuffled))
    np.testing.assert_array_equal(read(shuffled, "colour"), [[0, 2, 1], [1, 2, 0]])
    # Colours of a palette of the method's own: the user names it, and its indices are read.
    own = tmp_path / "own.yaml"
    own.write_text(yaml.safe_dump({"palette": [[0, 0, 0], [64, 64, 0], [64, 0, 128]]}))
    for form in ("index", "colour"):
        np.testing.assert_array_equal(read(shuffled, form, palette=str(own)), INDICES)
    strange = save(tmp_path / "s.png", INDICES, [(9, 9, 9), (8, 8, 8), (7, 7, 7)])
    np.testing.assert_array_equal(read(strange), INDICES)


@pytest.mark.parametrize(
    ("form", "values", "said"),
    [
        ("index", np.array([[0, 3]], np.uint8), "label value 3 (1 pixels"),
        ("index", np.array([[0, 255]], np.uint8), "label value 255 (1 pixels"),
        ("index", COLOURS, "got PNG of mode RGB"),
        ("index", np.array([[0, 1]], np.uint16), "one channel of 8 bits, got mode I;16"),
        ("index", np.array([[True, False]]), "got PNG of mode 1"),
        ("colour", INDICES, "got PNG of mode L"),
        ("colour", [[[0, 0, 0], [64, 0, 127]]], "colour [64, 0, 127] (1 pixels"),
        ("colour", np.zeros((1, 2, 4), np.uint8), "transparent"),
        ("colour", [[[0, 0, 0, 255], [0, 0, 0, 254]]], "transparent"),
    ],
)
def test_other_files_than_stated_are_refused(
    tmp_path: Path, form: str, values: Any, said: str
) -> None:
    kept = values if isinstance(values, np.ndarray) else np.array(values, np.uint8)
    told = refused(lambda: read(save(tmp_path / "bad.png", kept), form))
    assert "bad.png: " in told
    assert said in told
    Image.fromarray(INDICES).save(tmp_path / "jpeg.png", format="JPEG")
    assert "got JPEG" in refused(lambda: read(tmp_path / "jpeg.png", form))


@pytest.mark.parametrize(
    ("palette", "said"),
    [
        *(
            ([[0, 0, 256]], "the key palette"),
            ("red", "the key palette"),
            (None, "the key palette"),
        ),
        ([[0, 0, 0], [1, 1, 1], [1, 1, 1]], "two classes have one colour"),
        ([[0, 0, 0]], "colour [64, 0, 128] (2 pixels; one of 2 unknown values)"),
    ],
)
def test_invalid_palettes_are_refused(tmp_path: Path, palette: object, said: str) -> None:
    path, file = save(tmp_path / "x.png", COLOURS), tmp_path / "own.yaml"
    file.write_text(yaml.safe_dump({"palette": palette}))
    assert said in refused(lambda: read(path, "colour", palette=str(file)))


def test_names_of_files(tmp_path: Path) -> None:
    reader = PredictionReader(CLASSES, PALETTE, prefix="Pred_", suffix="_x")
    assert reader.path(tmp_path, "a") == tmp_path / "Pred_a_x.png"
    assert reader.path(tmp_path, "b/c") == tmp_path / "Pred_b/c_x.png"
    assert "format: 'colours' is not a valid choice" in refused(lambda: read(tmp_path, "colours"))
