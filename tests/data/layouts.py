"""Small data sets in every layout, with contents that follow from the names."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.file_dataset import FileDataset
from rgbt.data.folder import Folder
from rgbt.data.freiburg import Freiburg
from rgbt.data.kp import KP
from rgbt.data.mfnet import MFNet
from rgbt.data.pst900 import PST900
from rgbt.data.video import MVSeg, Video
from rgbt.randomness import numpy_generator
from tests.conftest import write_data, write_png

Images = tuple[np.ndarray, np.ndarray, np.ndarray]


def refused(make: Callable[[], object]) -> str:
    """The one sentence of the InputError that `make` raises."""
    with pytest.raises(InputError) as caught:
        make()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def contents(
    name: str,
    hw: tuple[int, int],
    num_classes: int,
    levels: tuple[int, int] = (0, 256),
    dtype: type = np.uint8,
) -> Images:
    """RGB, thermal and label of a name."""
    rng = numpy_generator(0, name)
    rgb = rng.integers(0, 256, (*hw, 3), dtype=np.uint8)
    thermal = rng.integers(*levels, hw, dtype=dtype)
    return rgb, thermal, rng.integers(0, num_classes, hw, dtype=np.uint8)


def write_any(path: Path, image: np.ndarray) -> None:
    """A grey image at its own depth, in the format that the name says, or an array."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, image)
    else:
        assert cv2.imwrite(str(path), image)


HW = (6, 8)
CLASSES = ("background", "person", "car")
RANGE = (20000, 24000)
PATTERNS = {
    "rgb": "{split}/rgb/{name}.png",
    "thermal": "{split}/ir/{name}_ir.tif",
    "label": "{split}/mask/{name}.png",
}
PLAIN = {key: text.replace("{split}", "{part}") for key, text in PATTERNS.items()}
of_folder = partial(contents, hw=HW, num_classes=3, levels=RANGE, dtype=np.uint16)


def write_frame(root: Path, split: str, name: str) -> None:
    """The three files of one frame."""
    rgb, counts, label = of_folder(f"{split}_{name}")
    write_png(root / split / "rgb" / f"{name}.png", rgb)
    write_any(root / split / "ir" / f"{name}_ir.tif", counts)
    write_png(root / split / "mask" / f"{name}.png", label)


def write_folder(root: Path) -> Path:
    """Frames 1, 2, ... of every split, in folders by split."""
    for split, number in {"train": 3, "val": 1, "test": 2}.items():
        for index in range(number):
            write_frame(root, split, str(index + 1))
    return root


def folder(root: Path, **keys: Any) -> Folder:
    """The reader of what `write_folder` writes."""
    values = {**PATTERNS, "num_classes": 3, "classes": CLASSES, "thermal_range": RANGE, **keys}
    return Folder(str(root), **values)


def listed(root: Path, *lines: str, **keys: Any) -> Folder:
    """The reader of what `write_folder` writes, its split "train" being these lines."""
    (root / "list.txt").write_text("\n".join(lines))
    return folder(root, **{**PLAIN, "lists": {"train": "list.txt", "val": "val.txt"}, **keys})


FREIBURG_HW = (13, 26)
CROP = (1, 12, 5, 23)
SEQUENCES = {"seq_00_day/00": 2, "seq_00_day/01": 1, "seq_04_day/00": 2, "seq_00_night/00": 3}
FOLDERS = ("ImagesRGB", "ImagesIR", "SegmentationClass")
COUNTS: dict[str, Any] = {"levels": (21000, 25000), "dtype": np.uint16}
of_freiburg = partial(contents, hw=FREIBURG_HW, num_classes=14, **COUNTS)


def write_training(root: Path, piece: str, stamp: str) -> None:
    """One frame of a training sequence; those at night get no label."""
    for kind, image in zip(("rgb", "ir_aligned", "rgb_labels"), of_freiburg(stamp), strict=True):
        if "night" not in piece or kind != "rgb_labels":
            write_png(root / "train" / piece / f"fl_{kind}" / f"fl_{kind}_{stamp}.png", image)


def write_test(
    root: Path, time: str, stamp: str, *, thermal: str = "", folders: tuple[str, ...] = FOLDERS
) -> None:
    """One frame of the test part; `thermal` is the stamp of its thermal image."""
    rgb, counts, label = of_freiburg(stamp)
    names = (f"{stamp}_rgb.png", f"{thermal or stamp}_ir.png", f"{stamp}_rgb.npy")
    paths = [root / "test" / time / f / name for f, name in zip(folders, names, strict=True)]
    write_png(paths[0], rgb)
    write_png(paths[1], counts)
    write_any(paths[2], label.astype(np.int64))


def write_freiburg(root: Path) -> Path:
    """Three day frames to train on and two to validate on, three at night, four to test on."""
    frames = [(piece, write_training) for piece, count in SEQUENCES.items() for _ in range(count)]
    frames += [(time, write_test) for time in ("day", "day", "night", "night")]
    for number, (place, write) in enumerate(frames):
        write(root, place, f"{1570 + number}_{number:03d}0")
    return root


def freiburg(root: Path, **keys: Any) -> Freiburg:
    """The reader of what `write_freiburg` writes, with one day sequence held out as "val"."""
    return Freiburg(str(root), **{"crop": CROP, "val_sequences": ("seq_04_day",), **keys})


KP_HW = (16, 24)
TRAIN = ("set00_V000_I00050", "set02_V004_I01640", "set03_V001_I00117")
VAL = ("set06_V000_I00253", "set10_V001_I00130")
TEST = ("set07_V000_I00050", "set08_V002_I02488", "set09_V000_I00184", "set11_V001_I01512")


def of_kp(name: str) -> Images:
    """The label as on disk, the images constant in 8x8 pixels: JPEG keeps them to two levels."""
    rgb, thermal, _ = contents(name, (2, 3), 20)
    blocks = tuple(np.indices(KP_HW) // 8)
    return rgb[blocks], thermal[blocks], contents(name, KP_HW, 20)[2]


def write_jpeg(path: Path, rgb: np.ndarray) -> None:
    """At the best quality and with all of its colour, so that it can be compared."""
    path.parent.mkdir(parents=True, exist_ok=True)
    best = [cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111]
    assert cv2.imwrite(str(path), np.ascontiguousarray(rgb[..., ::-1]), best)


def kp_image(root: Path, name: str, kind: str) -> Path:
    """Of "visible" or "lwir"."""
    recording, video, frame = name.split("_")
    return root / "images" / recording / video / kind / f"{frame}.jpg"


def write_kp(root: Path, names: Iterable[str] = (*TRAIN, *VAL, *TEST)) -> Path:
    """Images and labels as the CRM release has them, without lists."""
    for name in names:
        rgb, thermal, label = of_kp(name)
        write_jpeg(kp_image(root, name, "visible"), rgb)
        write_jpeg(kp_image(root, name, "lwir"), np.dstack([thermal] * 3))
        write_png(root / "labels" / f"{name}.png", label)
    return root


def write_lists(root: Path) -> Path:
    """Lists alone, with the ending that the CRM release has in them."""
    for split, names in {"train": TRAIN, "val": VAL, "test": TEST}.items():
        (root / f"{split}.txt").write_text("".join(f"{name}.png\n" for name in names))
    return root


BAGS = ("10_bag1_rect_rgb_frame0000000001", "11_bag1_rect_rgb_frame0000000009", "7_bag12_rect_f1")
BAGS_TEST = ("58_bag21_rect_rgb_frame0000000440", "3_bag25_rect_rgb_frame0000000002")
of_pst900 = partial(contents, hw=(9, 16), num_classes=5)


def write_triple(folder: Path, name: str) -> None:
    """One name into folder/rgb, folder/thermal and folder/labels."""
    for kind, image in zip(("rgb", "thermal", "labels"), of_pst900(name), strict=True):
        write_png(folder / kind / f"{name}.png", image)


def write_pst900(root: Path) -> Path:
    """The archive: train and test in folders, and what else it holds of one image."""
    for part, names in (("train", BAGS), ("test", BAGS_TEST)):
        for name in names:
            write_triple(root / part, name)
    for kind in ("thermal_raw", "depth"):
        write_png(root / "train" / kind / f"{BAGS[0]}.png", np.full((9, 16), 30000, np.uint16))
    return root


MVSEG = {"train": ("a", "b"), "val": ("c",), "test": ("d", "n"), "test_night": ("n",)}
of_mvseg = partial(contents, hw=(32, 48), num_classes=26)
of_video = partial(contents, hw=(32, 48), num_classes=3)


def write_mvseg(root: Path) -> Path:
    """Five videos of four frames, of which the second and the last are labelled."""
    for split, videos in MVSEG.items():
        for video in videos:
            for number in (236, 237, 238, 239):
                stem, folder = f"{number:05d}", root / "data" / video
                rgb, thermal, label = of_mvseg(f"{video}_{stem}")
                write_png(folder / "visible" / f"{stem}v.png", rgb)
                write_png(folder / "infrared" / f"{stem}i.png", np.dstack([thermal] * 3))
                if number % 2:
                    write_png(folder / "label" / f"{stem}l.png", label)
        (root / f"{split}.txt").write_text("\n".join(videos) + "\n")
    return root


def write_videos(root: Path) -> Path:
    """Videos x and y; the second frame of each is labelled."""
    for video, numbers in {"x": (1, 2, 3), "y": (8, 9, 10)}.items():
        for number in numbers:
            kinds = ("rgb", "ir", "label")[: 3 if number == numbers[1] else 2]
            for kind, image in zip(kinds, of_video(f"{video}_{number}"), strict=False):
                write_png(root / video / kind / f"{number}.png", image)
    for split in ("train", "val", "test"):
        (root / f"{split}.txt").write_text("x\ny\n" if split == "test" else "x\n")
    return root


def video(root: Path, **keys: Any) -> Video:
    """The reader of what `write_videos` writes."""
    settings: dict[str, Any] = {
        "num_classes": 3,
        "classes": CLASSES,
        "rgb": "{video}/rgb/{name}.png",
        "thermal": "{video}/ir/{name}.png",
        "label": "{video}/label/{name}.png",
        "lists": {split: f"{split}.txt" for split in ("train", "val", "test")},
    }
    return Video(str(root), **(settings | keys))


class Kind(NamedTuple):
    """A data set: its reader, and what writes it."""

    make: Callable[[Path], FileDataset]
    write: Callable[[Path], Path]
    is_listed: bool = False  # whether folders say which frames there are
    is_sparse: bool = False  # whether frames may lack their label


def _mfnet(root: Path, layout: str) -> Path:
    names = {"train": ["00001D", "00002N"], "val": ["00003D"], "test": ["00004N"]}
    return write_data(root, names, (12, 16), layout)


KINDS = {
    "mfnet packed": Kind(lambda root: MFNet(str(root)), lambda root: _mfnet(root, "packed")),
    "mfnet folders": Kind(lambda root: MFNet(str(root)), lambda root: _mfnet(root, "folders")),
    "freiburg": Kind(freiburg, write_freiburg, is_listed=True),
    "pst900": Kind(lambda root: PST900(str(root)), write_pst900, is_listed=True),
    "kp": Kind(lambda root: KP(str(root)), lambda root: write_lists(write_kp(root))),
    "folder": Kind(folder, write_folder, is_listed=True),
    "mvseg": Kind(lambda root: MVSeg(str(root)), write_mvseg, is_listed=True, is_sparse=True),
    "video": Kind(video, write_videos, is_listed=True, is_sparse=True),
}
