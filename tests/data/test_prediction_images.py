from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rgbt.checks import InputError
from rgbt.data.palettes import Palette
from rgbt.data.prediction_format import FormatOptions, one_kind, recognise_format
from rgbt.data.prediction_images import PredictionReader, read_header

CLASSES = ("ground", "car", "person")
PALETTE = ((0, 0, 0), (64, 0, 128), (64, 64, 0))
INDICES = np.array([[0, 1, 2], [2, 1, 0]], np.uint8)
COLOURS = np.array(PALETTE, np.uint8)[INDICES]


def read(path: Path, form: str = "auto") -> np.ndarray:
    options = FormatOptions(form=form)  # type: ignore[arg-type]
    return recognise_format([path], CLASSES, PALETTE, options).reader.read(path)


def grey(path: Path, values: np.ndarray = INDICES) -> Path:
    Image.fromarray(values).save(path)
    return path


def with_palette(path: Path, palette: object, values: np.ndarray = INDICES) -> Path:
    image = Image.new("P", values.shape[::-1])
    image.putdata(values.ravel().tolist())
    image.putpalette(np.array(palette, np.uint8).ravel().tolist())
    image.save(path)
    return path


def test_three_kinds_of_file_give_equal_counts(tmp_path: Path) -> None:
    opaque = np.dstack([COLOURS, np.full(INDICES.shape, 255, np.uint8)])
    files = [
        grey(tmp_path / "index.png"),
        grey(tmp_path / "colour.png", COLOURS),
        grey(tmp_path / "opaque.png", opaque),
        with_palette(tmp_path / "palette.png", PALETTE),
    ]
    assert read_header(files[3]).bits < 8  # packed pixels of a short palette are indices too
    for file in files:
        np.testing.assert_array_equal(read(file), INDICES, err_msg=file.name)


def test_format_colour_reads_any_file_and_index_equal_channels(tmp_path: Path) -> None:
    # A palette in another order: the stored numbers are 0, 2, 1 where the colours say 0, 1, 2.
    shuffled = with_palette(tmp_path / "p.png", [PALETTE[0], PALETTE[2], PALETTE[1]])
    swapped = np.array([[0, 2, 1], [1, 2, 0]])
    np.testing.assert_array_equal(read(shuffled, "colour"), swapped)
    np.testing.assert_array_equal(read(shuffled, "index"), INDICES)
    with pytest.raises(
        InputError, match=r"index 1 is shown as \(64, 64, 0\), .*person.*is car.*format=index"
    ):
        read(shuffled)
    three = grey(tmp_path / "three.png", np.dstack([INDICES] * 3))
    np.testing.assert_array_equal(read(three, "index"), INDICES)
    black = grey(tmp_path / "black.png", np.zeros((2, 2), np.uint8))
    assert not read(black, "colour").any()


def test_a_foreign_palette_is_not_guessed_at(tmp_path: Path) -> None:
    """VOC's colour of index 3 is another class's colour here: both readings are possible."""
    voc = [(0, 0, 0), (128, 0, 0), (0, 128, 0), (64, 0, 128)]
    path = with_palette(tmp_path / "voc.png", voc, np.array([[0, 3]], np.uint8))
    with pytest.raises(InputError, match=r"only the classes 0 to 2; choose one reading: format="):
        read(path)
    unused = with_palette(tmp_path / "unused.png", voc, np.array([[0, 0]], np.uint8))
    assert not read(unused).any()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            np.array([[0, 3]], np.uint8),
            r"bad\.png: value 3 is not a class; expected 0 to 2 .*person",
        ),
        (
            np.array([[0, 255]], np.uint8),
            r"bad\.png: 1 pixels are 255; a prediction cannot ignore pixels",
        ),
        (
            np.array([[[0, 0, 0], [64, 0, 127]]], np.uint8),
            r"bad\.png: colour \(64, 0, 127\) at row 0, .*\(1 such .*is car \(64, 0, 128\)",
        ),
        (np.array([[0, 1]], np.uint16), r"bad\.png: expected 8 bits per channel, got 16"),
        (np.array([[True, False]]), r"bad\.png: expected 8 bits per pixel, got 1"),
        (np.zeros((1, 2, 4), np.uint8), r"bad\.png: 2 pixels are transparent"),
        (
            np.array([[[0, 0, 0, 255], [0, 0, 0, 254]]], np.uint8),  # nearly opaque is not opaque
            r"bad\.png: 1 pixels are transparent",
        ),
        (np.zeros((1, 2, 2), np.uint8), r"bad\.png: .*got grey with transparency"),
    ],
)
def test_invalid_predictions_are_refused(tmp_path: Path, values: object, message: str) -> None:
    path = grey(tmp_path / "bad.png", np.asarray(values))
    with pytest.raises(InputError, match=message):
        read(path)


def test_three_different_channels_are_no_indices(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"three equal ones, got three that differ"):
        read(grey(tmp_path / "a.png", COLOURS), "index")


def test_files_that_are_no_png_or_half_of_one(tmp_path: Path) -> None:
    text = tmp_path / "text.png"
    text.write_text("no picture, but long enough for a header")
    with pytest.raises(InputError, match=r"text\.png is not a PNG file"):
        read(text)
    noise = np.random.default_rng(0).integers(0, 3, (64, 64), np.uint8)
    whole = grey(tmp_path / "whole.png", noise).read_bytes()
    half = tmp_path / "half.png"
    half.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"half\.png cannot be decoded"):
        read(half)


def test_a_file_that_claims_too_many_pixels_is_not_decoded(tmp_path: Path) -> None:
    path = grey(tmp_path / "bomb.png")
    content = bytearray(path.read_bytes())
    content[16:24] = struct.pack(">II", 20_000, 10_000)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    path.write_bytes(content)
    for form in ("index", "colour"):
        with pytest.raises(InputError, match="bomb.png cannot be decoded"):
            read(path, form)


def test_two_classes_of_one_colour_are_refused(tmp_path: Path) -> None:
    twice = ((0, 0, 0), (1, 1, 1), (1, 1, 1))
    index = grey(tmp_path / "index.png")
    found = recognise_format([index], CLASSES, twice).reader.read(index)
    np.testing.assert_array_equal(found, INDICES)
    colour = grey(tmp_path / "colour.png", COLOURS)
    with pytest.raises(InputError, match=r"the classes 1 and 2 the same colour \(1, 1, 1\)"):
        recognise_format([colour], CLASSES, twice)
    with pytest.raises(InputError, match=r"the palette mine gives the classes 1 and 2"):
        PredictionReader(CLASSES, Palette("mine", twice))


def test_files_of_different_kinds_are_refused_together(tmp_path: Path) -> None:
    files = [grey(tmp_path / "a.png"), grey(tmp_path / "b.png")]
    assert one_kind(files) == "one channel"
    files.append(grey(tmp_path / "c.png", COLOURS))
    with pytest.raises(InputError, match=r"one channel \(.*a\.png\), others with colours \(.*c\.p"):
        one_kind(files)
