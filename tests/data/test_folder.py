"""Somebody's own data set, described by one YAML."""

from __future__ import annotations

import inspect
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from rgbt.config.component import Component, build
from rgbt.data.check import check_dataset
from rgbt.data.folder import Folder
from rgbt.data.images import grey
from rgbt.data.labels import painted
from tests.conftest import write_png
from tests.data.folder_files import (
    CLASSES,
    HW,
    PATTERNS,
    RANGE,
    contents,
    folder,
    listed,
    refused,
    write_folder,
    write_frame,
    write_tiff,
)

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_folder(tmp_path / "mine")


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same for tests that write nothing."""
    return write_folder(tmp_path_factory.mktemp("sound") / "mine")


# Reading


def test_reads_what_the_patterns_name(sound: Path) -> None:
    dataset = folder(sound)
    assert dataset.names("train") == ("train_1", "train_2", "train_3")
    assert dataset.splits["val"] == "val/rgb/{name}.png"
    sample = dataset.read("test_2")
    rgb, counts, label = contents("test_2")
    np.testing.assert_array_equal(sample.rgb, rgb)
    np.testing.assert_array_equal(sample.label, label)
    # Levels are 4000 / 255 counts wide; to the nearest one.
    exact = (counts.astype(float) - 20000) / 4000 * 255
    assert np.abs(sample.thermal - exact).max() <= 0.5 + 1e-9
    assert [sample.rgb.dtype, sample.thermal.dtype, sample.label.dtype] == [np.uint8] * 3
    assert sample.name == "test_2"
    assert dataset.files("test_2") == (
        sound / "test/rgb/2.png",
        sound / "test/ir/2_ir.tif",
        sound / "test/mask/2.png",
    )


def test_grey_levels_by_hand() -> None:
    """255 (v - 100) / 200: 200 is 127.5, which goes up; 101 is 1.275 and 102 is 2.55."""
    expected = [0, 0, 1, 3, 128, 255, 255]
    for dtype in (np.uint16, np.int16, np.float32, np.float64):
        values = np.array([[0, 100, 101, 102, 200, 300, 999]], dtype)
        assert grey(values, (100, 300), Path("x")).tolist() == [expected]
    real = np.array([[19.99, 20.0, 25.0, 29.98, 30.5]], np.float32)
    assert grey(real, (20.0, 30.0), Path("x")).tolist() == [[0, 0, 128, 254, 255]]
    assert grey(np.array([[-5]], np.int16), (-10, 0), Path("x")).tolist() == [[128]]


def test_grey_levels_equal_whole_number_arithmetic() -> None:
    counts = np.arange(2**16, dtype=np.uint16)[None]
    found = grey(counts, (21800, 23700), Path("x"))
    above = np.clip(np.arange(2**16), 21800, 23700) - 21800
    np.testing.assert_array_equal(found[0], (2 * 255 * above + 1900) // 3800)


def test_thermal_of_eight_bits(root: Path) -> None:
    level = np.arange(48, dtype=np.uint8).reshape(HW)
    for index in range(1, 4):
        write_tiff(root / "train" / "ir" / f"{index}_ir.tif", np.dstack([level] * 3))
    dataset = folder(root, thermal_range=None)
    np.testing.assert_array_equal(dataset.read("train_1").thermal, level)
    # A range widens grey levels too: 0 to 51 become 0 to 255.
    stretched = folder(root, thermal_range=(0, 51)).read("train_1").thermal
    np.testing.assert_array_equal(stretched, level * 5)
    said = refused(lambda: dataset.read("val_1"))
    assert said.startswith(f"{root / 'val/ir/1_ir.tif'}: expected thermal values of 8 bits per")
    assert "require dataset.thermal_range=[low, high]" in said
    said = refused(lambda: folder(root).read("train_1"))
    assert "dataset.thermal_range=[20000, 24000], got 8 bits; use the original file" in said


def test_thermal_of_real_numbers(root: Path) -> None:
    path = root / "train" / "ir" / "1_ir.tif"
    celsius = np.full(HW, 25.0, np.float32)
    write_tiff(path, celsius)
    dataset = folder(root, thermal_range=(20, 30))
    assert (dataset.read("train_1").thermal == 128).all()
    celsius[2, 3:5] = (np.nan, np.inf)
    write_tiff(path, celsius)
    assert refused(lambda: dataset.read("train_1")).startswith(
        f"{path}: 2 thermal values are NaN or infinite"
    )


def test_packed_files(tmp_path: Path) -> None:
    image = np.arange(192, dtype=np.uint8).reshape(*HW, 4)
    for split in ("train", "val", "test"):
        write_png(tmp_path / split / "7.png", image)
        write_png(tmp_path / split / "7_mask.png", np.ones(HW, np.uint8))
    keys: dict[str, Any] = {
        **{"rgb": "{split}/{name}.png", "thermal": "{split}/{name}.png"},
        **{"label": "{split}/{name}_mask.png", "thermal_range": None},
    }
    dataset = folder(tmp_path, **keys)
    sample = dataset.read("train_7")
    np.testing.assert_array_equal(sample.rgb, image[..., :3])
    np.testing.assert_array_equal(sample.thermal, image[..., 3])
    assert dataset.files("train_7") == (tmp_path / "train/7.png", tmp_path / "train/7_mask.png")
    assert dataset.title == "{split}/{name}.png of four channels"
    stretched = folder(tmp_path, **{**keys, "thermal_range": (0, 51)})
    np.testing.assert_array_equal(
        stretched.read("train_7").thermal, np.minimum(image[..., 3].astype(int) * 5, 255)
    )
    write_png(tmp_path / "train" / "7.png", image[..., :3])
    assert "got 3; use the original file, or give separate images" in refused(
        lambda: dataset.read("train_7")
    )


def test_all_in_one_folder(tmp_path: Path) -> None:
    """What "{name}.png" matches besides: thermal images and labels of the frames themselves."""
    for name in ("train_9", "train_10", "val_1", "test_1"):
        write_png(tmp_path / f"{name}.png", np.zeros((*HW, 3), np.uint8))
        for kind in ("ir", "mask"):
            write_png(tmp_path / f"{name}_{kind}.png", np.zeros(HW, np.uint8))
    dataset = folder(
        tmp_path,
        **{"rgb": "{split}_{name}.png", "thermal": "{split}_{name}_ir.png"},
        **{"label": "{split}_{name}_mask.png", "thermal_range": None},
    )
    assert list(dataset.frames) == ["test_1", "train_9", "train_10", "val_1"]
    assert check_dataset(dataset).problems == ()


def test_unlabelled(root: Path) -> None:
    for path in (root / "val" / "mask").iterdir():
        path.unlink()
    dataset = folder(root, unlabelled=("val",))
    assert dataset.read("val_1").label is None
    assert dataset.label("val_1") is None
    assert len(dataset.files("val_1")) == 2
    assert dataset.read("test_1").label is not None
    nothing = folder(root, label=None)
    assert nothing.read("test_1").label is None
    assert len(nothing.files("test_1")) == 2
    assert "dataset.unlabelled: 'vall' is not a valid choice" in refused(
        lambda: folder(root, unlabelled=("vall",))
    )


# Labels


def test_label_values(root: Path) -> None:
    path = root / "train" / "mask" / "1.png"
    label = np.zeros(HW, np.uint16)
    label[0, :5] = (7, 24, 26, 400, 255)
    write_png(path, label)
    ids = {0: "background", 24: "person", 26: "car", 400: "car"}
    dataset = folder(root, ids=ids, ignored=(7,))
    found = dataset.label("train_1")
    assert found is not None
    assert found[0].tolist() == [255, 1, 2, 2, 255, 0, 0, 0]
    assert not found[1:].any()
    label[1, :3] = (9, 9, 30)
    write_png(path, label)
    assert "label value 9 (2 pixels; one of 2 unknown values) has no class in" in refused(
        lambda: dataset.label("train_1")
    )
    # 255 may be a class if the configuration says so.
    whole = folder(root, ids={**ids, 255: "person", 9: "car", 30: "car"}, ignored=(7,))
    found = whole.label("train_1")
    assert found is not None
    assert found[0, 4] == 1


def test_label_colours(root: Path) -> None:
    colours = {"background": (0, 0, 0), "person": (220, 20, 60), "car": ((0, 0, 142), (0, 0, 70))}
    image = np.zeros((*HW, 3), np.uint8)
    image[0, :4] = [(220, 20, 60), (0, 0, 142), (0, 0, 70), (255, 255, 255)]
    path = root / "train" / "mask" / "1.png"
    write_png(path, image)
    dataset = folder(root, colours=colours, ignored=((255, 255, 255),))
    found = dataset.label("train_1")
    assert found is not None
    assert found[0].tolist() == [1, 2, 2, 255, 0, 0, 0, 0]
    assert dataset.palette == ((0, 0, 0), (220, 20, 60), (0, 0, 142))
    image[2, :3] = [(60, 20, 220), (60, 20, 220), (1, 2, 3)]
    write_png(path, image)
    assert "colour [60, 20, 220] (2 pixels; one of 2 unknown values)" in refused(
        lambda: dataset.label("train_1")
    )


def test_generated_colours() -> None:
    """By hand: bit 0 is red 128, bit 1 green 128, bit 2 blue 128, bit 3 red 64."""
    assert painted(10) == (
        *((0, 0, 0), (128, 0, 0), (0, 128, 0), (128, 128, 0), (0, 0, 128)),
        *((128, 0, 128), (0, 128, 128), (128, 128, 128), (64, 0, 0), (192, 0, 0)),
    )
    assert len(set(painted(256))) == 256


# The whole


def test_fingerprint_and_decoding(tmp_path: Path) -> None:
    one, other = write_folder(tmp_path / "one"), write_folder(tmp_path / "other")
    first = folder(one)
    assert folder(other).fingerprint() == first.fingerprint()
    assert folder(one, ids={0: "car", 1: "person", 2: "car"}).fingerprint() != first.fingerprint()
    assert folder(one, folders={"train": "train"}).fingerprint() != first.fingerprint()
    (other / "val" / "mask" / "1.png").write_bytes(b"other")
    assert folder(other).fingerprint() != first.fingerprint()
    assert folder(one, night="*1").fingerprint() == first.fingerprint()
    decodings = [
        json.dumps(dataset.decoding(), sort_keys=True)
        for dataset in (
            first,
            folder(one, thermal_range=(1, 2)),
            folder(one, ids={0: "car", 1: "person", 2: "car"}),
            folder(one, colours={"car": (0, 0, 1)}),
        )
    ]
    assert len(set(decodings)) == 4


def test_the_configuration_names_every_key(sound: Path) -> None:
    node = OmegaConf.load(ROOT / "conf" / "dataset" / "folder.yaml")
    parameters = inspect.signature(Folder).parameters
    assert node.pop("absent") == "exclude"
    assert list(node) == ["_target_", *(key for key in node if key in parameters)]
    assert set(node) == {"_target_", *parameters}
    for key, parameter in parameters.items():
        if OmegaConf.is_missing(node, key):
            assert parameter.default is parameter.empty, key
        else:
            default = list(parameter.default) if parameter.default == () else parameter.default
            assert node[key] == default, key
    own = {"root": str(sound), "num_classes": 3, "classes": list(CLASSES), **PATTERNS}
    own |= {"thermal_range": list(RANGE), "ids": {0: "background", 1: "person", 2: "car"}}
    config = OmegaConf.create({"dataset": OmegaConf.merge(node, own)})
    Component.from_node(config.dataset, "dataset")
    assert build(config.dataset).read("test_1").thermal.shape == HW


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"palette": ((0, 0, 0),)}, "num_classes is 3 but dataset.palette has 1"),
        ({"unscored": ("cars",)}, "dataset.unscored: 'cars' is not a valid choice"),
        ({"classes": ("car", "person", "car")}, "dataset.classes: a name occurs twice"),
        ({"thermal_range": (5, 5)}, "dataset.thermal_range: expected [low, high], got [5, 5]"),
        ({"thermal_range": (5, float("nan"))}, "dataset.thermal_range: "),
        ({"ids": {0: "car"}, "colours": {"car": (0, 0, 0)}}, "dataset.ids and dataset.colours"),
        ({"ids": {0: "cars"}}, "dataset.ids: 'cars' is not a valid choice; did you mean 'car'"),
        ({"ids": {0: "car"}, "ignored": (0,)}, "dataset.ids: 0 occurs twice"),
        ({"colours": {"car": ((1, 2, 3), (1, 2, 3))}}, "dataset.colours: (1, 2, 3) occurs twice"),
        ({"colours": {"car": (1, 2, 3)}, "ignored": (255,)}, "dataset.ignored: 255 is no value"),
        ({"ignored": ((1, 2, 3),)}, "dataset.ignored: (1, 2, 3) is no value"),
        ({"colours": {}}, "expected the colour of every class, got none"),
    ],
)
def test_settings_that_cannot_be(sound: Path, keys: dict[str, Any], said: str) -> None:
    assert said in refused(lambda: folder(sound, **keys))


def test_thermal_and_labels_as_arrays(root: Path) -> None:
    for path in list(root.glob("*/ir/*.tif")):
        level = 20.0 if path.parts[-3] == "train" else 30.0
        name = path.stem.removesuffix("_ir")
        np.save(path.with_name(name), np.full(HW, level))
        np.save(path.parents[1] / "mask" / name, np.full(HW, -1, np.int64))
    keys = {"thermal": "{split}/ir/{name}.npy", "thermal_range": (20, 30)}
    dataset = folder(root, **keys, label="{split}/mask/{name}.npy", ids={-1: "car"})
    assert (dataset.read("train_1").thermal == 0).all()
    assert (dataset.read("val_1").thermal == 255).all()
    assert set(dataset.read("val_1").label.flat) == {2}
    for wrong in (np.zeros(HW, complex), np.zeros(48), np.zeros(HW, bool)):
        np.save(root / "train/ir/2.npy", wrong)
        assert "expected thermal values of shape (rows, columns)" in refused(
            lambda: dataset.read("train_2")
        )


def test_check_of_own_data(root: Path) -> None:
    report = check_dataset(folder(root, night="*_2"))
    assert report.problems == ()
    assert (report.splits["train"].day, report.splits["train"].night) == (2, 1)
    assert report.notes[-1].startswith("split val has no night images")
    write_frame(root, "extra", "1")
    (root / "test" / "rgb" / "2.png").unlink()
    (root / "val.txt").write_text("val_1\ntrain_2\n")
    report = check_dataset(listed(root, "train_1", "train_1", "val_1", "lost_1"))
    assert list(report.problems) == [
        f"folder ({root}) has no frame called 'lost_1': there is no such RGB image "
        "(dataset.rgb='{part}/rgb/{name}.png').",
        "split train lists 'train_1' 2 times.",
        "splits train and val share 1 names; the first is 'val_1'.",
        f"2 files belong to no image of a split; the first is {root}/test/ir/2_ir.tif.",
    ]
    assert report.notes[0] == "3 frames are in no split; the first is 'extra_1'."
    # Two splits that are declared as one are valid.
    same = folder(root, folders={"train": "train", "val": "val", "test": "val"})
    assert not any("share" in line for line in check_dataset(same).problems)
