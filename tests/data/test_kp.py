from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import yaml

from rgbt.checks import InputError
from rgbt.data.kp import CLASSES, KP, PALETTE
from rgbt.data.kp_layout import SPLITS, is_night
from tests.conftest import write_png
from tests.data.kp_files import (
    HW,
    NAMES,
    NIGHTS,
    TEST,
    TRAIN,
    VAL,
    contents,
    image_path,
    write_jpeg,
    write_kp,
    write_lists,
    write_ms_uda,
)

ROOT = Path(__file__).resolve().parents[2]
OFFICIAL = Path(os.environ.get("RGBT_SHARED", ROOT.parent / "shared")) / "realdata" / "kp_names"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_lists(write_kp(tmp_path / "kp"))


def expected_label(name: str) -> np.ndarray:
    label = contents(name)[2]
    assert 19 in label
    return np.where(label == 19, 255, label)


def test_reads_the_layout_of_the_release(root: Path) -> None:
    dataset = KP(str(root))
    assert [dataset.names(split) for split in ("train", "val", "test")] == [TRAIN, VAL, TEST]
    for name in NAMES:
        sample = dataset.read(name)
        rgb, thermal, _ = contents(name)
        assert [sample.rgb.dtype, sample.thermal.dtype, sample.name] == [np.uint8, np.uint8, name]
        # Channels in the order of the file, which JPEG changes by two levels at most.
        assert np.abs(sample.rgb.astype(int) - rgb).max() <= 2
        assert np.abs(sample.thermal.astype(int) - thermal).max() <= 1
        assert sample.label is not None
        np.testing.assert_array_equal(sample.label, expected_label(name))
        np.testing.assert_array_equal(dataset.label(name), expected_label(name))
    assert dataset.unscored == ()
    assert dataset.splits == SPLITS


def test_reads_the_layout_of_ms_uda(tmp_path: Path) -> None:
    dataset = KP(str(write_ms_uda(tmp_path)))
    assert dataset.lists == "sets"
    assert [dataset.names(split) for split in ("train", "val", "test")] == [TRAIN, VAL, TEST]
    for name in (TRAIN[0], TRAIN[2]):
        sample = dataset.read(name)
        np.testing.assert_array_equal(sample.rgb, contents(name)[0])
        np.testing.assert_array_equal(sample.thermal, contents(name)[1])
        np.testing.assert_array_equal(sample.label, expected_label(name))
    assert dataset.files(TRAIN[2]) == (
        tmp_path / "pseudo_KP/val_night/set03_V001_visible_I00117.png",
        tmp_path / "pseudo_KP/val_night/set03_V001_lwir_I00117.png",
        tmp_path / "labels/val_night/set03_V001_I00117.png",
    )


def test_lists_of_ms_uda(tmp_path: Path) -> None:
    root = write_ms_uda(tmp_path)
    (root / "val_day_rgb.txt").write_text("set00_V000_visible_I00050.png\n")
    (root / "val_night_th.txt").write_text("set09_V000_lwir_I00184.png\n")
    dataset = KP(str(root), splits={"train": "val_day_rgb.txt", "val": "val_night_th.txt"})
    assert dataset.lists == "files"
    assert (dataset.names("train"), dataset.names("val")) == (TRAIN[:1], (TEST[2],))


def test_labels_of_ms_uda_with_images_of_release(root: Path) -> None:
    for name in NAMES:
        time = "val_night" if name[:5] in NIGHTS else "val_day"
        target = root / "labels" / time / f"{name}.png"
        target.parent.mkdir(exist_ok=True)
        (root / "labels" / f"{name}.png").rename(target)
    dataset = KP(str(root), lists="sets")
    assert dataset.names("test") == TEST
    np.testing.assert_array_equal(dataset.read(VAL[1]).label, expected_label(VAL[1]))


def test_files(root: Path) -> None:
    dataset = KP(str(root))
    assert dataset.files(TEST[3]) == (
        root / "images/set11/V001/visible/I01512.jpg",
        root / "images/set11/V001/lwir/I01512.jpg",
        root / "labels/set11_V001_I01512.png",
    )
    assert dataset.decoding() == {"num_classes": 19, "most_tint": 8}
    for path in dataset.files(TEST[3]):
        content = path.read_bytes()
        path.unlink()
        with pytest.raises(InputError, match=f"{path} is missing"):
            dataset.read(TEST[3])
        path.write_bytes(content)
    assert len(dataset.files("set11_V999_I00000")) == 3


def test_splits_by_set_number(root: Path) -> None:
    dataset = KP(str(root), lists="sets")
    by_set = {split: dataset.names(split) for split in dataset.splits}
    assert by_set == {
        **{"train": TRAIN, "train_day": TRAIN[:2], "train_night": TRAIN[2:]},
        **{"val": VAL, "val_day": VAL[:1], "val_night": VAL[1:]},
        **{"test": TEST, "test_day": TEST[:2], "test_night": TEST[2:]},
    }
    assert dataset.splits["train_day"] == "labels of set00, set01, set02"
    assert dataset.splits["test"] == "labels of set07, set08, set09, set11"
    assert dataset.splits["val_night"] == "labels of set10"


def test_who_divides_the_images(root: Path) -> None:
    assert KP(str(root)).lists == "files"
    (root / "train.txt").write_text(f"{TRAIN[1]}\n")
    assert KP(str(root)).names("train") == TRAIN[1:2]
    assert KP(str(root), lists="sets").names("train") == TRAIN
    for split in ("train", "val", "test"):
        (root / f"{split}.txt").unlink()
    assert KP(str(root)).lists == "sets"
    assert KP(str(root), lists="files").lists == "files"
    other = KP(str(root), splits={"train": "mine.txt"})
    with pytest.raises(InputError, match=r"dataset.splits.train: there is no list '\S+mine.txt'"):
        other.names("train")
    with pytest.raises(InputError, match=r"splits names lists but dataset.lists=sets reads none"):
        KP(str(root), splits={"train": "mine.txt"}, lists="sets")


def test_times_of_day_out_of_one_list(root: Path) -> None:
    dataset = KP(str(root))
    assert dataset.names("train_day") == TRAIN[:2]
    assert dataset.names("test_night") == TEST[2:]
    assert dataset.has("val_night")
    write_lists(root, {"train_day": TRAIN[1:2], "val": VAL[:1]})
    dataset = KP(str(root))
    assert dataset.names("train_day") == TRAIN[1:2]  # its own list comes first
    with pytest.raises(InputError, match=r"'val_night' of kp is empty: .* image in '\S+val.txt'"):
        dataset.names("val_night")


def test_a_list_of_days_alone(root: Path) -> None:
    """There are no nights then, and nothing that walks the splits stumbles over them."""
    for split, name in (("train", TRAIN[0]), ("val", VAL[0]), ("test", TEST[0])):
        (root / f"{split}.txt").write_text(f"{name}\n")
    data = KP(str(root))
    assert [data.has(f"{split}_night") for split in ("train", "val", "test")] == [False] * 3
    assert data.has("val_day")
    assert len(data.fingerprint()) == 64


def test_split_is_union_of_day_and_night(tmp_path: Path) -> None:
    root = write_kp(tmp_path)
    write_lists(root, {"test_day": TEST[1::-1], "test_night": TEST[2:], "train_day": TRAIN[:1]}, "")
    dataset = KP(str(root))
    assert dataset.names("test") == TEST  # sorted
    assert dataset.names("test_day") == TEST[1::-1]  # as listed
    assert not dataset.has("train")
    with pytest.raises(InputError, match=r"there is no list '\S+/train.txt'; .*lists=sets"):
        dataset.names("train")
    with pytest.raises(InputError, match=r"no split 'tets'; did you mean 'test'"):
        dataset.has("tets")


def test_refuses_wrong_lists(root: Path) -> None:
    for line in (
        "00001D",
        "set12_V000_I00050",
        "set00_V000_I0050",
        "set00_V000_I00050.jpg",
        "../x",
    ):
        (root / "val.txt").write_text(f"{VAL[0]}.png\n{line}\n")
        with pytest.raises(InputError, match=rf"splits.val: '{line}' in '\S+' is not a name such"):
            KP(str(root)).names("val")
    (root / "val.txt").write_text("\n")
    with pytest.raises(InputError, match=r"dataset.splits.val: the list .* is empty"):
        KP(str(root)).names("val")


def test_no_label_of_a_split(tmp_path: Path) -> None:
    dataset = KP(str(write_kp(tmp_path, TRAIN)))
    assert [dataset.has(split) for split in ("train", "val", "train_night")] == [True, False, True]
    with pytest.raises(InputError, match=r"'val' of kp is empty: .* labels of set06, set10 in"):
        dataset.names("val")
    assert len(dataset.fingerprint()) == 64


def test_nights(root: Path) -> None:
    dataset = KP(str(root))
    assert dataset.nights(TEST) == (False, False, True, True)
    nights = [number for number in range(12) if is_night(f"set{number:02d}_V000_I00000")]
    assert nights == [3, 4, 5, 9, 10, 11]
    with pytest.raises(InputError, match="'00001N' is not a name such as set00_V000_I00050"):
        dataset.nights(("00001N",))


@pytest.mark.parametrize(
    ("channels", "grey"),
    [
        ((100, 100, 100), 100),
        ((100, 101, 101), 101),  # 100 2/3
        ((100, 100, 101), 100),  # 100 1/3
        ((96, 104, 100), 100),
        ((255, 255, 254), 255),
        ((0, 0, 8), 3),
        ((0, 8, 0), 3),
    ],
)
def test_thermal_is_the_mean_of_channels(root: Path, channels: tuple[int, ...], grey: int) -> None:
    # What a file is, is said by its contents: a PNG under this name keeps every level.
    write_png(root / "exact.png", np.full((*HW, 3), channels, np.uint8))
    (root / "exact.png").rename(image_path(root, TRAIN[0], "lwir"))
    thermal = KP(str(root)).read(TRAIN[0]).thermal
    assert thermal.shape == HW
    assert (thermal == grey).all()


def test_thermal_of_one_channel_and_in_colours(root: Path) -> None:
    path = image_path(root, TRAIN[0], "lwir")
    write_jpeg(path, contents(TRAIN[0])[1][..., None])
    grey = KP(str(root)).read(TRAIN[0]).thermal
    assert np.abs(grey.astype(int) - contents(TRAIN[0])[1]).max() <= 1
    image = np.full((*HW, 3), 100, np.uint8)
    image[3, 5] = (91, 100, 100)  # one pixel, nine levels apart
    write_png(root / "exact.png", image)
    (root / "exact.png").rename(path)
    with pytest.raises(InputError, match=r"lwir/I00050.jpg: .* within 8 levels, .* up to 9 levels"):
        KP(str(root)).read(TRAIN[0])
    write_jpeg(path, contents(TRAIN[0])[0])
    with pytest.raises(InputError, match="use the original file of the folder lwir"):
        KP(str(root)).read(TRAIN[0])


def test_void_is_ignored_and_nothing_else(root: Path) -> None:
    path = root / "labels" / f"{TRAIN[0]}.png"
    label = np.zeros(HW, np.uint8)
    label[0, :3] = (18, 19, 255)
    write_png(path, label)
    assert KP(str(root)).label(TRAIN[0])[0, :4].tolist() == [18, 255, 255, 0]
    label[0, 3] = 20
    write_png(path, label)
    with pytest.raises(InputError, match=r"labels/\S+: label value 20 is out of range; .* 0 to 19"):
        KP(str(root)).label(TRAIN[0])


def test_an_image_of_void_alone(root: Path) -> None:
    write_png(root / "labels" / f"{TRAIN[0]}.png", np.full(HW, 19, np.uint8))
    sample = KP(str(root)).read(TRAIN[0])
    assert sample.label is not None
    assert (sample.label == 255).all()


def test_refuses_sizes_that_differ(root: Path) -> None:
    write_png(root / "labels" / f"{TRAIN[0]}.png", np.zeros((16, 23), np.uint8))
    with pytest.raises(InputError, match="RGB is 16x24 pixels but its label is 16x23"):
        KP(str(root)).read(TRAIN[0])
    write_jpeg(image_path(root, TRAIN[0], "lwir"), np.zeros((8, 24, 3), np.uint8))
    with pytest.raises(InputError, match="RGB is 16x24 pixels but thermal is 8x24"):
        KP(str(root)).read(TRAIN[0])


def test_damaged_files_and_outside_links_are_refused(root: Path, tmp_path: Path) -> None:
    for path in KP(str(root)).files(TRAIN[0]):
        content = path.read_bytes()
        path.write_bytes(content[: len(content) // 2])
        with pytest.raises(InputError, match=f"{path} cannot be decoded, the file is cut short"):
            KP(str(root)).read(TRAIN[0])
        (tmp_path / path.name).write_bytes(content)
        path.unlink()
        path.symlink_to(tmp_path / path.name)
        with pytest.raises(InputError, match=f"{path} leads out of dataset.root"):
            KP(str(root)).read(TRAIN[0])
        path.unlink()
        path.write_bytes(content)
    assert KP(str(root)).read(TRAIN[0]).name == TRAIN[0]


def test_fingerprint(tmp_path: Path) -> None:
    one = write_lists(write_kp(tmp_path / "one"))
    other = write_lists(write_kp(tmp_path / "other"), ending="")
    expected = KP(str(one)).fingerprint()
    assert KP(str(other)).fingerprint() == expected
    assert KP(str(other), lists="sets").fingerprint() == expected  # the same names
    write_lists(other, {"test": TEST[1:]})
    assert KP(str(other)).fingerprint() != expected
    write_lists(other)
    image_path(other, TEST[0], "lwir").unlink()
    assert KP(str(other)).fingerprint() != expected


def test_refuses_a_wrong_root(root: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no folder '/nowhere'"):
        KP("/nowhere")
    for wrong in (tmp_path, root / "images"):
        with pytest.raises(InputError, match=rf"does not hold the folders images .* give {root}\."):
            KP(str(wrong))
    (tmp_path / "empty" / "deep").mkdir(parents=True)
    with pytest.raises(InputError, match="give the folder that does"):
        KP(str(tmp_path / "empty" / "deep"))
    with pytest.raises(InputError, match="num_classes is 20 but dataset.classes has 19"):
        KP(str(root), num_classes=20)


def test_configuration_repeats_the_defaults() -> None:
    node = yaml.safe_load((ROOT / "conf" / "dataset" / "kp.yaml").read_text())
    assert tuple(node["classes"]) == CLASSES
    assert tuple(map(tuple, node["palette"])) == PALETTE
    assert node["splits"] == SPLITS
    assert (node["num_classes"], node["lists"]) == (19, "auto")


@pytest.mark.skipif(not OFFICIAL.exists(), reason="reference material is not here")
def test_official_lists_are_those_by_set_number(tmp_path: Path) -> None:
    for folder in ("images", "labels"):
        (tmp_path / folder).mkdir()
    for path in OFFICIAL.glob("*.txt"):
        (tmp_path / path.name).write_text(path.read_text())
    listed = KP(str(tmp_path))
    for split in ("train", "val", "test"):
        for name in listed.names(split):
            (tmp_path / "labels" / f"{name}.png").touch()
    by_set = KP(str(tmp_path), lists="sets")
    sizes = {split: len(listed.names(split)) for split in SPLITS}
    assert sizes == {
        **{"train": 499, "train_day": 261, "train_night": 238},
        **{"val": 140, "val_day": 64, "val_night": 76},
        **{"test": 311, "test_day": 178, "test_night": 133},
    }
    for split in SPLITS:
        assert by_set.names(split) == listed.names(split)
    nights = {split: sum(listed.nights(listed.names(split))) for split in ("train", "val", "test")}
    assert nights == {"train": 238, "val": 76, "test": 133}
