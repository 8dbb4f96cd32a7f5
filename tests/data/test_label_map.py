"""Maps between class sets: what they refuse, and the released ones id by id."""

from __future__ import annotations

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.data.label_map import LabelMap
from rgbt.evaluation.images import label_map_of

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
    with pytest.raises(InputError, match=r"maps 2 classes .* network has 9 classes"):
        label_map.check(9, TARGETS, "streets")
    # The same names under other ids are other classes.
    with pytest.raises(InputError, match=r"to road, car, but .* streets has car, road"):
        label_map.check(2, TARGETS[::-1], "streets")


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
