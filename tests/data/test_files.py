"""Reading of single files, and what is refused of them."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from rgbt.data.files import (
    decode,
    open_indices,
    read_array,
    read_colours,
    read_names,
    read_packed,
    read_rgb,
    stored_hw,
    values_of,
    within,
)
from rgbt.data.labels import indices
from tests.data import layouts


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_bytes(
    width: int, height: int, *, depth: int, colours: int, rows: bytes = b"", palette: bytes = b""
) -> bytes:
    """A PNG as its specification has it; `rows` begin with their filter byte each."""
    header = struct.pack(">IIBBBBB", width, height, depth, colours, 0, 0, 0)
    table = chunk(b"PLTE", palette) if palette else b""
    data = chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + table + data


def jpeg_bytes(hw: tuple[int, int] = (32, 40)) -> bytes:
    image = np.random.default_rng(0).integers(0, 256, (*hw, 3), dtype=np.uint8)
    return cv2.imencode(".jpg", image)[1].tobytes()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "x.png"


def test_within(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root, outside = tmp_path / "data", tmp_path / "data2"
    for folder in (root / "images", outside):
        folder.mkdir(parents=True)
        (folder / "1.png").write_bytes(b"")
    inner, images = root / "images" / "1.png", root / "images"
    for name, target in {"2": inner, "3": outside / "1.png", "4": outside / "gone.png"}.items():
        (images / f"{name}.png").symlink_to(target)
    (root / "other").symlink_to(outside)
    (tmp_path / "link").symlink_to(root)  # the root itself may be a link
    monkeypatch.chdir(tmp_path)
    for path, home in (
        *((inner, root), (inner, images / ".."), (inner, Path("/")), (images / "2.png", root)),
        (tmp_path / "link" / "images" / "1.png", tmp_path / "link"),
        (Path("data/images/1.png"), Path("data")),
        # Nothing is there: the missing file is reported where it is opened.
        *((root / ".." / "nothing.png", root), (images / "4.png", root)),
    ):
        assert within(path, home) == path
    # A folder beside the root that begins with its name is not inside it.
    for name in ("../data2/1.png", "images/../../data2/1.png", "images/3.png", "other/1.png"):
        said = refused(root / name, lambda path: within(path, root))
        assert f"leads out of dataset.root, to {outside}/1.png. Set dataset.root" in said


def refused(path: Path, read: Callable[[Path], object] = decode) -> str:
    sentence = layouts.refused(lambda: read(path))
    assert sentence.startswith(str(path))
    return sentence


def read_indices(path: Path) -> np.ndarray:
    return values_of(open_indices(path))


def test_png_is_read_whole_or_refused(path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (200, 300), dtype=np.uint8)
    whole = cv2.imencode(".png", image)[1].tobytes()
    for size in (len(whole) // 2, len(whole) - 12, len(whole) - 1):
        path.write_bytes(whole[:size])
        assert "cannot be decoded" in refused(path)
    # A wrong checksum of the pixels, which decoders pass over.
    path.write_bytes(whole[:-13] + bytes([whole[-13] ^ 1]) + whole[-12:])
    assert "cannot be decoded" in refused(path)
    path.write_bytes(whole + b"\0" * 5000)  # as a card reader leaves it
    np.testing.assert_array_equal(decode(path), image)


@pytest.mark.parametrize("thumbnail", [False, True], ids=["plain", "with a thumbnail"])
def test_jpeg_is_read_whole_or_refused(path: Path, thumbnail: bool) -> None:
    whole = jpeg_bytes()
    if thumbnail:  # an application segment that holds a whole JPEG, with an end of its own
        small = jpeg_bytes((8, 8))
        whole = whole[:2] + b"\xff\xe1" + struct.pack(">H", len(small) + 2) + small + whole[2:]
    for size in (3, 30, len(whole) - 500, len(whole) - 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        assert "cannot be decoded" in refused(path)
    path.write_bytes(whole[:-2] + b"\0" * 99)
    assert thumbnail or "its end is missing" in refused(path)
    path.write_bytes(whole + b"\0\0 and what a camera appends")
    np.testing.assert_array_equal(decode(path), cv2.imread(str(path))[..., ::-1])


@pytest.mark.parametrize("name", ["8.png", "16.png", "8.bmp", "8.tif", "16.tif", "32.tif"])
def test_values_are_those_of_the_file(tmp_path: Path, name: str) -> None:
    dtype = {"8": np.uint8, "16": np.uint16, "32": np.float32}[name.split(".")[0]]
    image = np.random.default_rng(0).integers(0, 256, (40, 50)).astype(dtype)
    assert cv2.imwrite(str(tmp_path / name), image)
    found = decode(tmp_path / name)
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, image)
    whole = (tmp_path / name).read_bytes()
    for size in (len(whole) // 2, len(whole) - 5):
        (tmp_path / name).write_bytes(whole[:size])
        assert "cannot be decoded" in refused(tmp_path / name)


def test_what_is_no_image(path: Path) -> None:
    bomb = png_bytes(2**30, 2**30, depth=8, colours=0)
    for content in (bomb, b"\x89PNG\r\n\x1a\n" + chunk(b"IEND", b"")):
        path.write_bytes(content)
        assert "cannot be decoded" in refused(path)
    path.unlink()
    path.symlink_to(path)
    assert "cannot be read (Too many levels of symbolic links)" in refused(path)


def test_indices_of_a_palette(path: Path) -> None:
    """Tools that draw masks write colours beside indices."""
    red_green_blue = bytes([9, 9, 9, 255, 0, 0, 0, 255, 0])
    rows = bytes([0, 2, 0, 1])
    path.write_bytes(png_bytes(3, 1, depth=8, colours=3, rows=rows, palette=red_green_blue))
    assert read_indices(path).tolist() == [[2, 0, 1]]
    assert indices(3).read(path).tolist() == [[2, 0, 1]]
    assert "label value 2" in refused(path, indices(2).read)
    colours = [[[0, 255, 0], [9, 9, 9], [255, 0, 0]]]
    assert read_colours(path).tolist() == colours
    assert decode(path).tolist() == colours
    # One bit each: 1, 0, 1.
    packed = png_bytes(3, 1, depth=1, colours=3, rows=bytes([0, 0b10100000]), palette=b"\0" * 6)
    path.write_bytes(packed)
    assert read_indices(path).tolist() == [[1, 0, 1]]


def test_labels_whose_values_would_change(path: Path) -> None:
    for depth, row in ((1, 0b10100000), (2, 0b01000000), (4, 0b00010000)):
        width = 8 // depth
        path.write_bytes(png_bytes(width, 1, depth=depth, colours=0, rows=bytes([0, row])))
        assert "expected one channel of class indices of 8 bits" in refused(path, read_indices)
    path.write_bytes(jpeg_bytes())
    for read in (read_indices, read_colours):
        assert "got JPEG of mode RGB" in refused(path, read)
    # Sixteen bits per colour would lose their last eight.
    rows = bytes([0, *range(1, 7)])
    path.write_bytes(png_bytes(1, 1, depth=16, colours=2, rows=rows))
    assert "16 bits per channel" in refused(path)


def test_number_of_channels(path: Path) -> None:
    image = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)  # blue, green, red, thermal
    cv2.imwrite(str(path), image)
    rgb, thermal = read_packed(path, "x")
    np.testing.assert_array_equal(rgb, image[..., 2::-1])
    np.testing.assert_array_equal(thermal, image[..., 3])
    assert "expected 3 channels (red, green, blue), got 4" in refused(path, read_rgb)
    cv2.imwrite(str(path), image[..., :3])
    np.testing.assert_array_equal(read_rgb(path), image[..., 2::-1])
    assert "got 3; use the original file, or x" in refused(path, lambda p: read_packed(p, "x"))
    cv2.imwrite(str(path), image[..., 0].astype(np.uint16))
    assert "expected 8 bits per channel, got uint16" in refused(path, read_rgb)


def test_arrays(tmp_path: Path) -> None:
    path = tmp_path / "x.npy"
    np.save(path, np.ones((2, 3)))
    assert read_array(path, "counts").shape == (2, 3)
    whole = path.read_bytes()
    no_header = whole.replace(b"{", b"(").replace(b"}", b"(")
    # The last asks for more memory than there is.
    huge = whole.replace(b"(2, 3)", b"(9999999999999, 3)").replace(b" " * 11, b"", 1)
    for damaged in (b"", whole[:-1], whole + b"\0", whole[:20], b"no array", no_header, huge):
        path.write_bytes(damaged)
        said = refused(path, lambda p: read_array(p, "counts"))
        assert "cannot be read as an array of counts" in said
    with path.open("wb") as file:
        np.savez(file, one=np.ones(2))
    assert "several arrays" in refused(path, lambda p: read_array(p, "counts"))


def test_lists(tmp_path: Path) -> None:
    path = tmp_path / "train.txt"
    path.write_bytes(b"\xef\xbb\xbf 00001D\r\n\r\n00002N")
    assert read_names(path, "dataset.splits.train") == ("00001D", "00002N")
    for wrong in ("00001D\n".encode("utf-16"), b"\x89PNG\r\n\x1a\n\0\0", b"a\0b\n", b" \n\n"):
        path.write_bytes(wrong)
        said = layouts.refused(lambda: read_names(path, "dataset.splits.train"))
        assert said.startswith(f"dataset.splits.train: '{path}': expected a text in UTF-8")
    path.unlink()
    said = layouts.refused(lambda: read_names(path, "dataset.splits.train"))
    assert said.startswith(f"dataset.splits.train: {path} is missing")


# What a viewer shows of the stored rows "abc" and "def", by EXIF orientation (EXIF 2.3, 4.6.4).
SHOWN = {
    1: ("abc", "def"),
    2: ("cba", "fed"),
    3: ("fed", "cba"),
    4: ("def", "abc"),
    5: ("ad", "be", "cf"),
    6: ("da", "eb", "fc"),
    7: ("fc", "eb", "da"),
    8: ("cf", "be", "ad"),
}


@pytest.mark.parametrize("orientation", SHOWN)
@pytest.mark.parametrize(
    ("kind", "depth", "options"),
    [
        *(("png", depth, {}) for depth in ("u1", "u2", "3u1")),
        *(("jpg", depth, {"quality": 100, "subsampling": 0}) for depth in ("u1", "3u1")),
        *(
            ("tif", depth, {"compression": method})
            for depth in ("u1", "u2", "f4", "3u1")
            for method in (None, "tiff_lzw")
        ),
    ],
)
def test_images_are_read_upright(
    tmp_path: Path, kind: str, depth: str, options: dict[str, Any], orientation: int
) -> None:
    """Of every format and depth, grey or of three channels; the header has the size of it."""
    level = {letter: 40 * n for n, letter in enumerate("abcdef")}
    side = 16 if kind == "jpg" else 1  # a block of JPEG keeps its grey level

    def image_of(rows: Sequence[str]) -> np.ndarray:
        plane = np.array([[level[letter] for letter in row] for row in rows]).astype(depth[-2:])
        plane = plane.repeat(side, 0).repeat(side, 1)
        return np.dstack([plane] * 3) if depth == "3u1" else plane

    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / f"x.{kind}"
    Image.fromarray(image_of(("abc", "def"))).save(path, exif=exif, **options)
    expected, found = image_of(SHOWN[orientation]), decode(path)
    assert found.dtype == np.dtype(depth[-2:])
    np.testing.assert_allclose(found, expected, atol=1 if kind == "jpg" else 0)
    assert stored_hw(path) == expected.shape[:2]
    if kind == "png" and depth != "3u1":
        np.testing.assert_array_equal(values_of(open_indices(path)), expected)


def test_orientation_behind_the_pixels_of_a_png(path: Path) -> None:
    """A quarter to the right (6), in the chunk before the last one."""
    tags = b"MM\0*\0\0\0\x08" + struct.pack(">HHHIHHI", 1, 0x0112, 3, 1, 6, 0, 0)
    rows = b"\0\1\2\3\0\4\5\6"
    whole = png_bytes(3, 2, depth=8, colours=0, rows=rows)
    path.write_bytes(whole[:-12] + chunk(b"eXIf", tags) + whole[-12:])
    assert decode(path).tolist() == [[4, 1], [5, 2], [6, 3]]
    assert stored_hw(path) == (3, 2)


def test_headers_without_a_size_are_refused(tmp_path: Path) -> None:
    fifo, text = tmp_path / "fifo.png", tmp_path / "text.png"
    os.mkfifo(fifo)
    text.write_text("no image")
    for path, said in (
        (tmp_path / "gone.png", "is missing"),
        (fifo, "no regular file"),
        (text, "cannot be decoded"),
    ):
        assert said in refused(path, stored_hw)
