"""The embedded data sets on disk: what their layouts share, then what is each one's own."""

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
from rgbt.config.compose import compose
from rgbt.data import freiburg, kp, pst900
from rgbt.data.freiburg import Freiburg
from rgbt.data.kp import KP
from rgbt.data.mfnet import MFNet
from rgbt.data.pst900 import PST900
from rgbt.synth import datasets, export
from rgbt.synth.datasets import (
    FREIBURG_TABLE,
    KP_TABLE,
    PST900_IDS,
    VAL_SEQUENCE,
    VOID,
    counts_of,
    kp_ids,
    seen_in_thermal,
    synth,
)
from rgbt.synth.export import Layout, ScenePlan, exported, shots_of, write
from rgbt.synth.factors import EgoMotion, SceneFactors
from rgbt.synth.scene import render_pair, render_scene
from rgbt.synth.street import INDEX, Table

CAR, PERSON, BIKE, CURVE, CAR_STOP, GUARDRAIL, COLOR_CONE, BUMP = range(1, 9)
NUMBERS = {"train": 6, "val": 2, "test": 5}
SMALL = SceneFactors(height=48, width=64)
FREIBURG_FACTORS = SceneFactors(height=98, width=288, field_of_view_deg=96.0)
EMPTY = Layout(lambda shots: shots, lambda scene, shot: {})


def planned(
    name: str, numbers: dict[str, int] = NUMBERS, factors: SceneFactors = SMALL
) -> ScenePlan:
    return ScenePlan(name=name, seed=0, numbers=numbers, factors=factors)


class Embedded(NamedTuple):
    """One of the data sets, at a small size."""

    layout: Layout
    reader: Callable[[str], Any]
    background: tuple[str, ...]
    plan: ScenePlan

    def made(self, cache_dir: Path, **changes: Any) -> Any:
        numbers = {f"num_{split}": number for split, number in self.plan.numbers.items()}
        hw = {"height": self.plan.factors.height, "width": self.plan.factors.width}
        make = getattr(datasets, self.plan.name)
        return make(cache_dir=str(cache_dir), **{**numbers, **hw, **changes})


EMBEDDED = {
    "synth": Embedded(datasets.MFNET_LAYOUT, MFNet, ("unlabeled",), planned("synth")),
    "synth_kp": Embedded(
        datasets.KP_LAYOUT,
        KP,
        (),
        planned("synth_kp", NUMBERS, replace(SMALL, night_share=0.48)),
    ),
    "synth_pst900": Embedded(
        datasets.PST900_LAYOUT,
        lambda root: PST900(root, val_bags=(20,)),
        ("background",),
        planned("synth_pst900", NUMBERS, replace(SMALL, field_of_view_deg=80.0)),
    ),
    "synth_freiburg": Embedded(
        datasets.FREIBURG_LAYOUT,
        lambda root: Freiburg(root, crop=(1, 97, 48, 240), val_sequences=(VAL_SEQUENCE,)),
        ("background", "ignore"),
        planned(
            "synth_freiburg",
            {"train_day": 10, "train_night": 6, "val": 2, "test": 5},
            FREIBURG_FACTORS,
        ),
    ),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cache of all data sets, to be read alone."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(params=EMBEDDED)
def embedded(request: pytest.FixtureRequest) -> Embedded:
    return EMBEDDED[request.param]


# ---- what they share ------------------------------------------------------------------------


def test_ordinary_reader_reads_the_scenes(embedded: Embedded, folder: Path) -> None:
    data, shots = embedded.made(folder), shots_of(embedded.layout, embedded.plan)
    plain = embedded.reader(str(data.root))
    assert (data.name, data.background) == (embedded.plan.name, embedded.background)
    assert plain.fingerprint() == data.fingerprint()
    assert {
        split: len(plain.names(split)) for split in embedded.plan.numbers
    } == embedded.plan.numbers
    assert [shot.scene for shot in shots] == list(range(sum(embedded.plan.numbers.values())))
    names = [name for split in embedded.plan.numbers for name in data.names(split)]
    for shot in shots[::4]:
        scene = render_scene(
            0, shot.scene, replace(embedded.plan.factors, night_share=float(shot.night))
        )
        name = sorted(names, key=lambda name: shot.name not in name)[0]
        sample, (rgb, thermal) = data.read(name), (scene.rgb, scene.thermal)
        assert np.array_equal(plain.read(name).rgb, sample.rgb)
        assert (sample.label is None) == (shot.split == "train_night")
        if embedded.plan.name == "synth_freiburg":
            assert np.array_equal(sample.rgb, rgb[1:97, 48:240])
            # Counts become the grey levels of `synth`, but for rounding to counts first.
            seen, thermal = (of[1:97, 48:240] for of in (seen_in_thermal(98, 288), thermal))
            assert np.abs(sample.thermal.astype(int) - thermal)[seen].max() <= 1
            assert not sample.thermal[~seen].any()
            continue
        ids = {"synth": scene.label, "synth_kp": kp_ids(scene)}
        label = ids.get(embedded.plan.name, PST900_IDS[scene.label])
        expected = np.where(label == 19, 255, label)
        assert np.array_equal(sample.label, expected)
        # JPEG loses a few grey levels, of colours more than of grey
        limit = 3 if embedded.plan.name == "synth_kp" else 0
        assert np.abs(sample.thermal.astype(int) - thermal).mean() <= limit
        assert np.abs(sample.rgb.mean((0, 1)) - rgb.mean((0, 1))).max() <= limit / 3


def test_pool_writes_same_files(
    embedded: Embedded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone, pooled = tmp_path / "alone", tmp_path / "pooled"
    for made in (alone, pooled):
        made.mkdir()
        write(
            embedded.layout,
            replace(embedded.plan, numbers=dict.fromkeys(embedded.plan.numbers, 2)),
            made,
        )
        monkeypatch.setattr(export, "_WORTH_A_POOL", 1)
    files = [{p.relative_to(f): p.read_bytes() for p in f.rglob("*.*")} for f in (alone, pooled)]
    assert files[0] == files[1]


def test_folder_is_named_by_plan_and_reused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = planned("synth")
    plans = [
        *(plan, plan, replace(plan, seed=4), replace(plan, numbers={**NUMBERS, "val": 3})),
        *(replace(plan, factors=replace(SMALL, glare=0.5)), replace(plan, motion=EgoMotion(1.0))),
        replace(plan, name="other"),
    ]
    monkeypatch.setattr(export, "write", lambda *_: None)
    written = [exported(EMPTY, plan, tmp_path) for plan in plans]
    monkeypatch.setattr(export, "VERSION", export.VERSION + 1)
    written.append(exported(EMPTY, plans[0], tmp_path))
    assert written[0] == written[1]
    assert len(set(written)) == 7
    assert all(path.name.startswith("synth-") for path in written[:6])


def test_configuration_has_the_settings_with_their_defaults(embedded: Embedded) -> None:
    """All of them for `synth`; presets of it change values alone."""
    name, make = embedded.plan.name, getattr(datasets, embedded.plan.name)
    node: Any = OmegaConf.to_container(compose([f"dataset={name}"]).dataset, resolve=True)
    assert node.pop("absent") == "released"
    assert node.pop("_target_") == f"{make.__module__}.{name}"
    parameters = inspect.signature(make).parameters.items()
    defaults = {key: parameter.default for key, parameter in parameters}
    plain = {key: list(v) if isinstance(v, tuple) else v for key, v in defaults.items()}
    assert node.items() <= plain.items()
    if name == "synth":
        assert node == plain
        preset = compose(["dataset=synth_calibrated"]).dataset
        assert set(preset) == {*node, "absent", "_target_"}
        assert (preset.name, preset.object_mix) == ("synth_calibrated", "mfnet")
    if name == "synth_freiburg":
        with pytest.raises(TypeError, match="night_share"):
            make(night_share=0.2)


def test_interrupted_generation_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    embedded, real = EMBEDDED["synth"], export.write_shot

    def interrupted(layout: Layout, plan: ScenePlan, folder: Path, shot: Any) -> None:
        if shot.scene == 3:
            raise KeyboardInterrupt
        real(layout, plan, folder, shot)

    with monkeypatch.context() as patch:
        patch.setattr(export, "write_shot", interrupted)
        with pytest.raises(KeyboardInterrupt):
            embedded.made(tmp_path)
    assert list(tmp_path.iterdir()) == []
    assert (embedded.made(tmp_path).root / "test.txt").is_file()


def test_first_of_two_generations_is_kept(tmp_path: Path) -> None:
    plan, other = planned("synth", {"train": 0}), []

    def named(shots: list[Any]) -> list[Any]:
        if not other:
            other.append(exported(EMPTY, plan, tmp_path))
            (other[0] / "first.txt").write_text("")
        return shots

    assert exported(Layout(named, EMPTY.images), plan, tmp_path) == other[0]
    assert (other[0] / "first.txt").is_file()
    assert list(tmp_path.iterdir()) == other


def test_wrong_settings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"dataset\.ego_yaw_deg"):
        synth(cache_dir=str(tmp_path), ego_yaw_deg=2.0)
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(InputError, match=r"dataset\.cache_dir"):
        synth(cache_dir=str(file))
    assert list(tmp_path.iterdir()) == [file]


# ---- synth ----------------------------------------------------------------------------------


def test_synth_lists_have_days_and_nights(folder: Path) -> None:
    root = EMBEDDED["synth"].made(folder).root
    lists = {path.stem: path.read_text().split() for path in root.glob("*.txt")}
    assert lists.keys() == {"train", "val", "test", "test_day", "test_night"}
    for time in ("day", "night"):
        named = [name for name in lists["test"] if name[-1] == time[0].upper()]
        assert lists[f"test_{time}"] == named != []


def test_second_frames_form_data_set(tmp_path: Path) -> None:
    data = EMBEDDED["synth"].made(tmp_path, ego_forward_m=0.5, ego_yaw_deg=1.0)
    name = data.names("test")[0]
    pair = render_pair(0, 8, SMALL, EgoMotion(0.5, 1.0))
    stored = cv2.imread(str(data.root / f"next/images/{name}.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(stored[..., 3], pair.second.thermal)
    flow = np.load(data.root / f"next/flow/{name}.npy")
    assert np.array_equal(np.isnan(flow[..., 0]), ~pair.visible)
    assert np.array_equal(flow[pair.visible], pair.flow[pair.visible])
    assert (data.root / "next/test.txt").read_text() == (data.root / "test.txt").read_text()


def test_maps_of_the_test_split(folder: Path) -> None:
    dataset = EMBEDDED["synth"].made(folder)
    for number, name in enumerate(dataset.names("test")):
        maps = dataset.scene_maps(name)
        rendered = render_scene(0, 8 + number, SMALL)
        near = rendered.depth < 655
        assert np.abs(maps.depth_m[near] - rendered.depth[near]).max() <= 0.0051
        assert np.isinf(maps.depth_m[np.isinf(rendered.depth)]).all()
        labelled = (rendered.owner >= 0) & (rendered.label > 0)
        assert np.array_equal(maps.objects > 0, labelled)
        assert np.array_equal(maps.objects[labelled], rendered.owner[labelled] + 1)
    with pytest.raises(InputError, match="no depth and objects of a rendered scene"):
        dataset.scene_maps(dataset.names("train")[0])


# ---- the others -----------------------------------------------------------------------------


def test_pst900_names_are_those_of_archive() -> None:
    numbers = {"train": 57, "val": 3, "test": 10}
    shots = shots_of(datasets.PST900_LAYOUT, planned("x", numbers))
    assert shots[0].name == "0_bag01_rect_rgb_frame0000000000"
    assert shots[60].name == "60_bag21_rect_rgb_frame0000000600"
    assert [shot.folder for shot in shots] == ["train"] * 60 + ["test"] * 10
    # Three scenes of each of nineteen recordings, then the one that is held out.
    bags = [int(shot.name.split("_")[1].removeprefix("bag")) for shot in shots]
    assert bags[:60] == [bag for bag in range(1, 21) for _ in range(3)]
    assert set(bags[60:]) == {21, 22, 23, 24, 25}
    stands = {0: "background", CAR: "background", COLOR_CONE: "fire_extinguisher"}
    stands |= {CAR_STOP: "backpack", BUMP: "hand_drill", PERSON: "survivor"}
    assert {label: pst900.CLASSES[PST900_IDS[label]] for label in stands} == stands


def test_kp_files_and_names_have_its_format(folder: Path) -> None:
    data = EMBEDDED["synth_kp"].made(folder)
    rgb, lwir, label = data.files(data.names("test")[0])
    assert [path.suffix for path in (rgb, lwir, label)] == [".jpg", ".jpg", ".png"]
    thermal = cv2.imread(str(lwir), cv2.IMREAD_UNCHANGED)
    assert thermal.shape == (48, 64, 3)
    assert (thermal == thermal[..., :1]).all()
    assert cv2.imread(str(label), cv2.IMREAD_UNCHANGED).max() == 19, "void is 19 on disk"
    for split in ("train", "val", "test"):
        # The lists say what the set numbers say, which is the split of the CRM release.
        assert data.names(split) == KP(str(data.root), lists="sets").names(split)
    found: dict[str, set[int]] = {"train": set(), "val": set(), "test": set()}
    plan = replace(planned("x", {"train": 60, "val": 20, "test": 40}), seed=3)
    for shot in shots_of(datasets.KP_LAYOUT, plan):
        found[shot.split].add(int(shot.name[3:5]))
        assert (shot.name[6:10], int(shot.name[-5:])) == ("V000", shot.scene)
    assert found == {"train": {0, 1, 2, 3, 4, 5}, "val": {6, 10}, "test": {7, 8, 9, 11}}


def test_kp_rider_is_not_person() -> None:
    persons = riders = 0
    for scene in (render_scene(0, index, SceneFactors()) for index in range(12)):
        ids = kp_ids(scene)
        person, rider = (ids == kp.CLASSES.index(name) for name in ("person", "rider"))
        assert np.array_equal(person | rider, scene.label == PERSON)
        shown = {scene.placed[owner].shape.name for owner in np.unique(scene.owner[person])}
        assert "bike_ridden" not in shown
        for owner in np.unique(scene.owner[rider]):
            assert scene.placed[owner].shape.name == "bike_ridden"
            # Where a rider is, the bicycle is the same object.
            assert {BIKE, PERSON} >= set(scene.label[scene.owner == owner].tolist())
        persons, riders = persons + person.any(), riders + rider.any()
    assert persons > 8
    assert riders > 3


def test_freiburg_archive_peculiarities_are_reproduced(folder: Path) -> None:
    root = EMBEDDED["synth_freiburg"].made(folder).root

    def first(pattern: str) -> Any:
        return cv2.imread(str(sorted(root.glob(pattern))[0]), cv2.IMREAD_UNCHANGED)

    assert first("train/seq_01_day/00/fl_rgb_labels/*.png").shape == (196, 576)
    assert first("train/seq_00_day/00/fl_rgb_labels/*.png").shape == (98, 288)
    folders = {path.name for path in (root / "test").glob("*/Images*")}
    assert folders == {"ImagesRGB", "ImagesIR", "ImagesRgb", "ImagesIr"}
    stems = [path.stem.removesuffix("_ir") for path in root.glob("test/*/Images[Ii]*/*_ir.png")]
    assert [stem.endswith("0") for stem in stems].count(True) < len(stems)
    counts = first("train/seq_00_day/00/fl_ir_aligned/*.png")
    assert counts.dtype == np.uint16
    assert not counts[:, [0, 40, 250, 287]].any()
    assert counts[counts > 0].min() > 19_000
    # "ignore" is what only the RGB camera sees, in labels by hand.
    label = np.load(next(root.glob("test/night/SegmentationClass/*.npy")))
    assert np.array_equal(label == 13, ~seen_in_thermal(98, 288))
    assert not list(root.glob("train/*night/*/fl_rgb_labels"))


def test_freiburg_scenes_are_in_one_split() -> None:
    shots = shots_of(datasets.FREIBURG_LAYOUT, EMBEDDED["synth_freiburg"].plan)
    assert len({shot.name for shot in shots}) == 23
    assert [shot.folder for shot in shots[:10:2]] == [
        *("train/seq_00_day/00", "train/seq_00_day/01", "train/seq_01_day/01"),
        *("train/seq_02_day/00", "train/seq_03_day/00"),
    ]
    assert [shot.night for shot in shots] == [False] * 10 + [True] * 6 + [False] * 5 + [True] * 2


def test_freiburg_counts_and_margins_by_hand() -> None:
    grey = np.array([[0.0, 1.0, 0.5, -0.5, 1.1]], np.float32)
    assert counts_of(grey).tolist() == [[21800, 23700, 22750, 20850, 23890]]
    seen = seen_in_thermal(98, 288)
    assert seen.sum(1).min() > 180
    assert len(set(seen.argmax(1))) > 3
    assert 0 < (~seen[1:97, 48:240]).mean() < 0.01


# ---- classes --------------------------------------------------------------------------------

BY_HAND: dict[str, dict[str, list[tuple[int, str]]]] = {
    "kp": {
        "sky": [(0, "sky")],
        "sidewalk": [(0, "paving"), (CURVE, "kerb_top")],
        "road": [(0, "asphalt"), (0, "manhole"), (BUMP, "yellow")],
        "vegetation": [(0, "leaf"), (0, "bark")],
        "terrain": [(0, "grass")],
        "wall": [(0, "wall")],
        "building": [(0, "far_wall")],
        "pole": [(0, "pole")],
        # A tyre is of the car or of the bike that it belongs to, a shoe of the person.
        "traffic_sign": [(0, "sign_red")],
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
    ("name", "table", "classes"),
    [("kp", KP_TABLE, (*kp.CLASSES, VOID)), ("freiburg", FREIBURG_TABLE, freiburg.CLASSES)],
)
def test_classes_by_hand(name: str, table: Table, classes: Sequence[str]) -> None:
    for expected, pairs in BY_HAND[name].items():
        for label, material in pairs:
            assert classes[table[label, INDEX[material]]] == expected
