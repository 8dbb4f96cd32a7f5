"""Thermal files as cameras write them: radiometric JPEGs, degrees of any unit, and their mixes."""

from __future__ import annotations

import importlib.util
import io
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from rgbt.data.check import check_dataset, range_line, thermal_table
from rgbt.data.folder import Folder
from rgbt.data.new_images import of_arrays
from rgbt.data.thermal import PLAUSIBLE, UNITS, maker_of, read_flir, unit_and_limits, unpack_flir
from tests.conftest import write_png
from tests.data.layouts import CLASSES, HW, refused, write_any

# Degrees Celsius of the pixels: from 10 to 33.5 in steps of 0.5.
CELSIUS = 10 + 0.5 * np.arange(48.0).reshape(HW)
AUTO = {"unit": "celsius", "range": "auto"}
# Planck constants of a camera (R1, B, F, OFFSET, R2), as FLIR's files hold them.
R1, B, F, OFFSET, R2 = 16556.0, 1428.0, 1.0, -342, 0.045


def raw_of(celsius: np.ndarray) -> np.ndarray:
    """The counts of FLIR's cameras without air: R1 / (R2 (exp(B / T) - F)) - OFFSET."""
    kelvin = celsius + 273.15
    return np.round(R1 / (R2 * (np.exp(B / kelvin) - F)) - OFFSET).astype("<u2")


def jpeg(size: tuple[int, int] = (16, 12), **options: Any) -> bytes:
    content = io.BytesIO()
    Image.new("RGB", size, (200, 40, 10)).save(content, "JPEG", **options)
    return content.getvalue()


def with_segment(picture: bytes, marker: int, content: bytes) -> bytes:
    """A JPEG with one more segment, behind those of its first 2 bytes."""
    head = struct.pack(">BBH", 0xFF, marker, len(content) + 2)
    return picture[:2] + head + content + picture[2:]


def flir(celsius: np.ndarray = CELSIUS, photo: bytes = b"", picture: bytes = b"") -> bytes:
    """A radiometric JPEG: records of counts, camera and photo behind the header of FFF."""
    height, width = celsius.shape
    camera = bytearray(900)
    # Emissivity 1, distance 0 m, three temperatures of 293.15 K, a window that passes all.
    struct.pack_into("<6f", camera, 32, 1.0, 0.0, 293.15, 293.15, 293.15, 1.0)
    struct.pack_into("<3f", camera, 88, R1, B, F)
    struct.pack_into("<if", camera, 776, OFFSET, R2)
    size = struct.pack("<3H", 2, width, height) + bytes(26)
    records = [(1, size + raw_of(celsius).tobytes()), (32, bytes(camera))]
    if photo:
        records.append((14, bytes(32) + photo))
    records += [(0, b""), (0, b"")]  # cameras leave entries of the directory empty
    offset, directory, content = 64 + 32 * len(records), b"", b""
    for kind, body in records:
        directory += struct.pack(">HHIIII12x", kind, 1, 100, 1, offset + len(content), len(body))
        content += body
    header = b"FFF\0" + bytes(16) + struct.pack(">III", 100, 64, len(records)) + bytes(32)
    segment = b"FLIR\0\x01\0\0" + header + directory + content
    return with_segment(picture or jpeg((8, 6)), 0xE1, segment)


def own(
    root: Path, files: dict[str, np.ndarray | bytes], thermal_range: Any, **keys: Any
) -> Folder:
    """A data set whose thermal files of the splits train, val and test are these arrays or bytes.

    `files` has the names of frames, "train_1", with the suffix of the thermal file.
    """
    for file, content in files.items():
        split, _, name = file.partition("_")
        path = root / split / "ir" / name
        if isinstance(content, bytes):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        else:
            write_any(path, content)
        stem = f"{path.stem}.png"
        write_png(root / split / "rgb" / stem, np.full((*HW, 3), 9, np.uint8))
        write_png(root / split / "mask" / stem, np.arange(48, dtype=np.uint8).reshape(HW) % 3)
    values: dict[str, Any] = {
        "rgb": "{split}/rgb/{name}.png",
        "thermal": "{split}/ir/{name}" + Path(next(iter(files))).suffix,
        "label": "{split}/mask/{name}.png",
        **{"num_classes": 3, "classes": CLASSES, "thermal_range": thermal_range},
    }
    return Folder(str(root), **{**values, **keys})


def split_files(image: Callable[[float], Any], suffix: str) -> dict[str, Any]:
    """Two frames of train, one of val and test; those of val and test are 5 degrees warmer."""
    warmer = {"train_1": 0.0, "train_2": 1.0, "val_1": 5.0, "test_1": 5.0}
    return {f"{name}{suffix}": image(more) for name, more in warmer.items()}


WRITTEN: dict[str, tuple[str, Callable[[float], Any], str]] = {
    "radiometric JPEG": ("celsius", lambda more: flir(CELSIUS + more), ".jpg"),
    "centikelvin PNG": (
        "centikelvin",
        lambda more: ((CELSIUS + more + 273.15) * 100).round().astype(np.uint16),
        ".png",
    ),
    "celsius TIFF": ("celsius", lambda more: (CELSIUS + more).astype(np.float32), ".tif"),
    "kelvin TIFF": ("kelvin", lambda more: (CELSIUS + more + 273.15).astype(np.float32), ".tif"),
}


@pytest.mark.parametrize("kind", WRITTEN)
def test_degrees_of_each_kind_of_file(kind: str, tmp_path: Path) -> None:
    """10 to 33.5 degrees between black at 10 and white at 35: 255 (t - 10) / 25, to one level."""
    unit, image, suffix = WRITTEN[kind]
    files = split_files(image, suffix)
    dataset = own(tmp_path, files, {"unit": unit, "range": (10.0, 35.0)})
    exact = 255 * (CELSIUS - 10) / 25
    assert np.abs(dataset.read("train_1").thermal - exact).max() <= 0.75
    # auto: of train alone, 10 to 34.5 degrees; half a percent of 402 points lie beyond each end.
    dataset = own(tmp_path, files, {"unit": unit, "range": "auto"})
    low, high = dataset.images.chosen_range
    assert 9.95 <= low <= 11
    assert 33.5 <= high <= 34.5
    assert dataset.read("train_1").thermal.max() >= 245
    assert dataset.read("val_1").thermal.max() == 255
    report = check_dataset(dataset)
    assert report.problems == ()
    assert f"{low:g} becomes black, {high:g} degrees Celsius white, found by auto" in range_line(
        dataset.images
    )
    rows = {row[0]: row for row in thermal_table(dataset, report).rows}
    assert [float(rows["val"][column]) for column in (1, 5)] == pytest.approx([15, 38.5], abs=0.05)


def test_counts_with_a_gain(tmp_path: Path) -> None:
    """0.04 K a count, as FLIR's linear mode writes: 7000 is 280 K or 6.85 degrees, black here."""
    counts = (7000 + 25 * np.arange(48)).astype(np.uint16).reshape(HW)  # to 8175, 53.85 degrees
    setting = {"unit": (0.04, -273.15), "range": (6.85, 53.85)}
    thermal = own(tmp_path, split_files(lambda _: counts, ".png"), setting).read("train_1").thermal
    assert np.abs(thermal - 255 * np.arange(48).reshape(HW) / 47).max() <= 0.5 + 1e-6
    plain = own(tmp_path, split_files(lambda _: counts, ".png"), "auto")
    assert plain.images.chosen_range == (7000, 8175)


def test_range_that_a_run_found_replaces_auto(tmp_path: Path) -> None:
    dataset = own(tmp_path, split_files(WRITTEN["celsius TIFF"][1], ".tif"), AUTO)
    assert dataset.settle_range((0.0, 51.0)) == (0, 51)
    # 255 / 51 = 5 grey levels a degree.
    assert np.abs(dataset.read("train_1").thermal - 5 * CELSIUS).max() <= 0.5
    array = of_arrays(dataset, np.zeros((*HW, 3), np.uint8), CELSIUS.astype(np.float32))
    np.testing.assert_array_equal(array.thermal, dataset.read("train_1").thermal)
    fixed = own(tmp_path, split_files(WRITTEN["celsius TIFF"][1], ".tif"), (0.0, 51.0))
    assert fixed.settle_range((7.0, 8.0)) is None
    assert fixed.images.limits == (0, 51)


def test_radiometric_files_are_recognised(tmp_path: Path, monkeypatch) -> None:
    exif = Image.Exif()
    exif[0x010F] = "DJI"
    contents = {
        "flir": (flir(), "FLIR"),
        "dji": (with_segment(jpeg(exif=exif), 0xE3, bytes(100)), "DJI"),
        "tagged": (with_segment(jpeg(), 0xE4, b"\xff\xd2\xd1\xffM3T"), "DJI"),
        "drone": (jpeg(exif=exif), None),  # a photo
        "phone": (with_segment(jpeg(), 0xE3, bytes(100)), None),
        "damaged": (flir()[:40], None),
    }
    for name, (content, maker) in contents.items():
        (tmp_path / f"{name}.jpg").write_bytes(content)
        assert maker_of(tmp_path / f"{name}.jpg") == maker, name
    files = split_files(lambda _: flir(), ".jpg")
    said = refused(lambda: own(tmp_path / "a", files, None).read("train_1"))
    assert "1.jpg is a radiometric JPEG of FLIR" in said
    assert "set dataset.thermal_range={unit: celsius, range: auto}" in said
    packed = {key: "{split}/ir/{name}.jpg" for key in ("rgb", "thermal")}
    assert "unpack_flir" in refused(
        lambda: own(tmp_path / "a", files, AUTO, **packed).read("train_1")
    )
    drone = own(tmp_path / "b", split_files(lambda _: contents["dji"][0], ".jpg"), (0.0, 9.0))
    assert "radiometric JPEG of DJI" in refused(lambda: drone.read("train_1"))
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n: None if n == "flyr" else find(n))
    said = refused(lambda: own(tmp_path / "a", files, AUTO).read("train_1"))
    assert "pip install 'rgbt[thermal]'" in said


def test_photo_and_temperature_of_flir(tmp_path: Path) -> None:
    """The photo has its own size; a file may lack it. One in another format is not opened."""
    source, out = tmp_path / "source", tmp_path / "out"
    source.mkdir()
    (source / "one.jpg").write_bytes(flir(photo=jpeg((20, 14))))
    (source / "two.jpg").write_bytes(flir())
    (source / "other.jpg").write_bytes(jpeg())
    assert unpack_flir(source, out) == (2, 1)
    assert sorted(path.relative_to(out).as_posix() for path in out.rglob("*.*")) == [
        "rgb/one.png",
        "thermal/one.tif",
        "thermal/two.tif",
    ]
    celsius = np.asarray(Image.open(out / "thermal/one.tif"))
    assert celsius.dtype == np.float32
    assert np.abs(celsius - CELSIUS).max() < 0.05
    assert np.asarray(Image.open(out / "rgb/one.png")).shape == (14, 20, 3)
    assert "no" in refused(lambda: unpack_flir(source, out))
    harmful = tmp_path / "harmful.jpg"
    bitmap = io.BytesIO()
    Image.new("RGB", (20, 14)).save(bitmap, "BMP")  # as any other: EPS would start a program
    harmful.write_bytes(flir(photo=bitmap.getvalue()))
    assert f"{harmful}: its measurement cannot be read" in refused(lambda: read_flir(harmful))
    exif = Image.Exif()
    exif[0x0112] = 6
    harmful.write_bytes(flir(picture=jpeg((8, 6), exif=exif)))
    assert "EXIF orientation 6" in refused(lambda: read_flir(harmful))


def test_mixed_files_are_named(tmp_path: Path) -> None:
    """Of two types, of two units, and 8 bits beside degrees: when read, by check, and by auto."""
    celsius, kelvin = CELSIUS.astype(np.float32), (CELSIUS + 273.15).astype(np.float32)
    files = split_files(lambda _: celsius, ".tif")
    two = {**files, "train_2.tif": kelvin}
    degrees = own(tmp_path / "a", two, AUTO)
    (found,) = check_dataset(degrees).problems
    path = tmp_path / "a" / "train" / "ir" / "2.tif"
    assert found.startswith(f"train_2: {path}: expected celsius, but its values look like kelvin")
    assert degrees.images.chosen_range[1] < 35  # without the kelvins
    stored = own(tmp_path / "a", two, "auto")
    text = "thermal values look like kelvin, of most images celsius; store values in one unit."
    said = refused(lambda: stored.read("val_1"))
    assert said == f"dataset.thermal_range=auto: 1 of 2 training images, first 'train_2': {text}"
    fixed = own(tmp_path / "a", two, (0.0, 400.0))
    assert check_dataset(fixed).problems == (f"train_2: {text}",)
    free = own(tmp_path / "a", two, {"unit": (1.0, 0.0), "range": (0.0, 400.0)})
    assert check_dataset(free).problems == ()  # an own unit is not judged
    counts = (CELSIUS * 100).astype(np.uint16)
    types = own(tmp_path / "b", {**files, "val_1.tif": counts}, (0.0, 40.0))
    text = "val_1: thermal is uint16, of most images float; store values of one type."
    assert text in check_dataset(types).problems
    grey = own(tmp_path / "c", {**files, "val_1.tif": CELSIUS.astype(np.uint8)}, AUTO)
    (found,) = check_dataset(grey).problems
    assert found.startswith(f"val_1: {tmp_path}/c/val/ir/1.tif: expected celsius")
    assert "grey levels of 8 bits" in found
    levels = split_files(lambda _: CELSIUS.astype(np.uint8), ".tif")
    sixteen = own(tmp_path / "d", {**levels, "val_1.tif": counts}, None)
    (found,) = check_dataset(sixteen).problems
    assert f"{tmp_path}/d/val/ir/1.tif: expected thermal values of 8 bits" in found


def test_median_decides_the_unit() -> None:
    """No temperature of a scene is plausible in two units, whichever is declared."""
    low, high = PLAUSIBLE
    for name, unit in UNITS.items():
        stored = unit.stored((low + 1, high - 1))
        assert [unit.degrees(value) for value in stored] == pytest.approx([low + 1, high - 1])
        others = [other for key, other in UNITS.items() if key != name]
        middle = unit.stored((20.0, 20.0))[0]
        assert not any(low < other.degrees(middle) < high for other in others)


def test_histogram_by_day_and_night(tmp_path: Path) -> None:
    """Values of the day fill the upper half, those of the night the lower one."""
    files = {
        f"{split}_{name}.tif": (
            CELSIUS * 0 + 10 + np.arange(48).reshape(HW) / 48 * 10 + more
        ).astype(np.float32)
        for split in ("train", "val", "test")
        for name, more in (("1D", 10), ("2N", 0))
    }
    dataset = own(tmp_path, files, {**AUTO, "range": (0.0, 40.0)}, night="*N")
    table = thermal_table(dataset, check_dataset(dataset))
    assert [row[0] for row in table.rows[:3]] == ["train", "train day", "train night"]
    whole, day, night = (row[-1] for row in table.rows[:3])
    assert table.header[0] == "thermal, Celsius"
    assert not day[:11].strip()
    assert not night[13:].strip()
    assert " " not in day[13:] + night[:11] + whole[:11] + whole[13:]


@pytest.mark.parametrize(
    "setting",
    [{"unit": "celsius"}, {"range": "auto"}, {"unit": "fahrenheit", "range": "auto"}]
    + [{"unit": (0.0, 1.0), "range": "auto"}, {"unit": "celsius", "range": "kelvin"}],
)
def test_wrong_units_are_refused(setting: Any) -> None:
    assert "dataset.thermal_range: expected {unit: U, range: R}" in refused(
        lambda: unit_and_limits(setting)
    )


def test_range_has_to_rise() -> None:
    assert "expected [low, high] or auto, got wide" in refused(lambda: unit_and_limits("wide"))
    said = refused(lambda: unit_and_limits({"unit": "celsius", "range": (5.0, 5.0)}))
    assert "expected [low, high], got [5.0, 5.0]" in said
    assert math.isclose(UNITS["centikelvin"].degrees(29315), 20)
