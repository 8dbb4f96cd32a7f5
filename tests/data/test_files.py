"""Reading of single files, and what is refused of them before anything decodes it."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.files import (
    decode,
    read_array,
    read_colours,
    read_indices,
)
from rgbt.data.integrity import is_there, read_names, read_whole, within
from rgbt.data.labels import read_label

SKIP = "skip unreadable files with data.on_error=skip"


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


def refused(path: Path) -> str:
    with pytest.raises(InputError) as told:
        decode(path)
    sentence = str(told.value)
    assert sentence.startswith(str(path))
    assert "\n" not in sentence
    return sentence


def test_a_png_that_is_cut_short(path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (200, 300), dtype=np.uint8)
    whole = cv2.imencode(".png", image)[1].tobytes()
    for size in (len(whole) // 2, len(whole) - 12, len(whole) - 1):
        path.write_bytes(whole[:size])
        assert refused(path) == (
            f"{path} cannot be decoded, because the file is truncated (its end is missing after "
            f"{size} bytes, as after an interrupted copy); replace it, or {SKIP}."
        )
    path.write_bytes(whole + b"\0" * 5000)  # as a card reader leaves it
    np.testing.assert_array_equal(decode(path), image)


@pytest.mark.parametrize("thumbnail", [False, True], ids=["plain", "with a thumbnail"])
def test_a_jpeg_that_is_cut_short(path: Path, thumbnail: bool) -> None:
    """OpenCV fills the rest with grey and only prints a warning."""
    whole = jpeg_bytes()
    if thumbnail:  # an application segment that holds a whole JPEG, with an end of its own
        small = jpeg_bytes((8, 8))
        whole = whole[:2] + b"\xff\xe1" + struct.pack(">H", len(small) + 2) + small + whole[2:]
    for size in (3, 30, len(whole) - 500, len(whole) - 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        assert "truncated" in refused(path)
    path.write_bytes(whole)
    image = decode(path)
    assert image.shape == (32, 40, 3)
    path.write_bytes(whole + b"\0\0 and what a camera appends")
    np.testing.assert_array_equal(decode(path), image)


def test_other_formats_that_are_cut_short(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 2**16, (40, 50), dtype=np.uint16)
    path = tmp_path / "x.tif"
    whole = cv2.imencode(".tif", image)[1].tobytes()
    path.write_bytes(whole)
    np.testing.assert_array_equal(decode(path), image)
    path.write_bytes(whole[: len(whole) // 2])
    assert "the file is damaged or not an image" in refused(path)


def test_what_is_no_file(path: Path) -> None:
    assert refused(path) == f"{path} is missing."
    path.mkdir()
    assert refused(path) == f"{path} is not a regular file; replace it, or {SKIP}."
    path.rmdir()
    os.mkfifo(path)  # opening it would wait for ever
    assert "is not a regular file" in refused(path)
    path.unlink()
    path.write_bytes(b"")
    assert "the file is empty" in refused(path)
    path.write_bytes(b"no image")
    assert "the file is damaged or not an image" in refused(path)
    path.write_bytes(png_bytes(2**30, 2**30, depth=8, colours=0))
    assert "the file is damaged or not an image" in refused(path)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IEND", b""))
    with pytest.raises(InputError, match="cannot be decoded"):
        read_indices(path)


def test_links(path: Path, tmp_path: Path) -> None:
    path.symlink_to(tmp_path / "gone" / "y.png")
    assert refused(path) == (
        f"{path} is missing: it is a link to {tmp_path / 'gone' / 'y.png'}, which does not "
        f"exist; restore that file, or {SKIP}."
    )
    assert is_there(path)
    assert not is_there(tmp_path / "z.png")
    path.unlink()
    path.symlink_to(path)
    assert "cannot be read (Too many levels of symbolic links)" in refused(path)


def test_permission(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the file, and of a folder above it; whoever runs the tests may read everything."""
    path.write_bytes(b"secret")

    def deny(*_: object) -> bytes:
        raise PermissionError(13, "Permission denied")

    for method in ("read_bytes", "stat"):
        with monkeypatch.context() as patch:
            patch.setattr(Path, method, deny)
            assert "cannot be read: permission denied; allow access (chmod a+r" in refused(path)
    monkeypatch.setattr(Path, "lstat", deny)
    assert is_there(path)


def test_within(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root, outside = tmp_path / "data", tmp_path / "data2"
    for folder in (root / "images", outside):
        folder.mkdir(parents=True)
        (folder / "1.png").write_bytes(b"")
    inner = root / "images" / "1.png"
    assert within(inner, root) == inner
    assert within(inner, root / "images" / "..") == inner
    assert within(inner, Path("/")) == inner
    # The root itself may be a link, and so may what stays inside it.
    (tmp_path / "link").symlink_to(root)
    assert within(tmp_path / "link" / "images" / "1.png", tmp_path / "link") is not None
    (root / "images" / "2.png").symlink_to(inner)
    assert within(root / "images" / "2.png", root)
    # A folder beside the root that begins with its name is not inside it.
    for name in ("../data2/1.png", "images/../../data2/1.png"):
        with pytest.raises(
            InputError, match=r"leads out of dataset.root, to .*/data2/1.png. Set dataset.root"
        ):
            within(root / name, root)
    (root / "images" / "3.png").symlink_to(outside / "1.png")
    (root / "other").symlink_to(outside)
    for path in (root / "images" / "3.png", root / "other" / "1.png"):
        with pytest.raises(InputError, match=rf"^{path} leads out of dataset.root, to {outside}"):
            within(path, root)
    # Nothing is there: the missing file is reported where it is opened.
    assert within(root / ".." / "nothing.png", root)
    (root / "images" / "4.png").symlink_to(outside / "gone.png")
    assert within(root / "images" / "4.png", root)
    monkeypatch.chdir(tmp_path)
    assert within(Path("data/images/1.png"), Path("data"))


def test_indices_of_a_palette(path: Path) -> None:
    """Tools that draw masks write colours beside indices; OpenCV returns the colours alone."""
    red_green_blue = bytes([9, 9, 9, 255, 0, 0, 0, 255, 0])
    path.write_bytes(
        png_bytes(3, 1, depth=8, colours=3, rows=bytes([0, 2, 0, 1]), palette=red_green_blue)
    )
    assert read_indices(path).tolist() == [[2, 0, 1]]
    assert read_label(path, 3).tolist() == [[2, 0, 1]]
    with pytest.raises(InputError, match="label value 2 .*is out of range; expected 0 to 1"):
        read_label(path, 2)
    assert read_colours(path).tolist() == [[[0, 255, 0], [9, 9, 9], [255, 0, 0]]]
    # One bit each: 1, 0, 1.
    packed = png_bytes(3, 1, depth=1, colours=3, rows=bytes([0, 0b10100000]), palette=b"\0" * 6)
    path.write_bytes(packed)
    assert read_indices(path).tolist() == [[1, 0, 1]]
    damaged = bytearray(packed)
    damaged[-20] ^= 0xFF
    path.write_bytes(bytes(damaged))
    with pytest.raises(InputError, match="cannot be decoded"):
        read_indices(path)


def test_labels_whose_values_would_change(path: Path) -> None:
    path.write_bytes(png_bytes(3, 1, depth=1, colours=0, rows=bytes([0, 0b10100000])))
    assert decode(path).tolist() == [[255, 0, 255]]  # which would be ignored
    with pytest.raises(
        InputError, match="unchanged class indices, got a PNG of 1 bit; save labels"
    ):
        read_label(path, 2)
    path.write_bytes(jpeg_bytes())
    for read in (read_indices, read_colours):
        with pytest.raises(InputError, match="expected unchanged .*, got a JPEG, which changes"):
            read(path)


def test_colours(path: Path) -> None:
    colours = np.array([[[220, 20, 60], [0, 0, 142]]], np.uint8)
    cv2.imwrite(str(path), colours[..., ::-1])
    np.testing.assert_array_equal(read_colours(path), colours)
    opaque = np.dstack([colours[..., ::-1], np.full((1, 2), 255, np.uint8)])
    cv2.imwrite(str(path), opaque)
    np.testing.assert_array_equal(read_colours(path), colours)
    opaque[0, 0, 3] = 254
    cv2.imwrite(str(path), opaque)
    with pytest.raises(InputError, match=r"expected colours .*, got 4 channel\(s\) of uint8"):
        read_colours(path)
    cv2.imwrite(str(path), colours[..., 0])
    with pytest.raises(InputError, match=r"got 1 channel\(s\) of uint8; .* see dataset.ids"):
        read_colours(path)
    cv2.imwrite(str(path), colours.astype(np.uint16))
    with pytest.raises(InputError, match=r"got 3 channel\(s\) of uint16"):
        read_colours(path)


def test_arrays(tmp_path: Path) -> None:
    path = tmp_path / "x.npy"
    np.save(path, np.ones((2, 3)))
    assert read_array(path, "counts").shape == (2, 3)
    whole = path.read_bytes()
    no_header = whole.replace(b"{", b"(").replace(b"}", b"(")
    for damaged in (b"", whole[:-1], whole[:20], b"no array", no_header):
        path.write_bytes(damaged)
        with pytest.raises(
            InputError, match=rf"cannot be read as an array .*; replace it, or {SKIP}"
        ):
            read_array(path, "counts")
    with path.open("wb") as file:
        np.savez(file, one=np.ones(2))
    with pytest.raises(InputError, match=r"x.npy: expected counts, got several arrays"):
        read_array(path, "counts")
    # A header that asks for more memory than there is.
    path.write_bytes(whole.replace(b"(2, 3)", b"(9999999999999, 3)").replace(b" " * 11, b"", 1))
    with pytest.raises(InputError, match="cannot be read as an array"):
        read_array(path, "counts")


def test_lists(tmp_path: Path) -> None:
    path = tmp_path / "train.txt"
    path.write_bytes(b"\xef\xbb\xbf 00001D\r\n\r\n00002N")
    assert read_names(path, "dataset.splits.train") == ("00001D", "00002N")
    for wrong in ("00001D\n".encode("utf-16"), b"\x89PNG\r\n\x1a\n\0\0", b"a\0b\n"):
        path.write_bytes(wrong)
        with pytest.raises(InputError, match=r"^dataset.splits.train: .* is not UTF-8 text; give"):
            read_names(path, "dataset.splits.train")
    path.write_text(" \n\n")
    with pytest.raises(InputError, match=r"the list '.*train.txt' is empty; expected one name"):
        read_names(path, "dataset.splits.train")
    path.unlink()
    path.mkdir()
    with pytest.raises(InputError, match=r"^dataset.splits.train: .*train.txt is not a regular"):
        read_names(path, "dataset.splits.train")
    with pytest.raises(InputError, match="is missing"):
        read_whole(tmp_path / "none")


def test_png_with_wrong_check_sum_is_refused(path: Path) -> None:
    """Whatever a version of OpenCV makes of it."""
    image = np.random.default_rng(0).integers(0, 256, (20, 30), dtype=np.uint8)
    whole = cv2.imencode(".png", image)[1].tobytes()
    text = chunk(b"tEXt", b"Comment\0a")
    path.write_bytes(whole[:33] + text + whole[33:])
    np.testing.assert_array_equal(decode(path), image)
    path.write_bytes(whole[:33] + text.replace(b"\0a", b"\0b") + whole[33:])
    assert "damaged (a checksum of the PNG does not match)" in refused(path)
