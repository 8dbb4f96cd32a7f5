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
from rgbt.config.compose import compose, conf_dir
from rgbt.data.kp import CLASSES, KP
from rgbt.data.kp_layout import set_of
from rgbt.data.synth import kp, people
from rgbt.data.synth.classes import KP_BY_LABEL, KP_OF_SCENERY, KP_TABLE, VOID, ids_in, kp_ids
from rgbt.data.synth.factors import SceneFactors
from rgbt.data.synth.kp import cached, names_of, synth_kp, write
from rgbt.data.synth.materials import INDEX
from rgbt.data.synth.scene import Scene, render_scene
from rgbt.data.synth.shapes import BIKE, BUMP, CAR, CAR_STOP, CURVE, GUARDRAIL, PERSON
from rgbt.data.synth.writer import SynthPlan

SMALL = {"num_train": 9, "num_val": 4, "num_test": 8, "height": 48, "width": 64}
FACTORS = SceneFactors(height=48, width=64, night_share=0.48)
ABSENT = {"traffic_light", "truck", "bus", "train", "motorcycle"}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> KP:
    """To be read alone."""
    return synth_kp(cache_dir=str(tmp_path_factory.mktemp("cache")), **SMALL)


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    return [render_scene(0, index, SceneFactors()) for index in range(12)]


def plan(**changes: object) -> SynthPlan:
    made = SynthPlan(seed=3, num_train=4, num_val=2, num_test=5, factors=FACTORS)
    return replace(made, **changes)


# ---- on disk --------------------------------------------------------------------------------


def test_the_ordinary_reader_reads_it(data: KP) -> None:
    plain = KP(str(data.root))
    assert plain.lists == "files"
    for split, size in (("train", 9), ("val", 4), ("test", 8)):
        names = plain.names(split)
        assert len(names) == size
        assert names == tuple(
            sorted({*plain.names(f"{split}_day"), *plain.names(f"{split}_night")})
        )
        # The lists say what the set numbers say, which is the split of the CRM release.
        assert names == KP(str(data.root), lists="sets").names(split)
    assert plain.fingerprint() == data.fingerprint()
    assert (data.name, data.num_classes) == ("synth_kp", 19)


def test_files_hold_the_scenes(data: KP) -> None:
    tints = []
    for name in (*data.names("train_day"), *data.names("test_night")):
        scene = render_scene(0, int(name[-5:]), FACTORS)
        sample = data.read(name)
        assert scene.is_night == data.nights((name,))[0]
        ids = kp_ids(scene)
        assert np.array_equal(sample.label, np.where(ids == 19, 255, ids))
        # JPEG loses a few grey levels, of colours more than of grey.
        assert np.abs(sample.thermal.astype(int) - scene.thermal).mean() < 3
        means, stored = (image.mean((0, 1)) for image in (scene.rgb, sample.rgb))
        assert np.abs(means - stored).max() < 1
        tints.append(abs(means[0] - means[2]))
        assert np.abs(sample.rgb.astype(int) - scene.rgb).mean() < 12
    assert max(tints) > 3, "red and blue are told apart"


def test_files_have_format_of_kp(data: KP) -> None:
    rgb, lwir, label = data.files(data.names("test")[0])
    assert [path.suffix for path in (rgb, lwir, label)] == [".jpg", ".jpg", ".png"]
    assert (rgb.parent.name, lwir.parent.name) == ("visible", "lwir")
    thermal = cv2.imread(str(lwir), cv2.IMREAD_UNCHANGED)
    assert thermal.shape == (48, 64, 3)
    assert (thermal == thermal[..., :1]).all()
    stored = cv2.imread(str(label), cv2.IMREAD_UNCHANGED)
    assert stored.shape == (48, 64)
    assert stored.max() == 19, "void is 19 on disk"
    assert (data.root / "val_day.txt").read_text().splitlines()[0].endswith(".png")


def test_names_belong_to_recordings_of_split() -> None:
    found = names_of(plan(num_train=60, num_val=20, num_test=40))
    sets = {split: {set_of(name) for name in names} for split, names in found.items()}
    assert sets == {"train": {0, 1, 2, 3, 4, 5}, "val": {6, 10}, "test": {7, 8, 9, 11}}
    frames = [int(name[-5:]) for names in found.values() for name in names]
    assert frames == list(range(120)), "no scene is in two splits"
    assert {name[6:10] for name in found["train"]} == {"V000"}


def test_equal_plans_give_equal_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alone, pooled = tmp_path / "alone", tmp_path / "pooled"
    for folder in (alone, pooled):
        folder.mkdir()
        write(plan(), folder)
        monkeypatch.setattr("rgbt.data.synth.writer._WORTH_A_POOL", 1)
    found = sorted(path.relative_to(alone) for path in alone.rglob("*.*"))
    assert found == sorted(path.relative_to(pooled) for path in pooled.rglob("*.*"))
    assert all((alone / path).read_bytes() == (pooled / path).read_bytes() for path in found)


def test_folder_is_reused_and_named_by_plan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = plan(num_train=1, num_val=1, num_test=1)
    folder = cached(small, tmp_path)
    assert folder.name.startswith("synth_kp-")
    monkeypatch.setattr(kp, "write", lambda *_: None)
    others = [replace(small, seed=4), replace(small, factors=replace(FACTORS, rgb_noise=0.5))]
    assert len({cached(each, tmp_path) for each in [small, small, *others]}) == 3
    for version in ("VERSION", "SCENES_VERSION"):
        with monkeypatch.context() as patch:
            patch.setattr(kp, version, getattr(kp, version) + 1)
            assert cached(small, tmp_path) != folder


def test_no_night_lists_without_nights(tmp_path: Path) -> None:
    small = {"num_train": 1, "num_val": 1, "num_test": 1, "height": 32, "width": 40}
    days = synth_kp(cache_dir=str(tmp_path), **small, night_share=0.0)
    assert [days.has(f"test{time}") for time in ("", "_day")] == [True, True]
    assert not (days.root / "test_night.txt").exists()
    with pytest.raises(InputError, match="'test_night' of synth_kp is empty"):
        days.names("test_night")


# ---- classes --------------------------------------------------------------------------------


def test_classes_by_hand() -> None:
    def of(label: int, material: str) -> str:
        found = ids_in(KP_TABLE, np.array([[label]], np.uint8), np.array([[INDEX[material]]]))
        return [*CLASSES, VOID][found[0, 0]]

    assert of(0, "sky") == "sky"
    assert of(0, "asphalt") == of(0, "manhole") == of(BUMP, "yellow") == "road"
    assert of(0, "paving") == of(CURVE, "kerb_top") == "sidewalk"
    assert of(0, "leaf") == of(0, "bark") == "vegetation"
    assert of(0, "grass") == "terrain"
    assert (of(0, "wall"), of(0, "far_wall")) == ("wall", "building")
    assert (of(0, "pole"), of(0, "sign_red")) == ("pole", "traffic_sign")
    # A tyre is of the car or of the bike that it belongs to.
    assert (of(CAR, "tyre"), of(BIKE, "tyre"), of(PERSON, "shoe")) == ("car", "bicycle", "person")
    assert of(GUARDRAIL, "rail_dark") == "fence"
    assert of(0, "wire") == of(CAR_STOP, "yellow") == VOID


def test_every_label_and_material_has_one_class() -> None:
    assert sorted(KP_BY_LABEL) == list(range(1, 9))
    named = [material for materials in KP_OF_SCENERY.values() for material in materials]
    assert len(named) == len(set(named))
    assert set(named) <= set(INDEX)
    given = {*KP_OF_SCENERY, *KP_BY_LABEL.values(), "rider"}
    assert {*CLASSES, VOID} - given == ABSENT


def test_rider_is_not_person(scenes: list[Scene]) -> None:
    persons = riders = 0
    for scene in scenes:
        ids = kp_ids(scene)
        person, rider = (ids == CLASSES.index(name) for name in ("person", "rider"))
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
        assert scene.owner.max() < len(scene.placed)


def test_every_present_class_is_frequent(scenes: list[Scene]) -> None:
    shown = np.zeros(20)
    for scene in scenes:
        shown += np.bincount(kp_ids(scene).ravel(), minlength=20) > 0
    assert {name for name, times in zip(CLASSES, shown) if not times} == ABSENT
    assert shown[[n for n, name in enumerate(CLASSES) if name not in ABSENT]].min() >= 4
    assert shown[19] > 6


# ---- settings -------------------------------------------------------------------------------


def test_yaml_has_every_setting_with_default() -> None:
    node = OmegaConf.to_container(compose(["dataset=synth_kp"]).dataset, resolve=True)
    assert node.pop("absent") == "released"
    assert node.pop("_target_") == "rgbt.data.synth.kp.synth_kp"
    parameters = inspect.signature(synth_kp).parameters
    assert node == {name: parameter.default for name, parameter in parameters.items()}


def test_it_is_made_from_a_configuration(tmp_path: Path) -> None:
    node = OmegaConf.load(conf_dir() / "dataset/synth_kp.yaml")
    changes = {**SMALL, "num_train": 1, "num_test": 1, "cache_dir": str(tmp_path)}
    config = OmegaConf.create({"dataset": OmegaConf.merge(node, changes)})
    Component.from_node(config.dataset, "dataset")
    assert build(config.dataset).name == "synth_kp"
    config.dataset.hight = 3
    with pytest.raises(InputError, match="did you mean 'height'"):
        Component.from_node(config.dataset, "dataset")
