"""Domains and their heads, maps between class sets, and folders of pseudo-labels."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.data.domains import Domain, Domains
from rgbt.data.label_map import LabelMap
from rgbt.data.mfnet import CLASSES, MFNet
from rgbt.data.pseudo_labels import FORMAT, PseudoLabelled, PseudoLabels, Unlabelled
from rgbt.evaluation.images import label_map_of
from rgbt.files.plain_files import write_json
from rgbt.types import VIEWS
from tests.data.layouts import refused


def domain(**changes: Any) -> Domain:
    given: dict[str, Any] = {"split": "train", "view": None, "head": None, "labels": "given"}
    return Domain(**{**given, **changes})


def domains(**changes: Any) -> Domains:
    given: dict[str, Any] = {"source": domain(), "target": None, "target_is": None}
    return Domains(**{**given, "tested_head": "own", **changes})


def two(target_is: str, **changes: Any) -> Domains:
    return domains(
        source=domain(view="rgb", head="day"),
        target=domain(view="thermal" if target_is == "view" else "rgb", head="dark"),
        **{"target_is": target_is, **changes},
    )


def test_confidence_of_labels_without_one_is_refused() -> None:
    for labels in ("given", "none"):
        with pytest.raises(InputError, match=f"confidence=true requires .* labels={labels}"):
            domain(labels=labels, confidence=True)
    assert domain(labels="experiment:x/best.pt", confidence=True).confidence


def heads(source: str | None, target: str | None, **changes: Any) -> dict[str, Any]:
    return {"source": domain(head=source), "target": domain(head=target), **changes}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"source": domain(labels="none")}, "domains.source.labels=none"),
        (heads("day", None), "got day and null"),
        (heads(None, "dark"), "got null and dark"),
        (heads("a", "b"), "domains.target_is=null .* with 2 heads"),
        (heads(None, None, target_is="view"), "domains.target_is=view .* with 0 heads"),
        (heads("a", "a", target_is="night"), "domains.target_is=night .* with 1 heads"),
        (heads("a", "a", tested_head="source"), "tested_head=source with 1 heads"),
        (heads("a", "b", target_is="view"), "target_is=view selects the head of an image"),
    ],
)
def test_domains_that_cannot_be_distinguished_are_refused(
    changes: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        domains(**changes)


def test_the_only_head_predicts_everything() -> None:
    alone, both = domains(source=domain(head="a")), two("night")
    assert (list(alone.named), alone.heads) == (["source"], ("a",))
    assert (list(both.named), both.heads) == (["source", "target"], ("day", "dark"))
    assert domains(source=domain(head="a"), target=domain(head="a")).heads == ("a",)
    for view, night in itertools.product(VIEWS, (True, False, None)):
        assert domains(target=domain()).head_of(view, night, "own") is None
        assert alone.head_of(view, night, "own") == "a"
    for requested in ("source", "target"):
        with pytest.raises(InputError, match=f"head={requested} selects one of two heads"):
            alone.head_of("rgb", None, requested)


def test_the_head_of_a_view() -> None:
    for night in (True, False, None):
        heads = [two("view").head_of(view, night, "own") for view in VIEWS]
        assert heads == ["day", "day", "dark"]


def test_the_head_of_a_night() -> None:
    for view in VIEWS:
        assert two("night").head_of(view, True, "own") == "dark"
        assert two("night").head_of(view, False, "own") == "day"
        with pytest.raises(InputError, match="does not state which images were taken at night"):
            two("night").head_of(view, None, "own")


# Maps between class sets.

TARGETS = ("road", "car")


def test_ids_are_mapped_one_by_one() -> None:
    label_map = LabelMap(num_source=4, targets=TARGETS, groups={"car": (0, 3), "road": (2, 1)})
    mapped = label_map(np.array([[0, 1, 2], [3, 3, 0]], np.uint8))
    assert mapped.dtype == np.uint8
    assert mapped.tolist() == [[1, 0, 0], [1, 1, 1]]


@pytest.mark.parametrize(
    ("groups", "said"),
    [
        ({"car": (0, 1), "rode": (2, 3)}, "'rode' is not a valid choice; did you mean"),
        ({"car": (0, 1), "road": (3,)}, "every id from 0 to 3 once, got [0, 1, 3]"),
        ({"car": (0, 1, 2), "road": (2, 3)}, "got [0, 1, 2, 2, 3]"),
        ({"car": (0, 1, -1), "road": (2, 3)}, "got [-1, 0, 1, 2, 3]"),
    ],
)
def test_every_id_is_mapped_once(groups: dict[str, tuple[int, ...]], said: str) -> None:
    with pytest.raises(InputError, match="label_map.groups") as raised:
        LabelMap(num_source=4, targets=TARGETS, groups=groups)
    assert said in str(raised.value)


def test_other_networks_and_data_sets_are_refused() -> None:
    label_map = LabelMap(num_source=2, targets=TARGETS, groups={"car": (0, 1)})
    label_map.check(2, TARGETS, "streets")
    # The same names under other ids are other classes.
    for number, targets in ((9, TARGETS), (2, TARGETS[::-1])):
        said = refused(lambda n=number, t=targets: label_map.check(n, t, "streets"))
        assert f"network has {number} classes and streets has {', '.join(targets)}" in said


# Written down from the published lists a second time, class by class of the source.
VISTAS = (
    *(9, 12, 3, 4, 4, 3, 2, 1, 0, 3, 0),  # bird .. parking
    *(1, 0, 0, 0, 1, 2, 2, 2, 9, 9, 9, 9),  # pedestrian area .. other rider
    *(0, 0, 7, 7, 8, 7, 7, 6, 7),  # crosswalk marking .. water
    *(12, 12, 12, 12, 12, 12, 12, 12, 12, 12, 12, 12),  # banner .. pothole and others
    *(5, 5, 5, 5, 5, 5, 5, 12, 11),  # street light .. bicycle
    *(10, 10, 10, 10, 11, 10, 10, 10, 10, 10),  # boat .. wheeled slow
    *(12, 12, 13),  # car mount, ego vehicle, unlabeled
)
CITYSCAPES = (0, 1, 2, 2, 4, 5, 5, 5, 6, 7, 8, 9, 9, 10, 10, 10, 10, 11, 11)
MFNET = (0, 0, 0, 4, 0, 0, 0, 0, 0, 2, 1, 3, 0, 0)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("vistas_to_freiburg", VISTAS),
        ("cityscapes_to_freiburg", CITYSCAPES),
        ("freiburg_to_mfnet", MFNET),
    ],
)
def test_released_maps(name: str, expected: tuple[int, ...]) -> None:
    label_map = label_map_of(name)
    assert label_map is not None
    dataset = compose([f"dataset={name.rpartition('_')[2]}"]).dataset
    assert label_map.targets == tuple(dataset.classes)
    ids = np.arange(label_map.num_source, dtype=np.uint8)
    assert tuple(label_map(ids).tolist()) == expected


# Pseudo-labels.

NAMES = ["00001D", "00002N"]
HW = (2, 3)
LABEL = np.array([[0, 8, 255], [3, 3, 255]], np.uint8)
CONFIDENCE = np.array([[0, 65535, 13107], [32768, 1, 52428]], np.uint16)


@pytest.fixture
def dataset(write_mfnet: Callable[..., Path]) -> MFNet:
    return MFNet(str(write_mfnet({"train": NAMES}, HW)))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Pseudo-labels of the first image."""
    made = tmp_path / "pseudo"
    write(made, NAMES[0], LABEL, CONFIDENCE)
    say(made)
    return made


def write(folder: Path, name: str, label: np.ndarray, confidence: np.ndarray) -> None:
    for kind, image in (("labels", label), ("confidence", confidence)):
        (folder / kind).mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(folder / kind / f"{name}.png"), image)


def say(folder: Path, **others: Any) -> None:
    manifest = {"format": FORMAT, "classes": CLASSES, "digest": "abc", **others}
    write_json(folder / "pseudo_labels.json", manifest)


def test_labels_and_confidences_are_read(folder: Path) -> None:
    found = PseudoLabels(folder)
    label, confidence = found.read(NAMES[0])
    assert (found.classes, found.digest) == (CLASSES, "abc")
    assert np.array_equal(label, LABEL)
    assert confidence.dtype == np.float32
    # 13107 and 52428 are a fifth and four fifths of 65535.
    expected = [[0, 1, 0.2], [32768 / 65535, 1 / 65535, 0.8]]
    assert confidence == pytest.approx(np.array(expected), abs=1e-7)


def test_invalid_folders_are_refused(folder: Path, tmp_path: Path) -> None:
    assert "does not exist" in refused(lambda: PseudoLabels(tmp_path / "nowhere"))
    say(folder, format="rgbt pseudo-labels 9")
    assert "got 'rgbt pseudo-labels 9'" in refused(lambda: PseudoLabels(folder))
    (folder / "pseudo_labels.json").write_text("{")
    assert "is damaged" in refused(lambda: PseudoLabels(folder))
    (folder / "pseudo_labels.json").unlink()
    assert "is not complete" in refused(lambda: PseudoLabels(folder))


def test_pseudo_labels_replace_labels(dataset: MFNet, folder: Path) -> None:
    own = dataset.read(NAMES[0])
    sample = PseudoLabelled(dataset, folder, with_confidence=True).read(NAMES[0])
    assert np.array_equal(sample.rgb, own.rgb)
    assert np.array_equal(sample.thermal, own.thermal)
    assert np.array_equal(sample.label, LABEL)
    assert sample.confidence[1, 2] == pytest.approx(0.8)
    assert PseudoLabelled(dataset, folder, with_confidence=False).read(NAMES[0]).confidence is None


def test_unlabelled_samples_have_no_label(dataset: MFNet) -> None:
    sample = Unlabelled(dataset).read(NAMES[1])
    assert (sample.label, sample.confidence, sample.name) == (None, None, NAMES[1])
    assert np.array_equal(sample.rgb, dataset.read(NAMES[1]).rgb)


@pytest.mark.parametrize(
    ("label", "confidence", "said"),
    [
        (LABEL, CONFIDENCE.astype(np.uint8), "uint8 of shape (2, 3)"),
        (LABEL, np.zeros((2, 4), np.uint16), "uint16 of shape (2, 4)"),
        (LABEL[:, :2], CONFIDENCE[:, :2], "'00002N' has (2, 3) pixels but its pseudo-label in"),
        (LABEL + 1, CONFIDENCE, "label value 9 "),
        (None, None, "'00002N' has no pseudo-label in"),
    ],
)
def test_invalid_labels_are_refused(
    dataset: MFNet, folder: Path, label: Any, confidence: Any, said: str
) -> None:
    if label is not None:
        write(folder, NAMES[1], label, confidence)
    labelled = PseudoLabelled(dataset, folder, with_confidence=False)
    assert said in refused(lambda: labelled.read(NAMES[1]))
    say(folder, classes=("road", "car"))
    told = refused(lambda: PseudoLabelled(dataset, folder, with_confidence=False))
    assert "classes road, car, but mfnet has unlabeled, car" in told
