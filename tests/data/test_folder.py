"""Somebody's own data set, described by one YAML: its frames, splits, images and labels."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from rgbt.config.component import build
from rgbt.data.check import check_dataset
from rgbt.data.folder import draw_shares
from rgbt.data.images import grey
from rgbt.data.patterns import FrameFiles, Pattern, in_order
from tests.conftest import write_png
from tests.data.layouts import (
    CLASSES,
    HW,
    PATTERNS,
    PLAIN,
    RANGE,
    folder,
    listed,
    of_folder,
    refused,
    write_any,
    write_folder,
)

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_folder(tmp_path / "mine")


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same for tests that write nothing."""
    return write_folder(tmp_path_factory.mktemp("sound") / "mine")


def test_reads_what_the_patterns_name(sound: Path) -> None:
    node = OmegaConf.load(ROOT / "conf" / "dataset" / "folder.yaml")
    own = {"root": str(sound), "num_classes": 3, "classes": list(CLASSES), **PATTERNS}
    own |= {"thermal_range": list(RANGE), "ids": {0: "background", 1: "person", 2: "car"}}
    built = build(OmegaConf.create({"dataset": OmegaConf.merge(node, own)}).dataset)
    for dataset in (folder(sound), built):
        assert dataset.names("train") == ("train_1", "train_2", "train_3")
        assert dataset.splits["val"] == "val/rgb/{name}.png"
        sample = dataset.read("test_2")
        rgb, counts, label = of_folder("test_2")
        np.testing.assert_array_equal(sample.rgb, rgb)
        np.testing.assert_array_equal(sample.label, label)
        # Levels are 4000 / 255 counts wide; to the nearest one.
        exact = (counts.astype(float) - 20000) / 4000 * 255
        assert np.abs(sample.thermal - exact).max() <= 0.5 + 1e-9
        assert [sample.rgb.dtype, sample.thermal.dtype, sample.label.dtype] == [np.uint8] * 3


def test_grey_levels_by_hand() -> None:
    """255 (v - 100) / 200: 200 is 127.5, which goes up; 101 is 1.275 and 102 is 2.55."""
    expected = [0, 0, 1, 3, 128, 255, 255]
    for dtype in (np.uint16, np.int16, np.float32, np.float64):
        values = np.array([[0, 100, 101, 102, 200, 300, 999]], dtype)
        assert grey(values, (100, 300), Path("x")).tolist() == [expected]
    real = np.array([[19.99, 20.0, 25.0, 29.98, 30.5]], np.float32)
    assert grey(real, (20.0, 30.0), Path("x")).tolist() == [[0, 0, 128, 254, 255]]
    assert grey(np.array([[-5]], np.int16), (-10, 0), Path("x")).tolist() == [[128]]


def test_thermal_of_eight_bits(root: Path) -> None:
    level = np.arange(48, dtype=np.uint8).reshape(HW)
    for index in range(1, 4):
        write_any(root / "train" / "ir" / f"{index}_ir.tif", np.dstack([level] * 3))
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
    celsius[2, 3:5] = (np.nan, np.inf)
    write_any(path, celsius)
    said = refused(lambda: folder(root, thermal_range=(20, 30)).read("train_1"))
    assert f"{path}: 2 thermal values are NaN" in said


def test_packed_files(tmp_path: Path) -> None:
    image = np.arange(192, dtype=np.uint8).reshape(*HW, 4)
    for split in ("train", "val", "test"):
        write_png(tmp_path / split / "7.png", image)
        write_png(tmp_path / split / "7_mask.png", np.ones(HW, np.uint8))
    keys: dict[str, Any] = {
        "rgb": "{split}/{name}.png",
        "thermal": "{split}/{name}.png",
        "label": "{split}/{name}_mask.png",
        "thermal_range": None,
    }
    sample = folder(tmp_path, **keys).read("train_7")
    np.testing.assert_array_equal(sample.rgb, image[..., :3])
    np.testing.assert_array_equal(sample.thermal, image[..., 3])
    stretched = folder(tmp_path, **{**keys, "thermal_range": (0, 51)}).read("train_7").thermal
    np.testing.assert_array_equal(stretched, np.minimum(image[..., 3].astype(int) * 5, 255))
    write_png(tmp_path / "train" / "7.png", image[..., :3])
    assert "got 3; use the original" in refused(lambda: folder(tmp_path, **keys).read("train_7"))


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
    np.save(root / "train/ir/2.npy", np.zeros(48))
    assert "expected thermal values of shape (" in refused(lambda: dataset.read("train_2"))


def test_label_values(root: Path) -> None:
    path = root / "train" / "mask" / "1.png"
    label = np.zeros(HW, np.uint16)
    label[0, :5] = (7, 24, 26, 400, 255)
    write_png(path, label)
    ids = {0: "background", 24: "person", 26: "car", 400: "car"}
    dataset = folder(root, ids=ids, ignored=(7,))
    assert dataset.label("train_1")[0].tolist() == [255, 1, 2, 2, 255, 0, 0, 0]
    # 255 may be a class if the configuration says so.
    whole = folder(root, ids={**ids, 255: "person"}, ignored=(7,))
    assert whole.label("train_1")[0, 4] == 1
    label[1, :3] = (9, 9, 30)
    write_png(path, label)
    said = refused(lambda: dataset.label("train_1"))
    assert "label value 9 (2 pixels; one of 2 unknown values) has no class in dataset.ids" in said


def test_label_colours(root: Path) -> None:
    colours = {"background": (0, 0, 0), "person": (220, 20, 60), "car": ((0, 0, 142), (0, 0, 70))}
    image = np.zeros((*HW, 3), np.uint8)
    image[0, :4] = [(220, 20, 60), (0, 0, 142), (0, 0, 70), (255, 255, 255)]
    path = root / "train" / "mask" / "1.png"
    write_png(path, image)
    dataset = folder(root, colours=colours, ignored=((255, 255, 255),))
    assert dataset.label("train_1")[0].tolist() == [1, 2, 2, 255, 0, 0, 0, 0]
    assert dataset.palette == ((0, 0, 0), (220, 20, 60), (0, 0, 142))
    image[2, :3] = [(60, 20, 220), (60, 20, 220), (1, 2, 3)]
    write_png(path, image)
    said = refused(lambda: dataset.label("train_1"))
    assert "colour [60, 20, 220] (2 pixels; one of 2 unknown values)" in said


def test_unlabelled(root: Path) -> None:
    (root / "val" / "mask" / "1.png").unlink()
    dataset = folder(root, unlabelled=("val",))
    assert dataset.read("val_1").label is None
    assert dataset.label("val_1") is None
    assert len(dataset.files("val_1")) == 2
    assert dataset.read("test_1").label is not None
    assert folder(root, label=None).read("test_1").label is None


def test_words_of_a_pattern(tmp_path: Path) -> None:
    for name in (
        *("s1/rgb/a_b_7.png", "s1/rgb/a_b_x.jpg", "s1/rgb/._a_b_7.png", "s1/rgb/c.png"),
        *(".hidden/rgb/a_9.png", "x+y (1)/s1_7.png", "x+y (1)/x+y (1)_8.png"),
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    pattern = Pattern("{sequence}/rgb/{part}_{name}.png", "dataset.rgb")
    assert pattern.words == ("sequence", "part", "name")
    ((path, values),) = pattern.files(tmp_path).items()
    assert dict(values) == {"sequence": "s1", "part": "a_b", "name": "7"}
    assert path == pattern.path(tmp_path, values) == tmp_path / "s1" / "rgb" / "a_b_7.png"
    # A word that occurs twice; letters with a meaning in expressions.
    for text in ("{sequence}/{sequence}_{name}.png", "x+y (1)/x+y (1)_{name}.png"):
        (values,) = Pattern(text, "dataset.rgb").files(tmp_path).values()
        assert values["name"] == "8"


def test_order_of_names() -> None:
    names = ["f10", "f9", "f9_2", "f009", "e100", "f"]
    assert sorted(names, key=in_order) == ["e100", "f", "f009", "f9", "f9_2", "f10"]


def test_all_in_one_folder(tmp_path: Path) -> None:
    """What "{name}.png" matches besides: thermal images and labels of the frames themselves."""
    for name in ("train_9", "train_10", "val_1", "test_1"):
        write_png(tmp_path / f"{name}.png", np.zeros((*HW, 3), np.uint8))
        for kind in ("ir", "mask"):
            image = np.arange(48, dtype=np.uint8).reshape(HW) % 3
            write_png(tmp_path / f"{name}_{kind}.png", image)
    dataset = folder(
        tmp_path,
        rgb="{split}_{name}.png",
        thermal="{split}_{name}_ir.png",
        label="{split}_{name}_mask.png",
        thermal_range=None,
    )
    assert list(dataset.frames) == ["test_1", "train_9", "train_10", "val_1"]
    assert check_dataset(dataset).problems == ()


def test_files_of_one_name_and_folder_without_permission(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in ("a/b_c.png", "a_b/c.png"):
        write_png(root / path, np.zeros((*HW, 3), np.uint8))
    keys = {"thermal": "{sequence}/{name}.png", "label": None, "shares": {"train": 1.0}}
    assert refused(lambda: folder(root, rgb="{sequence}/{name}.png", **keys)) == (
        f"dataset.rgb: {root}/a/b_c.png and {root}/a_b/c.png would both be called 'a_b_c'; rename "
        "one of them."
    )
    closed = root / "val" / "rgb"
    monkeypatch.setattr("rgbt.data.patterns.os.access", lambda path, mode: path != closed)
    assert refused(lambda: folder(root)).startswith(f"{closed} cannot be listed: permission denied")


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"unlabelled": ("vall",)}, "dataset.unlabelled: 'vall' is not a valid choice"),
        ({"classes": ("car", "person", "car")}, "dataset.classes: a name occurs twice"),
        ({"night": "*dark*"}, "dataset.night: '*dark*' matches no name"),
        ({"thermal_range": (5, 5)}, "dataset.thermal_range: expected [low, high], got [5, 5]"),
        ({"ids": {0: "car"}, "colours": {"car": (0, 0, 0)}}, "dataset.ids and dataset.colours"),
        ({"ids": {0: "cars"}}, "dataset.ids: 'cars' is not a valid choice; did you mean 'car'"),
        ({"ids": {0: "car"}, "ignored": (0,)}, "dataset.ids: 0 occurs twice"),
        ({"colours": {"car": ((1, 2, 3), (1, 2, 3))}}, "dataset.colours: (1, 2, 3) occurs twice"),
        ({"colours": {"car": (1, 2, 3)}, "ignored": (255,)}, "dataset.ignored: 255 is no value"),
        ({"ignored": ((1, 2, 3),)}, "dataset.ignored: (1, 2, 3) is no value"),
        ({"colours": {}}, "expected the colour of every class, got none"),
        ({"rgb": "/rgb/{name}.png"}, "dataset.rgb: expected a path below dataset.root"),
        ({"rgb": "rgb/{name.png"}, "dataset.rgb: expected a path below dataset.root with words"),
        ({"rgb": "rgb/{sequence}{name}.png"}, "dataset.rgb: .* other text between them"),
        ({"rgb": "rgb/{frame}.png"}, "dataset.rgb: .* has no {name}"),
        ({"rgb": "{split}/rgb/{name}.jpg"}, "matches no file in .*, which holds test, train, val"),
        ({"thermal": "{split}/ir/{name}.tif"}, "dataset.thermal: .* but ir holds 1_ir.tif, 2_ir"),
        ({"thermal": "{split}/t/{name}.tif"}, "dataset.thermal: .* but test holds ir"),
        ({"thermal": "{scene}/ir/{name}.tif"}, "dataset.thermal: .* 'scene' is not a valid choice"),
        ({"label": "test/mask/{name}.png"}, "several frames would share .*test/mask/1.png"),
        ({"lists": {"train": "a.txt"}}, "got {split} in dataset.rgb and dataset.lists"),
        (PLAIN, "must define the splits, got none"),
        ({"folders": {"train": "train"}, **PLAIN}, "exactly one of .* must define the splits"),
        ({"shares": {"train": 0.5, "val": 0.4}, **PLAIN}, "dataset.shares: expected shares above"),
        (
            {"shares": {"train": 0.5, "val": 0.5}, **PLAIN},
            "split 'val' gets no frame, .* in 1 unit",
        ),
    ],
)
def test_wrong_descriptions_are_refused(sound: Path, keys: dict[str, Any], said: str) -> None:
    sentence = refused(lambda: folder(sound, **keys))
    wanted = re.escape(said).replace(r"\.\*", ".*")
    assert re.search(wanted, sentence), sentence


def test_lines_of_a_list(root: Path, tmp_path: Path) -> None:
    """The name, its words, the path of the image, each with or without suffix; in this order."""
    lines = ("test_2", "train/3", "train/rgb/1.png", "val/rgb/1", "train_2.png", "test/1.png")
    dataset = listed(root, *lines)
    names = ("test_2", "train_3", "train_1", "val_1", "train_2", "test_1")
    assert dataset.names("train") == names
    assert (dataset.has("train"), dataset.has("val")) == (True, False)
    assert "is empty: expected val.txt in" in refused(lambda: dataset.names("val"))
    (tmp_path / "mine.txt").write_text("test_1\n")
    dataset = listed(root, "train_1", lists={"train": str(tmp_path / "mine.txt")})
    assert dataset.names("train") == ("test_1",)
    # {name} alone will do where it is the name of one frame; 1 is that of three.
    dataset = listed(root, "3", "1")
    assert dataset.names("train") == ("train_3", "1")
    assert "has no frame called '1': there is no such RGB" in refused(lambda: dataset.read("1"))
    said = refused(lambda: listed(root, "frame_1 label_1", "x").names("train"))
    assert "dataset.lists.train: none of the 2 lines of list.txt is a frame." in said


def frames_of(*paths: str) -> dict[str, FrameFiles]:
    """Frames of {sequence}/{name}, or {camera}/{sequence}/{name}; nothing is on the disk."""
    words = ("camera", "sequence", "name")
    frames = {}
    for path in paths:
        pieces = path.split("/")
        values = dict(zip(words[-len(pieces) :], pieces, strict=True))
        name = "_".join(pieces)
        frames[name] = FrameFiles(name, values, Path(path), Path(path), None)
    return frames


def drawn(frames: dict[str, FrameFiles], **keys: Any) -> dict[str, tuple[str, ...]]:
    shares = {"train": 0.5, "val": 0.25, "test": 0.25}
    return draw_shares(frames, **{"shares": shares, "seed": 0, "block": None, **keys})


def test_shares_of_sequences() -> None:
    frames = frames_of(*(f"s{index}/{number}" for index in range(8) for number in range(3)))
    parts = drawn(frames)
    assert [len(parts[split]) for split in ("train", "val", "test")] == [12, 6, 6]
    assert sorted(sum(parts.values(), ())) == sorted(frames)
    sequences = [{name.split("_")[0] for name in names} for names in parts.values()]
    assert sum(map(len, sequences)) == len(set.union(*sequences)) == 8
    assert drawn(frames) == parts
    assert len({drawn(frames, seed=seed)["val"] for seed in range(6)}) > 1


def test_shares_of_blocks() -> None:
    parts = drawn(frames_of(*(f"s/{number}" for number in range(22))), block=5)
    blocks = [
        {f"s_{number}" for number in range(start, min(start + 5, 22))} for start in range(0, 22, 5)
    ]
    assert sum(map(len, parts.values())) == 22
    for names in parts.values():
        assert set(names) == set().union(*(block for block in blocks if block & set(names)))
        assert list(names) == sorted(names, key=in_order)


def test_shares_keep_cameras_of_one_moment_together() -> None:
    sides = ("left", "right")
    frames = frames_of(*(f"{side}/s/{number}" for side in sides for number in range(1, 7)))
    for names in drawn(frames, block=4, shares={"train": 0.4, "val": 0.3, "test": 0.3}).values():
        moments = [name.rpartition("_")[2] for name in names]
        assert len(moments) == 4
        assert sorted(moments[:2]) == sorted(moments[2:])  # left before right


def test_splits_by_folder_and_by_shares_of_a_folder(sound: Path) -> None:
    dataset = folder(sound, folders={"train": "train", "val": "test", "test": "test"})
    assert dataset.names("val") == dataset.names("test") == ("test_1", "test_2")
    # Two splits that are declared as one are valid.
    assert not any("share" in line for line in check_dataset(dataset).problems)
    missing = folder(sound, folders={"train": "training", "test": "test"})
    assert (missing.has("train"), missing.has("test")) == (False, True)
    assert "expected training/rgb/{name}.png in" in refused(lambda: missing.names("train"))
    # Without the word {sequence} the whole folder is one.
    drawn = folder(sound, **PLAIN, shares={"train": 0.5, "val": 0.5}, block=2)
    assert len(drawn.names("train")) == 4


def test_fingerprint_is_of_label_values_too(sound: Path) -> None:
    ids = {0: "car", 1: "person", 2: "car"}
    first = folder(sound)
    assert folder(sound, night="*1").fingerprint() == first.fingerprint()
    for changed in ({"ids": ids}, {"folders": {"train": "train"}}):
        assert folder(sound, **changed).fingerprint() != first.fingerprint()
    changes = ({"thermal_range": (1, 2)}, {"ids": ids}, {"colours": {"car": (0, 0, 1)}})
    others = [folder(sound, **changed) for changed in changes]
    assert len({repr(dataset.decoding()) for dataset in (first, *others)}) == 4


def test_check_of_own_data(root: Path) -> None:
    report = check_dataset(folder(root, night="*_2"))
    assert report.problems == ()
    assert (report.splits["train"].day, report.splits["train"].night) == (2, 1)
    assert report.notes[-1].startswith("split val has no night images")
    (root / "test" / "rgb" / "2.png").unlink()
    (root / "val.txt").write_text("val_1\n")
    report = check_dataset(listed(root, "train_1", "lost_1"))
    assert list(report.problems) == [
        f"folder ({root}) has no frame called 'lost_1': there is no such RGB image "
        "(dataset.rgb='{part}/rgb/{name}.png').",
        f"2 files belong to no image of a split; the first is {root}/test/ir/2_ir.tif.",
    ]
    assert report.notes[0] == "3 frames are in no split; the first is 'test_1'."
