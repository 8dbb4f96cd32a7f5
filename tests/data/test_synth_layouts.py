"""The four embedded data sets on disk: what their layouts share, then what is each one's own."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from omegaconf import OmegaConf

from rgbt.checks import InputError
from rgbt.config.component import Component, build
from rgbt.config.compose import compose
from rgbt.data.freiburg import CLASSES as FREIBURG_CLASSES
from rgbt.data.freiburg import Freiburg
from rgbt.data.kp import CLASSES as KP_CLASSES
from rgbt.data.kp import KP, set_of
from rgbt.data.mfnet import MFNet
from rgbt.data.pst900 import CLASSES as PST900_CLASSES
from rgbt.data.pst900 import PST900, bag_of
from rgbt.data.synth import cache, dataset, freiburg, kp, people, pst900, writer
from rgbt.data.synth.factors import EgoMotion, SceneFactors
from rgbt.data.synth.freiburg import counts_of, freiburg_ids, seen_in_thermal, synth_freiburg
from rgbt.data.synth.kp import VOID, kp_ids, synth_kp
from rgbt.data.synth.materials import INDEX, ids_in
from rgbt.data.synth.pst900 import CLASS_OF, synth_pst900
from rgbt.data.synth.scene import Scene, render_pair, render_scene
from rgbt.data.synth.shapes import BIKE, BUMP, CAR, CAR_STOP, COLOR_CONE, CURVE, GUARDRAIL, PERSON
from rgbt.data.synth.writer import Layout, Plan

NUMBERS = {"num_train": 6, "num_val": 2, "num_test": 5}
FREIBURG_NUMBERS = {"num_train_day": 10, "num_train_night": 6, "num_val": 2, "num_test": 5}
FREIBURG_FACTORS = SceneFactors(height=98, width=288, field_of_view_deg=96.0)


class Embedded(NamedTuple):
    """One of the data sets, at a small size."""

    layout: Layout
    make: Callable[..., Any]
    reader: Callable[[str], Any]
    numbers: dict[str, int]
    factors: SceneFactors

    @property
    def plan(self) -> Plan:
        return Plan(seed=0, numbers=self.numbers, factors=self.factors)

    def made(self, cache_dir: Path, **changes: Any) -> Any:
        hw = {"height": self.factors.height, "width": self.factors.width}
        return self.make(cache_dir=str(cache_dir), **{**self.numbers, **hw, **changes})


def embedded_freiburg(root: str) -> Freiburg:
    """The ordinary reader, with the sequence that the embedded data set holds out."""
    return Freiburg(root, crop=(1, 97, 48, 240), val_sequences=(freiburg.VAL_SEQUENCE,))


SMALL = SceneFactors(height=48, width=64)
EMBEDDED = {
    "synth": Embedded(dataset.LAYOUT, dataset.synth, MFNet, NUMBERS, SMALL),
    "synth_kp": Embedded(kp.LAYOUT, synth_kp, KP, NUMBERS, replace(SMALL, night_share=0.48)),
    "synth_pst900": Embedded(
        *(pst900.LAYOUT, synth_pst900, lambda root: PST900(root, val_bags=(20,)), NUMBERS),
        replace(SMALL, field_of_view_deg=80.0),
    ),
    "synth_freiburg": Embedded(
        *(freiburg.LAYOUT, synth_freiburg, embedded_freiburg),
        *(FREIBURG_NUMBERS, FREIBURG_FACTORS),
    ),
}


BACKGROUND = {
    "synth": ("unlabeled",),
    "synth_kp": (),
    "synth_pst900": ("background",),
    "synth_freiburg": ("background", "ignore"),
}


@pytest.mark.parametrize("name", BACKGROUND)
def test_background_is_that_of_the_real_data_set(folder: Path, name: str) -> None:
    """Class 0 of KP and of Freiburg is road. The YAML of the real data set states the same."""
    assert EMBEDDED[name].made(folder).background == BACKGROUND[name]
    real = name.removeprefix("synth").removeprefix("_") or "mfnet"
    stated = OmegaConf.load(f"conf/dataset/{real}.yaml").background
    assert tuple(stated) == BACKGROUND[name]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cache of all data sets, to be read alone."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(params=EMBEDDED)
def each(request: pytest.FixtureRequest) -> Embedded:
    return EMBEDDED[request.param]


# ---- what they share ------------------------------------------------------------------------


def test_ordinary_reader_reads_the_files(each: Embedded, folder: Path) -> None:
    data = each.made(folder)
    plain = each.reader(str(data.root))
    assert data.name == each.layout.name
    assert plain.fingerprint() == data.fingerprint()
    for key, number in each.numbers.items():
        names = plain.names(key.removeprefix("num_"))
        assert len(names) == number
        for name in names:
            sample, same = plain.read(name), data.read(name)
            assert np.array_equal(sample.rgb, same.rgb)
            assert (sample.label is None) == (key == "num_train_night")


def test_files_hold_the_scenes(each: Embedded, folder: Path) -> None:
    data = each.made(folder)
    own = Plan(seed=0, numbers=each.numbers, factors=each.factors)
    shots = each.layout.shots(own)
    assert [shot.scene for shot in shots] == list(range(sum(each.numbers.values())))
    ids: dict[str, Callable[[Scene], Any]] = {
        "synth": lambda scene: scene.label,
        "synth_kp": lambda scene: np.where(kp_ids(scene) == 19, 255, kp_ids(scene)),
        "synth_pst900": lambda scene: CLASS_OF[scene.label],
    }
    if data.name == "synth_freiburg":  # cut, see below
        return
    for shot in shots[::4]:
        scene = render_scene(0, shot.scene, each.factors)
        assert scene.is_night == shot.night
        sample = data.read(shot.name)
        assert np.array_equal(sample.label, ids[data.name](scene))
        if data.name == "synth_kp":  # JPEG loses a few grey levels, of colours more than of grey
            assert np.abs(sample.thermal.astype(int) - scene.thermal).mean() < 3
            assert np.abs(sample.rgb.mean((0, 1)) - scene.rgb.mean((0, 1))).max() < 1
        else:
            assert np.array_equal(sample.thermal, scene.thermal)
            assert np.array_equal(sample.rgb, scene.rgb)


def test_pool_writes_same_files(
    each: Embedded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone, pooled = tmp_path / "alone", tmp_path / "pooled"
    numbers = {key: 2 for key in each.numbers}
    for made in (alone, pooled):
        made.mkdir()
        each.layout.write(replace(each.plan, numbers=numbers), made)
        monkeypatch.setattr(writer, "_WORTH_A_POOL", 1)
    found = sorted(path.relative_to(alone) for path in alone.rglob("*.*"))
    assert found == sorted(path.relative_to(pooled) for path in pooled.rglob("*.*"))
    assert all((alone / path).read_bytes() == (pooled / path).read_bytes() for path in found)


def emptied(layout: Layout) -> Layout:
    return replace(layout, shots=lambda plan: [], lists=writer._no_lists)


def test_folder_is_named_by_plan_and_reused(each: Embedded, tmp_path: Path) -> None:
    empty, plan, key = emptied(each.layout), each.plan, next(iter(each.numbers))
    plans = [
        *(plan, plan, replace(plan, seed=4), replace(plan, numbers={**each.numbers, key: 3})),
        *(replace(plan, factors=replace(each.factors, rgb_noise=0.5)),),
        replace(plan, motion=EgoMotion(1.0)),
    ]
    written = [empty.cached(each, tmp_path) for each in plans]
    newer = {key: version + 1 for key, version in each.layout.versions.items()}
    written.append(replace(empty, versions=newer).cached(plan, tmp_path))
    assert len(set(written)) == 6
    assert all(path.name.startswith(f"{each.layout.name}-") for path in written)


def test_folders_of_existing_caches_stay_valid(tmp_path: Path) -> None:
    """Names hash the plan; another form of it would write every data set once more."""
    found = {}
    for name, each in EMBEDDED.items():
        found[name] = emptied(each.layout).cached(each.plan, tmp_path).name.split("-")[1]
    assert found == {
        "synth": "65eb4c748cae",
        "synth_kp": "ef0ea98cc8f0",
        "synth_pst900": "d4683b9effe1",
        "synth_freiburg": "8d0374868cd4",
    }


def test_yaml_has_every_setting_with_default(each: Embedded) -> None:
    name = each.layout.name
    node: Any = OmegaConf.to_container(compose([f"dataset={name}"]).dataset, resolve=True)
    assert node.pop("absent") == "released"
    assert node.pop("_target_") == f"{each.make.__module__}.{name}"
    defaults = {key: p.default for key, p in inspect.signature(each.make).parameters.items()}
    plain = {key: list(v) if isinstance(v, tuple) else v for key, v in defaults.items()}
    assert node == plain


def test_command_line_chooses_data_set(each: Embedded, folder: Path) -> None:
    hw = {"height": each.factors.height, "width": each.factors.width, "cache_dir": folder}
    words = [f"dataset.{key}={value}" for key, value in {**each.numbers, **hw}.items()]
    config = compose([f"dataset={each.layout.name}", *words])
    Component.from_node(config.dataset, "dataset")
    assert build(config.dataset).name == each.layout.name


# ---- synth ----------------------------------------------------------------------------------


def test_synth_lists_have_days_and_nights(folder: Path) -> None:
    root = EMBEDDED["synth"].made(folder).root
    lists = {path.stem: path.read_text().split() for path in root.glob("*.txt")}
    assert lists.keys() == {"train", "val", "test", "test_day", "test_night"}
    assert sorted(lists["test_day"] + lists["test_night"]) == lists["test"]
    assert {name[-1] for name in lists["test_day"]} <= {"D"}
    assert {name[-1] for name in lists["test_night"]} == {"N"}
    stored = cv2.imread(str(root / f"images/{lists['val'][0]}.png"), cv2.IMREAD_UNCHANGED)
    assert stored.shape == (48, 64, 4)


def test_second_frames_form_data_set(tmp_path: Path) -> None:
    moving = replace(EMBEDDED["synth"].plan, motion=EgoMotion(0.5, 1.0))
    dataset.LAYOUT.write(moving, tmp_path)
    name = dataset.LAYOUT.shots(moving)[8].name
    pair = render_pair(0, 8, moving.factors, EgoMotion(0.5, 1.0))
    stored = cv2.imread(str(tmp_path / "next/images" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(stored[..., 3], pair.second.thermal)
    flow = np.load(tmp_path / "next/flow" / f"{name}.npy")
    assert np.array_equal(np.isnan(flow[..., 0]), ~pair.visible)
    assert np.array_equal(flow[pair.visible], pair.flow[pair.visible])
    assert (tmp_path / "next/test.txt").read_text() == (tmp_path / "test.txt").read_text()


def test_one_test_scene_has_no_list_of_the_other_time(tmp_path: Path) -> None:
    data = dataset.synth(cache_dir=str(tmp_path), num_train=2, num_val=1, num_test=1)
    assert sum(data.has(f"test_{time}") for time in ("day", "night")) == 1
    assert data.fingerprint()


def test_interrupted_generation_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    each, real = EMBEDDED["synth"], writer.write_shot

    def interrupted(layout: Layout, plan: Plan, folder: Path, shot: Any) -> None:
        if shot.scene == 3:
            raise KeyboardInterrupt
        real(layout, plan, folder, shot)

    with monkeypatch.context() as patch:
        patch.setattr(writer, "write_shot", interrupted)
        with pytest.raises(KeyboardInterrupt):
            each.layout.cached(each.plan, tmp_path)
    assert list(tmp_path.iterdir()) == []
    assert (each.layout.cached(each.plan, tmp_path) / "test.txt").is_file()


def test_first_of_two_generations_is_kept(tmp_path: Path) -> None:
    other: list[Path] = []

    def write(folder: Path) -> None:
        other.append(cache.written_once("x", {"seed": 1}, tmp_path, lambda made: None))
        (other[0] / "first.txt").write_text("")

    assert cache.written_once("x", {"seed": 1}, tmp_path, write) == other[0]
    assert (other[0] / "first.txt").is_file()
    assert list(tmp_path.iterdir()) == other


def test_default_cache_follows_system(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert cache.default_cache() == Path("/somewhere/rgbt")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache.default_cache() == Path.home() / ".cache/rgbt"


@pytest.mark.parametrize(
    ("key", "value", "word"),
    [("ego_yaw_deg", 2.0, "ego_forward_m"), ("cache_dir", "{file}", "dataset.cache_dir")],
)
def test_synth_refuses_wrong_setting(tmp_path: Path, key: str, value: Any, word: str) -> None:
    file = tmp_path / "file"
    file.write_text("")
    settings = {"cache_dir": str(tmp_path), key: str(file) if value == "{file}" else value}
    with pytest.raises(InputError, match=word):
        dataset.synth(**settings)
    assert list(tmp_path.iterdir()) == [file]


# ---- synth_pst900 ---------------------------------------------------------------------------


def test_pst900_names_are_those_of_archive() -> None:
    shots = pst900.LAYOUT.shots(
        Plan(seed=0, numbers={"num_train": 57, "num_val": 3, "num_test": 10}, factors=SMALL)
    )
    assert shots[0].name == "0_bag01_rect_rgb_frame0000000000"
    assert shots[60].name == "60_bag21_rect_rgb_frame0000000600"
    assert [shot.folder for shot in shots] == ["train"] * 60 + ["test"] * 10
    # Three scenes of each of nineteen recordings, then the one that is held out.
    bags = [bag_of(shot.name) for shot in shots]
    assert bags[:60] == [bag for bag in range(1, 21) for _ in range(3)]
    assert set(bags[60:]) == {21, 22, 23, 24, 25}


def test_pst900_without_val_bags_trains_on_them(folder: Path) -> None:
    each = EMBEDDED["synth_pst900"]
    released = each.made(folder, val_bags=())
    assert released.root == each.made(folder).root
    assert len(released.names("train")) == 8
    assert released.names("val") == released.names("test")
    with pytest.raises(InputError, match=r"dataset.val_bags: .* has no bag 33"):
        each.made(folder, val_bags=(33,)).names("val")


def test_pst900_objects_are_present_and_rare() -> None:
    found = {label: PST900_CLASSES[CLASS_OF[label]] for label in (0, CAR, COLOR_CONE, CAR_STOP)}
    assert list(found.values()) == ["background", "background", "fire_extinguisher", "backpack"]
    assert [PST900_CLASSES[CLASS_OF[label]] for label in (BUMP, PERSON)] == [
        *("hand_drill", "survivor")
    ]
    factors = SceneFactors(width=214, field_of_view_deg=80.0)
    labels = [CLASS_OF[render_scene(0, index, factors).label].ravel() for index in range(16)]
    counts = np.array([np.bincount(label, minlength=5) for label in labels])
    shares = counts.sum(0) / counts.sum()
    assert 0.92 < shares[0] < 0.97
    assert ((shares[1:] > 0.004) & (shares[1:] < 0.03)).all()
    assert (counts > 0).mean(0).min() > 0.3


# ---- synth_kp -------------------------------------------------------------------------------


def test_kp_files_have_its_format(folder: Path) -> None:
    data = EMBEDDED["synth_kp"].made(folder)
    rgb, lwir, label = data.files(data.names("test")[0])
    assert [path.suffix for path in (rgb, lwir, label)] == [".jpg", ".jpg", ".png"]
    thermal = cv2.imread(str(lwir), cv2.IMREAD_UNCHANGED)
    assert thermal.shape == (48, 64, 3)
    assert (thermal == thermal[..., :1]).all()
    assert cv2.imread(str(label), cv2.IMREAD_UNCHANGED).max() == 19, "void is 19 on disk"
    assert (data.root / "val.txt").read_text().splitlines()[0].endswith(".png")
    for split in ("train", "val", "test"):
        # The lists say what the set numbers say, which is the split of the CRM release.
        assert data.names(split) == KP(str(data.root), lists="sets").names(split)


def test_kp_names_belong_to_recordings_of_split() -> None:
    numbers = {"num_train": 60, "num_val": 20, "num_test": 40}
    found: dict[str, set[int]] = {"train": set(), "val": set(), "test": set()}
    shots = kp.LAYOUT.shots(Plan(seed=3, numbers=numbers, factors=SMALL))
    for shot in shots:
        found[shot.split].add(set_of(shot.name))
        assert int(shot.name[-5:]) == shot.scene
        assert shot.name[6:10] == "V000"
    assert found == {"train": {0, 1, 2, 3, 4, 5}, "val": {6, 10}, "test": {7, 8, 9, 11}}


def test_kp_has_no_night_lists_without_nights(tmp_path: Path) -> None:
    days = EMBEDDED["synth_kp"].made(tmp_path, num_train=1, num_test=1, night_share=0.0)
    assert [days.has(f"test{time}") for time in ("", "_day")] == [True, True]
    assert not (days.root / "test_night.txt").exists()
    with pytest.raises(InputError, match="'test_night' of synth_kp is empty"):
        days.names("test_night")


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    return [render_scene(0, index, SceneFactors()) for index in range(12)]


def test_kp_rider_is_not_person(scenes: list[Scene]) -> None:
    persons = riders = 0
    for scene in scenes:
        ids = kp_ids(scene)
        person, rider = (ids == KP_CLASSES.index(name) for name in ("person", "rider"))
        assert np.array_equal(person | rider, scene.label == PERSON)
        shapes = {owner: scene.placed[owner].shape for owner in np.unique(scene.owner[person])}
        assert people.bike(True) not in shapes.values()
        for owner in np.unique(scene.owner[rider]):
            assert scene.placed[owner].shape is people.bike(True)
            # Where a rider is, the bicycle is the same object.
            assert {BIKE, PERSON} >= set(scene.label[scene.owner == owner].tolist())
        persons, riders = persons + person.any(), riders + rider.any()
    assert persons > 8
    assert riders > 3


def test_owner_is_object_except_ground_and_sky(scenes: list[Scene]) -> None:
    for scene in scenes[:3]:
        nobody = np.isinf(scene.depth) | np.isin(
            scene.material, [INDEX[name] for name in ("grass", "asphalt", "paving", "line")]
        )
        assert (scene.owner[nobody] == -1).all()
        assert (scene.owner[scene.label == CAR] >= 0).all()


def test_every_present_class_of_kp_is_frequent(scenes: list[Scene]) -> None:
    shown = np.zeros(20)
    for scene in scenes:
        shown += np.bincount(kp_ids(scene).ravel(), minlength=20) > 0
    absent = {"traffic_light", "truck", "bus", "train", "motorcycle"}
    assert {name for name, times in zip(KP_CLASSES, shown, strict=False) if not times} == absent
    assert shown[[n for n, name in enumerate(KP_CLASSES) if name not in absent]].min() >= 4
    assert shown[19] > 6


# ---- synth_freiburg -------------------------------------------------------------------------


def test_freiburg_frames_are_cut_scenes(folder: Path) -> None:
    data = EMBEDDED["synth_freiburg"].made(folder)
    scenes = [*data.names("train_day"), *data.names("train_night"), *data.names("val")]
    for index, name in enumerate([*scenes, *data.names("test")]):
        if index not in (0, 7, 12, 20, 22):
            continue
        night = data.nights((name,))[0]
        factors = replace(FREIBURG_FACTORS, night_share=float(night))
        scene = render_scene(0, index, factors)
        sample = data.read(name)
        assert sample.rgb.shape == (96, 192, 3)
        assert np.array_equal(sample.rgb, scene.rgb[1:97, 48:240])
        seen = seen_in_thermal(98, 288)[1:97, 48:240]
        # With the range of the scenes, counts become the grey levels that `synth` stores, but for
        # what rounding to counts first can change.
        apart = sample.thermal.astype(int) - scene.thermal[1:97, 48:240]
        assert np.abs(apart[seen]).max() <= 1
        assert not sample.thermal[~seen].any()
        if sample.label is not None:
            label = freiburg_ids(scene)[1:97, 48:240]
            label = np.where(seen, label, 255) if "test" in name else label
            assert np.array_equal(sample.label, label)


def test_freiburg_archive_peculiarities_are_reproduced(folder: Path) -> None:
    data = EMBEDDED["synth_freiburg"].made(folder)
    splits = ("train_day", "train_night", "val", "test")
    frames = [data.frame(name) for split in splits for name in data.names(split)]
    paths = [frame.label for frame in frames if frame.label is not None]
    labels = {path.parent.parent.relative_to(data.root).as_posix(): path for path in paths}
    sizes = {
        part: cv2.imread(str(path), cv2.IMREAD_UNCHANGED).shape
        for part, path in labels.items()
        if path.suffix == ".png"
    }
    assert sizes["train/seq_01_day/00"] == (196, 576)
    assert sizes["train/seq_00_day/00"] == (98, 288)
    folders = {path.name for path in (data.root / "test").glob("*/Images*")}
    assert folders == {"ImagesRGB", "ImagesIR", "ImagesRgb", "ImagesIr"}
    shorter = [f.thermal.stem.removesuffix("_ir") != f.values["stamp"] for f in frames[-5:]]
    assert shorter == [True] * 3 + [False] * 2
    counts = cv2.imread(str(frames[0].thermal), cv2.IMREAD_UNCHANGED)
    assert counts.dtype == np.uint16
    assert not counts[:, [0, 40, 250, 287]].any()
    assert counts[counts > 0].min() > 19_000
    assert counts.max() > 22_500
    # "ignore" is what only the RGB camera sees, in labels by hand.
    assert np.array_equal(np.load(labels["test/night"]) == 13, ~seen_in_thermal(98, 288))


def test_freiburg_scenes_are_in_one_split() -> None:
    shots = freiburg.LAYOUT.shots(EMBEDDED["synth_freiburg"].plan)
    assert len({shot.name for shot in shots}) == 23
    assert [shot.folder for shot in shots[:10:2]] == [
        *("train/seq_00_day/00", "train/seq_00_day/01", "train/seq_01_day/01"),
        *("train/seq_02_day/00", "train/seq_03_day/00"),
    ]
    assert [shot.night for shot in shots] == [False] * 10 + [True] * 6 + [False] * 5 + [True] * 2


def test_freiburg_classes_and_temperatures_occur_by_day_and_night(tmp_path: Path) -> None:
    numbers = {"num_train_day": 24, "num_train_night": 24, "num_val": 1, "num_test": 48}
    many = EMBEDDED["synth_freiburg"].made(tmp_path, **numbers)
    splits = ("train_day", "train_night", "test_day", "test_night")
    samples = {split: [many.read(name) for name in many.names(split)] for split in splits}
    for split in ("train_day", "test_day", "test_night"):
        labels = np.stack([sample.label for sample in samples[split]])
        shares = np.bincount(labels.ravel(), minlength=256) / labels.size
        assert (shares[:13] > 0.005).all(), split
        assert shares[0] > 0.15
        assert shares[8] > 0.05
    # Nights are darker but hardly colder.
    medians = [np.median([sample.rgb for sample in samples[split]]) for split in splits[:2]]
    assert medians[1] < 0.6 * medians[0]
    greys = [np.mean([sample.thermal for sample in samples[split]]) for split in splits[:2]]
    assert 0.6 * greys[0] < greys[1] < 1.1 * greys[0]
    # The range is used: the sky is cut, the rest is spread over the levels.
    grey = np.stack([sample.thermal for sample in samples["train_day"]])
    assert 0.05 < (grey == 0).mean() < 0.3
    assert np.quantile(grey, 0.999) > 150


def test_freiburg_sky_is_where_no_surface_is() -> None:
    for index in range(6):
        scene = render_scene(0, index, FREIBURG_FACTORS)
        sky = freiburg_ids(scene) == FREIBURG_CLASSES.index("sky")
        assert np.array_equal(sky, np.isinf(scene.depth))


def test_freiburg_counts_and_margins_by_hand() -> None:
    grey = np.array([[0.0, 1.0, 0.5, -0.5, 1.1]], np.float32)
    assert counts_of(grey).tolist() == [[21800, 23700, 22750, 20850, 23890]]
    seen = seen_in_thermal(98, 288)
    assert seen.sum(1).min() > 180
    assert len(set(seen.argmax(1))) > 3
    assert 0 < (~seen[1:97, 48:240]).mean() < 0.01


def test_freiburg_reader_gets_its_settings(folder: Path) -> None:
    each = EMBEDDED["synth_freiburg"]
    data, whole = each.made(folder), each.made(folder, crop=None, ignored_test=())
    assert whole.root == data.root
    assert whole.read(whole.names("test")[0]).label.max() == 13
    other, name = each.made(folder, thermal_range=(21800, 25000)), data.names("train")[0]
    assert other.read(name).thermal.mean() < 0.7 * data.read(name).thermal.mean()
    one = dict.fromkeys(("num_train_day", "num_train_night", "num_val"), 1) | {"num_test": 2}
    small = each.made(folder, **one, height=60)
    assert [len(small.names(s)) for s in ("train_day", "train_night", "val", "test")] == [
        1,
        1,
        1,
        2,
    ]
    with pytest.raises(InputError, match=r"frame is 60x288 pixels but dataset.crop=\[1, 97, 48"):
        small.read(small.names("train")[0])


# ---- classes --------------------------------------------------------------------------------

BY_HAND: dict[str, dict[str, list[tuple[int, str]]]] = {
    "kp": {
        "sky": [(0, "sky")],
        "road": [(0, "asphalt"), (0, "manhole"), (BUMP, "yellow")],
        "sidewalk": [(0, "paving"), (CURVE, "kerb_top")],
        "vegetation": [(0, "leaf"), (0, "bark")],
        "terrain": [(0, "grass")],
        "wall": [(0, "wall")],
        "building": [(0, "far_wall")],
        "pole": [(0, "pole")],
        "traffic_sign": [(0, "sign_red")],
        # A tyre is of the car or of the bike that it belongs to, a shoe of the person.
        "car": [(CAR, "tyre")],
        "bicycle": [(BIKE, "tyre")],
        "person": [(PERSON, "shoe")],
        "fence": [(GUARDRAIL, "rail_dark")],
        VOID: [(0, "wire"), (CAR_STOP, "yellow")],
    },
    "freiburg": {
        "sky": [(0, "sky")],
        "road": [(0, "asphalt"), (BUMP, "yellow")],
        "vegetation": [(0, "leaf"), (0, "bark")],
        "curb": [(CURVE, "kerb_top")],
        "car": [(CAR, "tyre")],
        "bicycle": [(BIKE, "tyre")],
        "person": [(PERSON, "shoe")],
        "building": [(0, "vent")],
        "pole": [(0, "transformer")],
    },
}


@pytest.mark.parametrize(
    ("module", "classes"),
    [(kp, (*KP_CLASSES, VOID)), (freiburg, FREIBURG_CLASSES)],
    ids=["kp", "freiburg"],
)
def test_classes_by_hand(module: Any, classes: Sequence[str]) -> None:
    for name, pairs in BY_HAND[module.__name__.rpartition(".")[2]].items():
        for label, material in pairs:
            found = ids_in(
                module.TABLE, np.array([[label]], np.uint8), np.array([[INDEX[material]]])
            )
            assert classes[found[0, 0]] == name
    named = [material for materials in module.OF_SCENERY.values() for material in materials]
    assert len(named) == len(set(named))
    assert set(named) <= set(INDEX)
