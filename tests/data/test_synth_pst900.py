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
from rgbt.data.pst900 import CLASSES, PST900
from rgbt.data.pst900_layout import bag_of
from rgbt.data.synth import pst900
from rgbt.data.synth.factors import SceneFactors
from rgbt.data.synth.pst900 import CLASS_OF, cached, shots_of, synth_pst900, write
from rgbt.data.synth.scene import render_scene
from rgbt.data.synth.shapes import BUMP, CAR, CAR_STOP, COLOR_CONE, PERSON
from rgbt.data.synth.writer import SynthPlan

SMALL = {"num_train": 6, "num_val": 2, "num_test": 5, "height": 36, "width": 64}
FACTORS = SceneFactors(height=36, width=64, field_of_view_deg=80.0)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> PST900:
    """To be read alone."""
    return synth_pst900(cache_dir=str(tmp_path_factory.mktemp("cache")), **SMALL)


def plan(**changes: object) -> SynthPlan:
    made = SynthPlan(seed=3, num_train=4, num_val=2, num_test=5, factors=FACTORS)
    return replace(made, **changes)


def test_the_ordinary_reader_reads_it(data: PST900) -> None:
    plain = PST900(str(data.root), val_bags=(20,))
    assert [len(plain.names(split)) for split in ("train", "val", "test")] == [6, 2, 5]
    assert {bag_of(name) for name in plain.names("test")} == {21, 22, 23, 24, 25}
    assert {bag_of(name) for name in plain.names("val")} == {20}
    assert plain.fingerprint() == data.fingerprint()
    assert (data.name, data.num_classes) == ("synth_pst900", 5)
    released = synth_pst900(cache_dir=str(data.root.parent), **SMALL, val_bags=())
    assert released.root == data.root
    assert len(released.names("train")) == 8
    assert released.names("val") == released.names("test")


def test_files_hold_the_scenes(data: PST900) -> None:
    for name in (data.names("train")[0], data.names("val")[-1], data.names("test")[2]):
        scene = render_scene(0, int(name.split("_")[0]), FACTORS)
        sample = data.read(name)
        assert np.array_equal(sample.rgb, scene.rgb)
        assert np.array_equal(sample.thermal, scene.thermal)
        assert np.array_equal(sample.label, CLASS_OF[scene.label])


def test_files_have_format_of_pst900(data: PST900) -> None:
    assert sorted(str(path.relative_to(data.root)) for path in data.root.glob("*/*")) == [
        f"{part}/{kind}" for part in ("test", "train") for kind in ("labels", "rgb", "thermal")
    ]
    rgb, thermal, label = (
        cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in data.files(data.names("test")[0])
    )
    assert (rgb.shape, thermal.shape, label.shape) == ((36, 64, 3), (36, 64), (36, 64))
    assert {image.dtype for image in (rgb, thermal, label)} == {np.dtype(np.uint8)}


def test_names_are_those_of_the_archive() -> None:
    shots = shots_of(plan(num_train=57, num_val=3, num_test=10))
    assert shots[0].name == "0_bag01_rect_rgb_frame0000000000"
    assert shots[60].name == "60_bag21_rect_rgb_frame0000000600"
    assert [shot.scene for shot in shots] == list(range(70)), "no scene is in two splits"
    assert [shot.part for shot in shots] == ["train"] * 60 + ["test"] * 10
    # Three scenes of each of nineteen recordings, then the one that is held out.
    assert [shot.bag for shot in shots[:60]] == [bag for bag in range(1, 21) for _ in range(3)]
    assert [bag_of(shot.name) for shot in shots] == [shot.bag for shot in shots]


def test_classes_by_hand() -> None:
    found = {label: CLASSES[CLASS_OF[label]] for label in (0, CAR, COLOR_CONE, CAR_STOP, BUMP)}
    assert found == {
        0: "background",
        CAR: "background",
        COLOR_CONE: "fire_extinguisher",
        CAR_STOP: "backpack",
        BUMP: "hand_drill",
    }
    assert CLASSES[CLASS_OF[PERSON]] == "survivor"
    assert len(CLASS_OF) == 9


def test_four_objects_are_present_and_rare() -> None:
    factors = SceneFactors(width=214, field_of_view_deg=80.0)
    counts = [
        np.bincount(CLASS_OF[render_scene(0, index, factors).label].ravel(), minlength=5)
        for index in range(16)
    ]
    shares = np.sum(counts, axis=0) / np.sum(counts)
    assert 0.92 < shares[0] < 0.97
    assert (shares[1:] > 0.004).all()
    assert (shares[1:] < 0.03).all()
    assert (np.array(counts) > 0).mean(0).min() > 0.3


def test_equal_plans_give_equal_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alone, pooled = tmp_path / "alone", tmp_path / "pooled"
    for folder in (alone, pooled):
        folder.mkdir()
        write(plan(), folder)
        monkeypatch.setattr("rgbt.data.synth.writer._WORTH_A_POOL", 1)
    found = sorted(path.relative_to(alone) for path in alone.rglob("*.*"))
    assert len(found) == 3 * 11
    assert found == sorted(path.relative_to(pooled) for path in pooled.rglob("*.*"))
    assert all((alone / path).read_bytes() == (pooled / path).read_bytes() for path in found)


def test_folder_is_reused_and_named_by_plan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = plan(num_train=1, num_val=1, num_test=1)
    folder = cached(small, tmp_path)
    assert folder.name.startswith("synth_pst900-")
    monkeypatch.setattr(pst900, "write", lambda *_: None)
    others = [replace(small, seed=4), replace(small, factors=replace(FACTORS, rgb_noise=0.5))]
    assert len({cached(each, tmp_path) for each in [small, small, *others]}) == 3
    for version in ("VERSION", "SCENES_VERSION"):
        with monkeypatch.context() as patch:
            patch.setattr(pst900, version, getattr(pst900, version) + 1)
            assert cached(small, tmp_path) != folder


def test_missing_bag_is_refused(data: PST900) -> None:
    other = synth_pst900(cache_dir=str(data.root.parent), **SMALL, val_bags=(33,))
    with pytest.raises(InputError, match=r"dataset.val_bags: .* has no bag 33"):
        other.names("val")


def test_yaml_has_every_setting_with_default() -> None:
    node = OmegaConf.to_container(compose(["dataset=synth_pst900"]).dataset, resolve=True)
    assert node.pop("absent") == "released"
    assert node.pop("_target_") == "rgbt.data.synth.pst900.synth_pst900"
    parameters = inspect.signature(synth_pst900).parameters
    defaults = {name: parameter.default for name, parameter in parameters.items()}
    assert node == {**defaults, "val_bags": list(defaults["val_bags"])}


def test_it_is_made_from_a_configuration(tmp_path: Path) -> None:
    node = OmegaConf.load(conf_dir() / "dataset/synth_pst900.yaml")
    changes = {**SMALL, "num_train": 1, "num_test": 1, "cache_dir": str(tmp_path)}
    config = OmegaConf.create({"dataset": OmegaConf.merge(node, changes)})
    Component.from_node(config.dataset, "dataset")
    assert build(config.dataset).name == "synth_pst900"
