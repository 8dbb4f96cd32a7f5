from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from analysis import commands
from analysis.predictions.scoring import class_remarks, find, score_folder
from rgbt.checks import InputError
from rgbt.data.mfnet import MFNet
from rgbt.data.predictions import PredictionReader
from rgbt.metrics.metric import Regions
from tests.analysis.counts import counts_of
from tests.analysis.predictions.conftest import LABELS, PREDICTIONS, Write

STRIPS: dict[str, Any] = {"partitions": ("vertical", "horizontal"), "regions": 2}
RESIZED: dict[str, Any] = {"partitions": ("vertical",), "regions": 2, "resize": "nearest"}


def named(prefix: str = "", suffix: str = "") -> PredictionReader:
    return PredictionReader((), (), prefix=prefix, suffix=suffix)


def test_counts_by_hand(tiny: MFNet, write: Write) -> None:
    scored = score_folder(write(PREDICTIONS), tiny, "test", **STRIPS)
    vertical, horizontal = scored.counts
    first = [[[4, 0, 0], [1, 3, 0], [0, 0, 0]], [[4, 0, 0], [0, 0, 0], [1, 1, 1]]]
    second = [[[8, 0, 0], [0, 0, 0], [0, 0, 0]]] * 2
    np.testing.assert_array_equal(vertical.counts, [first, second])
    # The upper half of the first image is its car, the lower half its person, as left and right.
    np.testing.assert_array_equal(horizontal.counts, [first, second])
    assert vertical.counts.dtype == np.int32
    assert (vertical.partition, horizontal.partition) == ("vertical2", "horizontal2")
    assert vertical.names == tuple(LABELS)
    assert vertical.night == (False, True)
    assert vertical.classes == tiny.classes
    assert (vertical.split, vertical.dataset) == ("test", tiny.fingerprint())
    assert scored.name == "pred"


def test_every_partition_against_a_loop_over_pixels(
    tmp_path: Path, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(1)
    names = [f"{number:05d}{'DN'[number % 2]}" for number in range(6)]
    labels = rng.integers(0, 9, (6, 24, 32), np.uint8)
    labels[rng.random(labels.shape) < 0.1] = 255
    predictions = rng.integers(0, 9, labels.shape, np.uint8)
    root = write(dict(zip(names, labels, strict=True)), "labels").parent
    (root / "images").mkdir()
    (root / "test.txt").write_text("\n".join(names))
    folder = write(dict(zip(names, predictions, strict=True)))
    dataset = MFNet(str(root))
    monkeypatch.setattr(commands, "usable_cores", lambda: 1)
    one = score_folder(folder, dataset, "test")
    monkeypatch.setattr(commands, "usable_cores", lambda: 2)
    two = score_folder(folder, dataset, "test")
    for counts, again in zip(one.counts, two.counts, strict=True):
        aspect = "image" if counts.partition == "ring5" else None
        regions = Regions(
            partition=counts.partition[:-1],  # type: ignore[arg-type]
            regions=5,
            aspect=aspect,  # type: ignore[arg-type]
            absent="released",
        )
        region_map = regions.map((24, 32))
        expected = np.zeros((6, 5, 9, 9), int)
        for index, y, x in np.ndindex(labels.shape):
            label = labels[index, y, x]
            if label != 255:
                expected[index, region_map[y, x], label, predictions[index, y, x]] += 1
        np.testing.assert_array_equal(counts.counts, expected)
        np.testing.assert_array_equal(again.counts, expected)
    assert [counts.partition for counts in one.counts] == ["ring5", "vertical5", "horizontal5"]
    assert one.maps is not None
    assert two.maps is not None
    np.testing.assert_array_equal(one.maps.union, two.maps.union)
    # Pixels and regions count the same.
    right = one.counts[0].whole().diagonal()
    np.testing.assert_array_equal(one.maps.intersection.sum((1, 2)), right)


def test_other_size_is_refused_or_read_at_nearest_pixel(tiny: MFNet, write: Write) -> None:
    half = {name: np.array(value)[::2, ::2] for name, value in PREDICTIONS.items()}
    folder = write(half)
    with pytest.raises(
        InputError, match=r"00001D\.png is 2x2 pixels but its label is 4x4.*nearest"
    ):
        score_folder(folder, tiny, "test", **STRIPS)
    scored = score_folder(folder, tiny, "test", **RESIZED)
    # Each predicted pixel stands for 2 x 2: all of the car, all of the person are right.
    first = scored.counts[0].counts[0]
    np.testing.assert_array_equal(first.sum(0), [[8, 0, 0], [0, 4, 0], [0, 0, 3]])
    assert scored.resized == dict.fromkeys(LABELS, "2x2 to 4x4")
    assert scored.remarks() == [
        "2 predictions were resized to their label by the nearest pixel, from 2x2 to 4x4.",
    ]


def test_a_turned_prediction_is_no_resized_one(tiny: MFNet, write: Write) -> None:
    folder = write({name: np.zeros((8, 4), np.uint8) for name in ("00001D", "00002N")})
    with pytest.raises(InputError, match=r"is 8x4 pixels but its label is 4x4, .*resize=stretch"):
        score_folder(folder, tiny, "test", **RESIZED)
    scored = score_folder(folder, tiny, "test", **{**RESIZED, "resize": "stretch"})
    assert scored.resized == dict.fromkeys(LABELS, "8x4 to 4x4")
    assert scored.counts[0].counts.sum((1, 2, 3)).tolist() == [15, 16]


def test_the_nearest_pixel_is_nearest_by_centres(tiny: MFNet, write: Write) -> None:
    """3 columns on 4: centres at 0.375, 1.125, 1.875 and 2.625 lie in columns 0, 1, 1, 2."""
    folder = write({name: [[0, 1, 2]] * 3 for name in PREDICTIONS})
    second = score_folder(folder, tiny, "test", **RESIZED).counts[0].counts[1]  # label 0 everywhere
    np.testing.assert_array_equal(second[:, 0], [[4, 4, 0], [0, 4, 4]])


def test_the_first_bad_file_of_the_split_is_named(tiny: MFNet, write: Write) -> None:
    bad = write({name: np.full((4, 4), 7) for name in PREDICTIONS})
    for _ in range(3):
        with pytest.raises(InputError, match=r"00001D\.png: label value 7 .16 pixels"):
            score_folder(bad, tiny, "test", **STRIPS)


def test_images_of_different_sizes_have_counts_but_no_map(tiny: MFNet, write: Write) -> None:
    larger = np.zeros((6, 8), np.uint8)
    cv2.imwrite(str(tiny.files("00002N")[-1]), larger)
    scored = score_folder(write(PREDICTIONS | {"00002N": larger}), tiny, "test", **STRIPS)
    assert scored.maps is None
    assert scored.counts[0].counts.sum((1, 2, 3)).tolist() == [15, 48]


@pytest.mark.parametrize("affixes", [("", ""), ("", "_pred"), ("P_", "")])
def test_only_names_of_the_split_are_taken(tmp_path: Path, affixes: tuple[str, str]) -> None:
    names = ("00001D", "00002N")
    stems = [f"{affixes[0]}{name}{affixes[1]}" for name in names]
    for stem in (*stems, "mean", "00001D_overlay"):
        (tmp_path / f"{stem}.png").touch()
    paths, extra = find(tmp_path, names, named(*affixes))
    assert paths == [tmp_path / f"{stem}.png" for stem in stems]
    assert extra == ("mean",)  # pictures of rgbt.predict are no stray predictions


def test_missing_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="predictions: no such folder"):
        find(tmp_path / "none", ("a",), named())
    for name in "bcde":
        (tmp_path / f"{name}.png").touch()
    with pytest.raises(InputError, match=r"lacks 1 of the 2 .*\(a\.png\).* contains .* and 1 more"):
        find(tmp_path, ("a", "b"), named())


def test_classes_with_other_indices_are_reported(tiny: MFNet, write: Write) -> None:
    """Car and person exchanged: car 0 / 3 instead of 3 / 4, person 0 / 4 instead of 1 / 3."""
    other = {name: np.array([0, 2, 1])[np.array(value)] for name, value in PREDICTIONS.items()}
    remarks = score_folder(write(other), tiny, "test", **STRIPS).remarks()
    assert len(remarks) == 1
    assert "better with 2 as 1 (car), 1 as 2 (person)." in remarks[0]
    own = score_folder(write(PREDICTIONS, "own"), tiny, "test", **STRIPS)
    assert own.remarks() == []


@pytest.mark.parametrize(
    ("exchanged", "reported"), [((10, 10), False), ((11, 11), True), ((90, 0), False)]
)
def test_other_indices_need_two_labels_that_gain(
    exchanged: tuple[int, int], reported: bool
) -> None:
    """Of 100 pixels of b and of c, n are predicted as the other: it gains n / 100 by exchange."""
    one, other = exchanged
    matrix = [[9999, 0, 0], [100 - one, 0, one], [100 - other, other, 0]]
    remarks = class_remarks(counts_of(np.array([[matrix]])))
    assert any("other indices" in remark for remark in remarks) == reported


def test_classes_that_are_never_predicted_are_named(tiny: MFNet, write: Write) -> None:
    folder = write({name: np.zeros((4, 4)) for name in PREDICTIONS})
    remarks = score_folder(folder, tiny, "test", **STRIPS).remarks()
    assert remarks == ["No prediction holds these classes of the labels: car, person."]
