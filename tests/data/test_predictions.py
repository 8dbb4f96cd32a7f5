"""Predicted label images of any method, in the format that the user states."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from rgbt.data.predictions import Affixes, FormatOptions, PredictionReader, prediction_paths
from tests.data.layouts import refused

CLASSES = ("ground", "car", "person")
PALETTE = ((0, 0, 0), (64, 0, 128), (64, 64, 0))
INDICES = np.array([[0, 1, 2], [2, 1, 0]], np.uint8)
COLOURS = np.array(PALETTE, np.uint8)[INDICES]


def read(path: Path, form: str = "index", **options: Any) -> np.ndarray:
    stated = FormatOptions(form=form, **options)  # type: ignore[arg-type]
    return PredictionReader(CLASSES, PALETTE, stated).read(path)


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
    ("content", "said"),
    [
        *(({"palette": value}, "the key palette") for value in ([[0, 0, 256]], "red", [[0, 0]])),
        ([1], "expected the key palette"),
        ({"palette": [[0, 0, 0], [1, 1, 1], [1, 1, 1]]}, "two classes have one colour"),
        ({"palette": [[0, 0, 0]]}, "colour [64, 0, 128] (2 pixels; one of 2 unknown values)"),
    ],
)
def test_invalid_palettes_are_refused(tmp_path: Path, content: object, said: str) -> None:
    path, file = save(tmp_path / "x.png", COLOURS), tmp_path / "own.yaml"
    file.write_text(yaml.safe_dump(content))
    assert said in refused(lambda: read(path, "colour", palette=str(file)))


def test_names_of_files(tmp_path: Path) -> None:
    paths = prediction_paths(tmp_path, ["a", "b/c"], Affixes("Pred_", "_x"))
    assert paths == {"a": tmp_path / "Pred_a_x.png", "b/c": tmp_path / "Pred_b/c_x.png"}
    assert "format: 'colours' is not a valid choice" in refused(lambda: read(tmp_path, "colours"))
