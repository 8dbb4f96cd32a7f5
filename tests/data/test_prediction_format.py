from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image

from rgbt.checks import InputError
from rgbt.config.compose import conf_dir
from rgbt.data.palettes import FILE, palette_named
from rgbt.data.prediction_format import FormatOptions, RecognisedFormat, recognise_format

MFNET = yaml.safe_load((conf_dir() / "dataset" / "mfnet.yaml").read_text())
PST900 = yaml.safe_load((conf_dir() / "dataset" / "pst900.yaml").read_text())
PUBLISHED = yaml.safe_load(FILE.read_text())
LABEL = np.arange(9, dtype=np.uint8).reshape(3, 3)
Paint = Callable[[np.ndarray, Path], object]


def painted(rows: list[list[int]]) -> Paint:
    """RGB, as Pillow writes it."""
    return lambda label, path: Image.fromarray(np.array(rows, np.uint8)[label]).save(path)


def with_opencv(rows: list[list[int]]) -> Paint:
    return lambda label, path: cv2.imwrite(str(path), np.array(rows, np.uint8)[label])


def with_palette(rows: list[list[int]]) -> Paint:
    def write(label: np.ndarray, path: Path) -> None:
        image = Image.fromarray(label)
        image.putpalette(np.array(rows, np.uint8).ravel().tolist())
        image.save(path)

    return write


def recognise(paths: list[Path], about: dict = MFNET, **said: str) -> RecognisedFormat:
    colours = tuple(map(tuple, about["palette"]))
    options = FormatOptions(**said)  # type: ignore[arg-type]
    return recognise_format(paths, tuple(about["classes"]), colours, options)  # type: ignore[arg-type]


def write(folder: Path, paint: Paint, label: np.ndarray = LABEL) -> list[Path]:
    """Each row of the label as an image, so that no image has all classes."""
    paths = [folder / f"{number}.png" for number in range(len(label))]
    for row, path in zip(label, paths, strict=True):
        paint(row[None].copy(), path)
    return paths


VOC = PUBLISHED["voc"]["palette"]


@pytest.mark.parametrize(
    ("paint", "sentence"),
    [
        (lambda label, path: Image.fromarray(label).save(path), "class indices (one channel)"),
        (painted([[n, n, n] for n in range(9)]), "class indices (three equal channels)"),
        (painted(MFNET["palette"]), "RGB images in the colours of dataset.palette."),
        (
            with_opencv(MFNET["palette"]),
            "RGB images in the colours of dataset.palette with red and blue exchanged.",
        ),
        # As AMDANet does: red and blue are exchanged in its palette, and again by OpenCV.
        (
            with_opencv([row[::-1] for row in MFNET["palette"]]),
            "RGB images in the colours of dataset.palette.",
        ),
        (with_palette(VOC), "indices of palette PNGs, shown in the colours of the palette voc."),
        (
            with_palette(MFNET["palette"]),
            "indices of palette PNGs, shown in the colours of dataset",
        ),
        (painted(VOC), "RGB images in the colours of the palette voc."),
    ],
)
def test_what_authors_write_is_recognised_and_read(
    tmp_path: Path, paint: Paint, sentence: str
) -> None:
    paths = write(tmp_path, paint)
    found = recognise(paths)
    assert sentence in found.sentence
    for path, row in zip(paths, LABEL, strict=True):
        np.testing.assert_array_equal(found.reader.read(path), row[None])


@pytest.mark.parametrize("name", sorted(set(PUBLISHED) - {"deliver", "heatnet"}))
def test_every_published_palette_is_recognised(tmp_path: Path, name: str) -> None:
    rows = PUBLISHED[name]["palette"]
    number = PUBLISHED[name]["classes"] or 9
    about = {
        "classes": [f"class {index}" for index in range(number)],
        "palette": [[index, 1, 2] for index in range(number)],
    }
    label = np.arange(number, dtype=np.uint8)[None]
    paths = write(tmp_path, painted(rows), label)
    found = recognise(paths, about)
    assert found.sentence == f"Read as RGB images in the colours of the palette {name}."
    np.testing.assert_array_equal(found.reader.read(paths[0]), label)


def test_published_palettes_are_no_copies_of_those_of_the_data_sets() -> None:
    """A palette is written down once; and the table of VOC follows its rule of bits."""
    listed = [yaml.safe_load(path.read_text()) for path in (conf_dir() / "dataset").glob("*.yaml")]
    own = [each["palette"] for each in listed if each.get("palette")]
    assert len(own) >= 4
    for name, each in PUBLISHED.items():
        assert each["palette"] not in own, name
        assert len({tuple(row) for row in each["palette"]}) == len(each["palette"]), name
        assert each["classes"] is None or len(each["palette"]) <= each["classes"], name
    for index, row in enumerate(VOC):
        bits = [[index >> 3 * place + channel & 1 for place in range(3)] for channel in range(3)]
        assert row == [sum(bit << 7 - place for place, bit in enumerate(each)) for each in bits]


def test_two_readings_that_differ_are_refused(tmp_path: Path) -> None:
    """PST900's red and blue are the colours of two classes, in either order."""
    label = np.array([[0, 1, 3]], np.uint8)
    paths = write(tmp_path, painted(PST900["palette"]), label)
    expected = (
        r"\(0, 0, 255\) is fire_ex.* with palette=dataset and hand_drill with palette=datas.*-bgr"
    )
    with pytest.raises(InputError, match=expected):
        recognise(paths, PST900)
    for palette, values in (("dataset", [[0, 1, 3]]), ("dataset-bgr", [[0, 3, 1]])):
        found = recognise(paths, PST900, palette=palette)
        np.testing.assert_array_equal(found.reader.read(paths[0]), values)
        assert palette in found.sentence


def test_colours_shifted_by_one_class_are_refused_where_both_fit(tmp_path: Path) -> None:
    """DELIVER has no colour for class 0: its car has the colour of MFNet's person."""
    paths = write(tmp_path, painted(PUBLISHED["deliver"]["palette"]), LABEL.clip(0, 7))
    with pytest.raises(
        InputError, match="is bike with palette=dataset and person with palette=deliver"
    ):
        recognise(paths)
    found = recognise(paths, palette="deliver")
    np.testing.assert_array_equal(found.reader.read(paths[2]), [[6, 7, 7]])


def test_a_palette_png_with_colours_of_other_classes_is_refused(tmp_path: Path) -> None:
    """VOC's class 3 has the colour of MFNet's class 5; with other classes, it is VOC's palette."""
    label = np.array([[0, 3]], np.uint8)
    paths = write(tmp_path, with_palette(VOC), label)
    with pytest.raises(InputError, match=r"index 3 is shown as \(128, 128, 0\).*car_stop.*bike"):
        recognise(paths)
    np.testing.assert_array_equal(recognise(paths, form="index").reader.read(paths[0]), label)
    found = recognise(paths, form="colour", palette="dataset")
    np.testing.assert_array_equal(found.reader.read(paths[0]), [[0, 5]])
    beyond = write(tmp_path, with_palette(VOC), np.array([[0, 12]], np.uint8))
    with pytest.raises(
        InputError, match="palette index 12 is no class, .* only the classes 0 to 8"
    ):
        recognise(beyond)
    strange = write(tmp_path, with_palette([[9, 9, 9], [8, 8, 8]]), np.array([[0, 1]], np.uint8))
    with pytest.raises(InputError, match=r"those of no known palette; choose .*palette=FILE\.yaml"):
        recognise(strange)


def test_overlays_are_refused(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (32, 32, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "a.png")
    with pytest.raises(
        InputError, match="holds 1,024 colours, as an image or a prediction blended"
    ):
        recognise([tmp_path / "a.png"])


def test_an_unknown_colour_is_compared_with_the_palette_of_the_other_ones(tmp_path: Path) -> None:
    (path,) = write(tmp_path, painted([*VOC[:4], [1, 0, 128]]), np.arange(5, dtype=np.uint8)[None])
    found = recognise([path])
    with pytest.raises(InputError, match=r"nearest in the palette voc is curve \(0, 0, 128\)"):
        found.reader.read(path)


def test_a_palette_of_the_user_is_a_file(tmp_path: Path) -> None:
    rows = [[10 * number, 20, 30] for number in range(9)]
    file = tmp_path / "mine.yaml"
    file.write_text(yaml.safe_dump({"palette": rows}))
    paths = write(tmp_path, painted(rows))
    found = recognise(paths, palette=str(file))
    np.testing.assert_array_equal(found.reader.read(paths[1]), [[3, 4, 5]])
    data_set = str(conf_dir() / "dataset" / "mfnet.yaml")
    assert list(palette_named(data_set, None).colours) == [  # type: ignore[arg-type]
        tuple(row) for row in MFNET["palette"]
    ]
    file.write_text("palette: [[0, 0, 256]]")
    with pytest.raises(InputError, match=r"expected the key palette with a list of \[red, green"):
        recognise(paths, palette=str(file))


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"palette": "vco"}, "palette=vco: did you mean 'voc'"),
        ({"palette": "voc", "form": "index"}, "no effect with format=index"),
    ],
)
def test_a_palette_that_makes_no_sense_is_refused(
    tmp_path: Path, said: dict[str, str], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        recognise(write(tmp_path, painted(VOC)), **said)


def test_a_palette_has_no_effect_on_indices(tmp_path: Path) -> None:
    paths = write(tmp_path, lambda label, path: Image.fromarray(label).save(path))
    with pytest.raises(InputError, match="palette=voc has no effect on PNGs with one channel"):
        recognise(paths, palette="voc")
