from __future__ import annotations

import inspect
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from omegaconf import OmegaConf

from rgbt.checks import InputError
from rgbt.config.component import Component, build
from rgbt.config.compose import compose
from rgbt.data.freiburg import CLASSES, Freiburg
from rgbt.data.synth import freiburg
from rgbt.data.synth.classes import FREIBURG_BY_LABEL, FREIBURG_OF_SCENERY, freiburg_ids
from rgbt.data.synth.factors import SceneFactors
from rgbt.data.synth.freiburg import cached, synth_freiburg
from rgbt.data.synth.freiburg_writer import FreiburgPlan, counts_of, seen_in_thermal, write
from rgbt.data.synth.materials import INDEX
from rgbt.data.synth.scene import render_scene
from rgbt.data.synth.shapes import BIKE, BUMP, CAR, CURVE, PERSON

FACTORS = SceneFactors(height=98, width=288, field_of_view_deg=96.0)
SMALL = {"num_train_day": 10, "num_train_night": 6, "num_val": 2, "num_test": 5}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Freiburg:
    """To be read alone."""
    return synth_freiburg(cache_dir=str(tmp_path_factory.mktemp("cache")), **SMALL)


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> Freiburg:
    numbers = {"num_train_day": 24, "num_train_night": 24, "num_val": 1, "num_test": 48}
    return synth_freiburg(cache_dir=str(tmp_path_factory.mktemp("cache")), **numbers)


def plan(**changes: object) -> FreiburgPlan:
    return replace(FreiburgPlan(seed=3, **SMALL, factors=FACTORS), **changes)


# ---- on disk --------------------------------------------------------------------------------


def test_the_ordinary_reader_reads_it(data: Freiburg) -> None:
    plain = Freiburg(str(data.root), crop=(1, 97, 48, 240))
    sizes = {split: len(plain.names(split)) for split in plain.splits}
    assert sizes == {
        **{"train": 10, "train_day": 10, "train_night": 6, "val": 2},
        **{"test": 5, "test_day": 3, "test_night": 2},
    }
    assert plain.fingerprint() == data.fingerprint()
    for split in ("train_day", "train_night", "val", "test"):
        for name in plain.names(split):
            sample, same = plain.read(name), data.read(name)
            assert sample.rgb.shape == (96, 192, 3)
            assert sample.thermal.shape == (96, 192)
            assert (sample.label is None) == (split == "train_night")
            assert np.array_equal(sample.rgb, same.rgb)


def test_files_hold_the_scenes(data: Freiburg) -> None:
    scenes = [*data.names("train_day"), *data.names("train_night"), *data.names("val")]
    for index, name in enumerate([*scenes, *data.names("test")]):
        if index not in (0, 7, 12, 20, 22):
            continue
        night = data.nights((name,))[0]
        scene = render_scene(0, index, replace(FACTORS, night_share=float(night)))
        assert scene.is_night == night
        sample = data.read(name)
        assert np.array_equal(sample.rgb, scene.rgb[1:97, 48:240])
        seen = seen_in_thermal(98, 288)[1:97, 48:240]
        # With the range of the scenes, counts become the grey levels that `synth` stores, but for
        # what rounding to counts first can change.
        apart = sample.thermal.astype(int) - scene.thermal[1:97, 48:240]
        assert np.abs(apart[seen]).max() <= 1
        assert not sample.thermal[~seen].any()
        if sample.label is not None:
            label = freiburg_ids(scene.label, scene.material)[1:97, 48:240]
            label = np.where(seen, label, 255) if "test" in name else label
            assert np.array_equal(sample.label, label)


def test_archive_peculiarities_are_reproduced(data: Freiburg) -> None:
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
    assert np.load(labels["test/day"]).shape == (98, 288)
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
    hand = np.load(labels["test/night"])
    assert np.array_equal(hand == 13, ~seen_in_thermal(98, 288))
    teacher = cv2.imread(str(labels["train/seq_00_day/00"]), cv2.IMREAD_UNCHANGED)
    assert teacher.max() <= 12


def test_no_scene_is_in_two_splits() -> None:
    shots = plan().shots()
    assert [shot.scene for shot in shots] == list(range(23))
    assert len({shot.stamp for shot in shots}) == 23
    assert [shot.part for shot in shots[:10:2]] == [
        *("train/seq_00_day/00", "train/seq_00_day/01", "train/seq_01_day/01"),
        *("train/seq_02_day/00", "train/seq_03_day/00"),
    ]
    assert sum(shot.night for shot in shots) == 8


def test_equal_plans_give_equal_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alone, pooled = tmp_path / "alone", tmp_path / "pooled"
    for folder in (alone, pooled):
        folder.mkdir()
        write(plan(num_train_day=2), folder)
        monkeypatch.setattr("rgbt.data.synth.writer._WORTH_A_POOL", 1)
    found = sorted(path.relative_to(alone) for path in alone.rglob("*.*"))
    assert len(found) == 2 * 3 + 6 * 2 + 2 * 3 + 5 * 3
    assert found == sorted(path.relative_to(pooled) for path in pooled.rglob("*.*"))
    assert all((alone / path).read_bytes() == (pooled / path).read_bytes() for path in found)


def test_folder_is_reused_and_named_by_plan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = plan(num_train_day=1, num_train_night=1, num_val=1, num_test=2)
    folder = cached(small, tmp_path)
    assert folder.name.startswith("synth_freiburg-")
    monkeypatch.setattr(freiburg, "write", lambda *_: None)
    assert cached(small, tmp_path) == folder
    others = [replace(small, seed=4), replace(small, num_test=3)]
    others.append(replace(small, factors=replace(FACTORS, rgb_noise=0.5)))
    assert len({cached(other, tmp_path) for other in [small, *others]}) == 4
    monkeypatch.setattr(freiburg, "VERSION", freiburg.VERSION + 1)
    assert cached(small, tmp_path) != folder


# ---- scenes ---------------------------------------------------------------------------------


def test_every_class_occurs_by_day_and_night(many: Freiburg) -> None:
    for split in ("train_day", "test_day", "test_night"):
        labels = np.stack([many.read(name).label for name in many.names(split)])
        shares = np.bincount(labels.ravel(), minlength=256) / labels.size
        assert (shares[:13] > 0.005).all(), split
        assert shares[0] > 0.15
        assert shares[8] > 0.05


def test_nights_are_darker_but_hardly_colder(many: Freiburg) -> None:
    day, night = (
        [many.read(name) for name in many.names(split)] for split in ("train_day", "train_night")
    )
    medians = [np.median([sample.rgb for sample in samples]) for samples in (day, night)]
    assert medians[1] < 0.6 * medians[0]
    greys = [np.mean([sample.thermal for sample in samples]) for samples in (day, night)]
    assert 0.6 * greys[0] < greys[1] < 1.1 * greys[0]
    # The range is used: the sky is cut, the rest is spread over the levels.
    grey = np.stack([sample.thermal for sample in day])
    assert 0.05 < (grey == 0).mean() < 0.3
    assert np.quantile(grey, 0.999) > 150


def test_sky_is_where_no_surface_is() -> None:
    for index in range(6):
        scene = render_scene(0, index, FACTORS)
        ids = freiburg_ids(scene.label, scene.material)
        assert np.array_equal(ids == CLASSES.index("sky"), np.isinf(scene.depth))


def test_classes_by_hand() -> None:
    def ids(label: int, material: str) -> str:
        found = freiburg_ids(np.array([[label]], np.uint8), np.array([[INDEX[material]]]))
        return CLASSES[found[0, 0]]

    assert ids(0, "sky") == "sky"
    assert ids(0, "asphalt") == ids(BUMP, "yellow") == "road"
    assert ids(0, "leaf") == ids(0, "bark") == "vegetation"
    assert ids(CURVE, "kerb_top") == "curb"
    # A tyre is of the car or of the bike that it belongs to, a shoe of the person.
    assert [ids(CAR, "tyre"), ids(BIKE, "tyre"), ids(PERSON, "shoe")] == [
        "car",
        "bicycle",
        "person",
    ]
    assert ids(0, "vent") == "building"
    assert ids(0, "transformer") == "pole"


def test_every_label_and_material_has_one_class() -> None:
    assert sorted(FREIBURG_BY_LABEL) == list(range(1, 9))
    named = [material for materials in FREIBURG_OF_SCENERY.values() for material in materials]
    assert len(named) == len(set(named))
    assert set(named) <= set(INDEX)
    assert set(FREIBURG_OF_SCENERY) | set(FREIBURG_BY_LABEL.values()) == set(CLASSES) - {"ignore"}


def test_counts_by_hand() -> None:
    grey = np.array([[0.0, 1.0, 0.5, -0.5, 1.1]], np.float32)
    assert counts_of(grey).tolist() == [[21800, 23700, 22750, 20850, 23890]]


def test_margins_reach_into_crop() -> None:
    seen = seen_in_thermal(98, 288)
    assert seen.sum(1).min() > 180
    assert len(set(seen.argmax(1))) > 3
    missing = ~seen[1:97, 48:240]
    assert 0 < missing.mean() < 0.01


# ---- settings -------------------------------------------------------------------------------


def test_reader_gets_its_settings(data: Freiburg) -> None:
    cache = str(data.root.parent)
    whole = synth_freiburg(cache_dir=cache, **SMALL, crop=None, ignored_test=())
    assert whole.root == data.root
    assert whole.read(whole.names("test")[0]).label.max() == 13
    other = synth_freiburg(cache_dir=cache, **SMALL, thermal_range=(21800, 25000))
    name = other.names("train")[0]
    assert other.read(name).thermal.mean() < 0.7 * data.read(name).thermal.mean()
    small = synth_freiburg(cache_dir=cache, **SMALL, height=60)
    with pytest.raises(InputError, match=r"frame is 60x288 pixels but dataset.crop=\[1, 97, 48"):
        small.read(small.names("train")[0])


def test_yaml_has_every_setting_with_default() -> None:
    node = OmegaConf.to_container(compose(["dataset=synth_freiburg"]).dataset, resolve=True)
    assert node.pop("absent") == "released"
    assert node.pop("_target_") == "rgbt.data.synth.freiburg.synth_freiburg"
    parameters = inspect.signature(synth_freiburg).parameters
    defaults = {name: parameter.default for name, parameter in parameters.items()}
    assert node == {
        key: list(value) if isinstance(value, tuple) else value for key, value in defaults.items()
    }


def test_data_set_is_chosen_on_command_line(tmp_path: Path) -> None:
    words = [f"dataset.{key}={value}" for key, value in SMALL.items()]
    config = compose(["dataset=synth_freiburg", f"dataset.cache_dir={tmp_path}", *words])
    Component.from_node(config.dataset, "dataset")
    assert build(config.dataset).name == "synth_freiburg"


def test_one_frame_per_split_is_enough(tmp_path: Path) -> None:
    numbers = {"num_train_day": 1, "num_train_night": 1, "num_val": 1, "num_test": 2}
    one = synth_freiburg(cache_dir=str(tmp_path), **numbers)
    sizes = {split: len(one.names(split)) for split in one.splits}
    assert sizes.pop("test") == 2
    assert set(sizes.values()) == {1}
